"""A simulated movement in numbers for sports and rehabilitation: one table, a figure a row.

Forces, torques and powers are means over a control step's time around each moment, as a low-pass is usual for a force
plate's. A peak within one step of physics would tell how hard the simulated contact is, not the body.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from egopose.core.result_files import csv_cell
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.replayed_forces import ReplayedForces
from egopose.motion.movement import (
    Flight,
    FootContact,
    Landing,
    Step,
    asymmetry,
    flights,
    foot_contacts,
    landings,
    steps,
)
from egopose.motion.rotations import Array

SIDES = ("right", "left")
#: A joint's name in the field -> the body it moves in the humanoid, whose first hinge flexes it.
_JOINTS = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}
#: The humanoid's hinge -> flexion (ankle: dorsiflexion) positive, as clinicians count it.
_FLEXION = {"hip": -1.0, "knee": 1.0, "ankle": -1.0}


@dataclass(frozen=True)
class JointFigures:
    """One joint of one side over the whole movement.

    Args:
        joint, side: ``hip``, ``knee`` or ``ankle``; ``right`` or ``left``.
        least, most: degrees of flexion (ankle: dorsiflexion) from the straight, upright body.
        torque: N m, the largest magnitude about the hinge that flexes it.
        torque_at: its sample.
        power: W, the largest that the hinge delivers.
    """

    joint: str
    side: str
    least: float
    most: float
    torque: float
    torque_at: int
    power: float


@dataclass(frozen=True)
class Row:
    """A figure: ``frames`` are those it belongs to, at the control rate."""

    what: str
    side: str
    value: float
    unit: str
    frames: tuple[float, float]


@dataclass(frozen=True)
class MovementNumbers:
    """See :mod:`egopose.motion.movement`; samples are steps of physics.

    Args:
        flights, landings: one landing a flight.
        off_feet: of each flight, whether nothing but the feet touched just before it.
        contacts: of both feet.
        steps: strikes of one foot after the other.
        joints: hips, knees, ankles of both sides.
        vertical: ``[N]`` body weights, of all contacts of the body.
        hardest: body weights, the largest vertical force of one step of physics.
        substeps: samples a frame.
        frames: of the movement.
        mass: kg.
        duration: s.
    """

    flights: tuple[Flight, ...]
    landings: tuple[Landing, ...]
    off_feet: tuple[bool, ...]
    contacts: tuple[FootContact, ...]
    steps: tuple[Step, ...]
    joints: tuple[JointFigures, ...]
    vertical: Array
    hardest: float
    substeps: int
    frames: int
    mass: float
    duration: float

    @property
    def cadence(self) -> float:
        """Steps a minute; NaN where there are none."""
        return 60.0 / float(np.mean([step.time for step in self.steps])) if self.steps else float("nan")

    def rows(self) -> list[Row]:
        """The whole table."""
        return [*self.summary(), *self.details()]

    def summary(self) -> list[Row]:
        """Figures of the whole movement, of flights and of joints."""
        return [*self._whole(), *self._flights(), *self._means(), *self._joints()]

    def details(self) -> list[Row]:
        """Every contact of a foot and every step."""
        return [*self._contacts(), *self._steps()]

    def _row(self, what: str, side: str, value: float, unit: str, begin: int, end: int) -> Row:
        return Row(what, side, float(value), unit, (begin / self.substeps, end / self.substeps))

    def _whole(self) -> Iterator[Row]:
        last = (self.frames - 1) * self.substeps
        at = int(np.argmax(self.vertical))
        yield self._row("body mass", "", self.mass, "kg", 0, last)
        yield self._row("peak vertical ground reaction", "", self.vertical[at], "BW", at, at)
        yield self._row("peak vertical ground reaction, one step of physics", "", self.hardest, "BW", 0, last)

    def _flights(self) -> Iterator[Row]:
        of_each = zip(self.flights, self.landings, self.off_feet, strict=True)
        for number, (flight, landing, off_feet) in enumerate(of_each, start=1):
            span, name = (flight.begin, flight.end), f"flight {number}{'' if off_feet else ', not off the feet'}: "
            yield self._row(f"{name}time", "", flight.time, "s", *span)
            yield self._row(f"{name}rise of the centre of mass from take-off", "", flight.rise, "m", *span)
            yield self._row(f"{name}rise of the centre of mass from standing", "", flight.rise_standing, "m", *span)
            yield self._row(f"{name}rise by flight time, g t^2 / 8", "", flight.rise_by_time, "m", *span)
            yield self._row(f"{name}distance of the centre of mass", "", flight.distance, "m", *span)
            yield self._row(f"{name}fall from take-off to landing", "", flight.drop, "m", *span)
            yield self._row(f"{name}vertical speed at take-off", "", flight.take_off_speed, "m/s", *span)
            after = (landing.begin, landing.peak_at)
            yield self._row(f"{name}peak vertical force of the landing", "", landing.peak, "BW", *after)
            yield self._row(f"{name}load rate of the landing", "", landing.load_rate, "BW/s", *after)

    def _means(self) -> Iterator[Row]:
        """Of contacts and steps."""
        whole = [contact for contact in self.contacts if contact.whole]
        times = {side: [contact.time for contact in whole if contact.side == side] for side in SIDES}
        yield from self._mean("foot contact", times, "s", [(contact.begin, contact.end) for contact in whole])
        spans = [(step.begin, step.end) for step in self.steps]
        lengths = {side: [step.length for step in self.steps if step.side == side] for side in SIDES}
        yield from self._mean("step length", lengths, "m", spans)
        if self.steps:
            yield self._row("cadence", "", self.cadence, "steps/min", spans[0][0], spans[-1][1])

    def _mean(
        self, what: str, values: Mapping[str, Sequence[float]], unit: str, spans: Sequence[tuple[int, int]]
    ) -> Iterator[Row]:
        for side, own in values.items():
            if own:
                yield self._row(f"mean {what}", side, float(np.mean(own)), unit, spans[0][0], spans[-1][1])
        if all(values.values()):
            yield self._asymmetry(f"mean {what}", *(float(np.mean(values[side])) for side in SIDES))

    def _contacts(self) -> Iterator[Row]:
        for contact in self.contacts:
            span = contact.begin, contact.end
            cut = "" if contact.whole else ", cut by the clip"
            yield self._row(f"foot contact{cut}", contact.side, contact.time, "s", *span)
            yield self._row("foot contact, peak vertical force", contact.side, contact.peak, "BW", *span)

    def _steps(self) -> Iterator[Row]:
        for step in self.steps:
            kind = "running step" if step.flight else "step"
            yield self._row(f"{kind} length", step.side, step.length, "m", step.begin, step.end)
            yield self._row(f"{kind} time", step.side, step.time, "s", step.begin, step.end)

    def _joints(self) -> Iterator[Row]:
        last = (self.frames - 1) * self.substeps
        for one in self.joints:
            yield self._row(f"{one.joint} flexion, most", one.side, one.most, "deg", 0, last)
            yield self._row(f"{one.joint} flexion, least", one.side, one.least, "deg", 0, last)
            yield self._row(f"{one.joint} peak torque", one.side, one.torque, "N m", one.torque_at, one.torque_at)
            yield self._row(f"{one.joint} peak power", one.side, one.power, "W", 0, last)
        for joint in _JOINTS:
            right, left = (next(j for j in self.joints if (j.joint, j.side) == (joint, side)) for side in SIDES)
            yield self._asymmetry(f"{joint} peak torque", right.torque, left.torque)
            yield self._asymmetry(f"{joint} range of flexion", right.most - right.least, left.most - left.least)

    def _asymmetry(self, what: str, right: float, left: float) -> Row:
        last = (self.frames - 1) * self.substeps
        return self._row(f"{what}: asymmetry", "right - left", asymmetry(right, left), "%", 0, last)


def movement_numbers(humanoid: HumanoidModel, forces: ReplayedForces, box_tops: Array) -> MovementNumbers:
    """Read the numbers off a replay.

    Args:
        humanoid: with bodies ``RightUpLeg``, ``RightLeg``, ``RightFoot`` and their likes.
        forces: of its replay.
        box_tops: ``[K, 3]`` m.
    """
    feet = [humanoid.skeleton.index(f"{side.capitalize()}Foot") for side in SIDES]
    touching = forces.touching
    at_once = forces.force[..., 2].sum(axis=2) / forces.weight
    upward = _smooth(at_once, forces.substeps)
    vertical = upward.sum(axis=1)
    standing = standing_height(humanoid) + _support_height(touching, box_tops)
    air = flights(
        np.any(touching, axis=(1, 2)), forces.com, forces.com_velocity, standing, forces.rate, gravity=forces.gravity
    )
    others = np.delete(np.any(touching, axis=2), feet, axis=1)
    contacts = foot_contacts(np.any(touching[:, feet], axis=2), upward[:, feet], forces.rate)
    return MovementNumbers(
        tuple(air),
        tuple(landings(air, vertical, forces.rate)),
        tuple(not others[max(0, one.begin - forces.substeps) : one.begin].any() for one in air),
        tuple(contacts),
        tuple(steps(contacts, forces.places[:, feet], forces.com, air, forces.rate)),
        tuple(_joint_figures(humanoid, forces)),
        vertical,
        float(at_once.sum(axis=1).max()),
        forces.substeps,
        forces.frames,
        forces.mass,
        len(forces) / forces.rate,
    )


def standing_height(humanoid: HumanoidModel) -> float:
    """m from the soles to the centre of mass of the straight, upright body with its arms hanging."""
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    for side in SIDES:
        columns = humanoid.skeleton.dof_slices[humanoid.skeleton.index(f"{side.capitalize()}Arm")]
        data.qpos[7 + columns.start : 7 + columns.stop] = humanoid.rest_action[columns]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    soles = [
        (data.xpos[body] + points @ data.xmat[body].reshape(3, 3).T)[:, 2].min()
        for body, points in zip(humanoid.body_ids[humanoid.feet], humanoid.sole_points, strict=True)
    ]
    return float(data.subtree_com[humanoid.body_ids[0]][2] - min(soles))


def write_numbers_csv(rows: Sequence[Row], path: Path) -> None:
    """``what, side, value, unit, first_frame, last_frame``, a figure a row; empty where a value is not finite."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["what", "side", "value", "unit", "first_frame", "last_frame"])
        for row in rows:
            writer.writerow([row.what, row.side, csv_cell(row.value), row.unit, *(csv_cell(f) for f in row.frames)])


