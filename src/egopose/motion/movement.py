"""What sports and rehabilitation read off a movement: flights, contacts, steps, loads, joints.

Samples are evenly spaced and hold from their time on: sample n from ``n / rate`` to ``(n + 1) / rate``. z is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from egopose.motion.contacts import runs_of, without_short_runs
from egopose.motion.rotations import Array

#: s: a shorter flight, contact or gap in a contact is a bounce of the contact model. A sprinter's contact lasts 0.08 s.
SHORTEST = 0.04
#: s after a landing in which its peak is looked for.
_LANDING = 0.5
#: s and m between a foot's strike and the other's: slower or shorter ones are no steps.
_SLOWEST_STEP, _SHORTEST_STEP = 1.5, 0.1


@dataclass(frozen=True)
class Flight:
    """A time in which nothing touches the body; ``begin`` and ``end`` are its samples, ``end`` not included.

    Args:
        begin: the first sample in the air.
        end: the first sample after landing.
        time: s.
        rise: m, of the centre of mass from take-off to its highest point.
        rise_standing: m, the highest point over the centre of mass of a body that stands where this one took off.
        rise_by_time: m, ``g t^2 / 8`` (Linthorne 2001): what a jump of this flight time is worth where it lands as high
            as it took off, with the same posture.
        distance: m, horizontal way of the centre of mass.
        drop: m, from the centre of mass at take-off down to that at landing.
        take_off_speed: m/s, upward speed of the centre of mass at take-off.
    """

    begin: int
    end: int
    time: float
    rise: float
    rise_standing: float
    rise_by_time: float
    distance: float
    drop: float
    take_off_speed: float


@dataclass(frozen=True)
class Landing:
    """What the ground does after a flight.

    Args:
        begin: sample of the first contact.
        peak: body weights, the largest vertical force within half a second or until the next flight.
        peak_at: its sample.
        load_rate: body weights per second, the peak over the time from first contact to it. It depends on how soft the
            simulated contact is.
    """

    begin: int
    peak: float
    peak_at: int
    load_rate: float


@dataclass(frozen=True)
class FootContact:
    """A time in which a foot touches something, from sample ``begin`` to ``end`` (not included).

    Args:
        side: ``right`` or ``left``.
        begin, end: samples.
        time: s.
        peak: body weights, the largest vertical force on the foot.
        whole: neither end is cut by the clip's.
    """

    side: str
    begin: int
    end: int
    time: float
    peak: float
    whole: bool


@dataclass(frozen=True)
class Step:
    """From one foot's strike to the other's.

    Args:
        side: the foot that strikes last.
        begin, end: samples of the two strikes.
        time: s.
        length: m, between the feet at their strikes, along the way of the centre of mass between them.
        flight: whether the body was in the air in between, as in running.
    """

    side: str
    begin: int
    end: int
    time: float
    length: float
    flight: bool


def flights(
    touching: NDArray[np.bool_],
    com: Array,
    com_velocity: Array,
    standing: Array,
    rate: float,
    gravity: float = 9.81,
    shortest: float = SHORTEST,
) -> list[Flight]:
    """Every flight that begins and ends within the clip.

    Args:
        touching: ``[N]`` whether anything touches the body.
        com, com_velocity: ``[N, 3]`` m and m/s.
        standing: ``[N]`` m over the floor: the centre of mass of a body that stands where this one last touched.
        rate: samples a second.
        gravity: m/s^2.
        shortest: s.
    """
    out = []
    for begin, end in runs_of(~_settled(touching, rate, shortest)):
        if begin == 0 or end == len(touching) or (end - begin) / rate < shortest:
            continue
        highest = float(com[begin : end + 1, 2].max())
        time = (end - begin) / rate
        out.append(
            Flight(
                begin,
                end,
                time,
                rise=highest - float(com[begin, 2]),
                rise_standing=highest - float(standing[begin - 1]),
                rise_by_time=gravity * time**2 / 8,
                distance=float(np.linalg.norm(com[end, :2] - com[begin, :2])),
                drop=float(com[begin, 2] - com[end, 2]),
                take_off_speed=float(com_velocity[begin, 2]),
            )
        )
    return out


def landings(found: Sequence[Flight], vertical: Array, rate: float) -> list[Landing]:
    """One for each flight.

    Args:
        found: in the order of time.
        vertical: ``[N]`` body weights, of all contacts.
        rate: samples a second.
    """
    out = []
    for number, flight in enumerate(found):
        stop = min(flight.end + max(1, round(_LANDING * rate)), len(vertical))
        if number + 1 < len(found):
            stop = min(stop, found[number + 1].begin)
        at = flight.end + int(np.argmax(vertical[flight.end : stop]))
        peak = float(vertical[at])
        out.append(Landing(flight.end, peak, at, peak / ((at + 1 - flight.end) / rate)))
    return out


def foot_contacts(touching: NDArray[np.bool_], vertical: Array, rate: float) -> list[FootContact]:
    """Contacts of the right and the left foot, in the order in which they begin.

    Args:
        touching: ``[N, 2]`` right, left.
        vertical: ``[N, 2]`` body weights.
        rate: samples a second.
    """
    out = []
    for foot, side in enumerate(("right", "left")):
        for begin, end in runs_of(_settled(touching[:, foot], rate, SHORTEST)):
            whole = begin > 0 and end < len(touching)
            peak = float(vertical[begin:end, foot].max())
            out.append(FootContact(side, begin, end, (end - begin) / rate, peak, whole))
    return sorted(out, key=lambda contact: (contact.begin, contact.side))


def steps(contacts: Sequence[FootContact], feet: Array, com: Array, air: Sequence[Flight], rate: float) -> list[Step]:
    """Strikes of one foot after strikes of the other, with the body on its way; landings on both feet are none.

    Args:
        contacts: of :func:`foot_contacts`; those that the clip's beginning cuts have no strike.
        feet: ``[N, 2, 3]`` m, places of the right and the left foot.
        com: ``[N, 3]`` m.
        air: flights.
        rate: samples a second.
    """
    out = []
    both = {
        a.begin for a in contacts for b in contacts if a.side != b.side and abs(a.begin - b.begin) < SHORTEST * rate
    }
    strikes = [contact for contact in contacts if contact.begin > 0 and contact.begin not in both]
    for first, second in pairwise(strikes):
        time = (second.begin - first.begin) / rate
        way = com[second.begin, :2] - com[first.begin, :2]
        far = float(np.linalg.norm(way))
        if first.side == second.side or not 0 < time <= _SLOWEST_STEP or far < _SHORTEST_STEP:
            continue
        places = [feet[c.begin, 0 if c.side == "right" else 1, :2] for c in (first, second)]
        length = float((places[1] - places[0]) @ way / far)
        flown = any(first.begin < flight.begin < second.begin for flight in air)
        out.append(Step(second.side, first.begin, second.begin, time, length, flown))
    return out


def asymmetry(right: float, left: float) -> float:
    """Percent: the difference over the mean of the two sides (Robinson et al. 1987), positive where right is larger.

    NaN where both are zero or one is not finite.
    """
    mean = 0.5 * (abs(right) + abs(left))
    return float("nan") if not mean > 0 else 100.0 * (right - left) / mean


def _settled(touching: NDArray[np.bool_], rate: float, shortest: float) -> NDArray[np.bool_]:
    """Without short gaps, then without short contacts; both are bounces of the contact model."""
    least = max(1, round(shortest * rate))
    closed = ~without_short_runs(~touching[:, None], least)
    return without_short_runs(closed, least)[:, 0]