def _support_height(touching: NDArray[np.bool_], box_tops: Array) -> Array:
    """``[N]`` m: the highest surface that is touched, held while nothing is."""
    heights = np.concatenate([[0.0], box_tops[:, 2]])
    touched: NDArray[np.bool_] = np.any(touching, axis=1)
    highest = np.where(touched, heights, -np.inf).max(axis=1)
    known = np.maximum.accumulate(np.where(touched.any(axis=1), np.arange(len(touching)), 0))
    out = highest[known]
    return np.where(np.isfinite(out), out, 0.0)


def _smooth(values: Array, samples: int) -> Array:
    """The running mean of ``values [N, ...]`` over some samples."""
    return np.asarray(uniform_filter1d(values, samples, axis=0, mode="nearest"))


def _joint_figures(humanoid: HumanoidModel, forces: ReplayedForces) -> Iterator[JointFigures]:
    for joint, part in _JOINTS.items():
        for side in SIDES:
            column = humanoid.skeleton.dof_slices[humanoid.skeleton.index(f"{side.capitalize()}{part}")].start
            angle = _FLEXION[joint] * np.rad2deg(forces.qpos[:, 7 + column])
            torque = np.abs(_smooth(forces.torques[:, column], forces.substeps))
            at = int(np.argmax(torque))
            power = float(_smooth(forces.power[:, column], forces.substeps).max())
            yield JointFigures(joint, side, float(angle.min()), float(angle.max()), float(torque[at]), at, power)
