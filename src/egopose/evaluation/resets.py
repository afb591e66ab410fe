"""How well the fail-safe knew: its triggers, each beside what would have come without the reset, and what it missed.

A trigger is *foreseen* where the body would have fallen within a stated window, *late* where it had fallen already, a
*false alarm* where it would have stayed up for the whole window, *cut short* where the take ends before that is known.
A fall is *missed* where the body fell, or its physics broke, and nothing had triggered until the next start or the
take's end. A fall is a head lower than the take's lowest by more than the task allows, as in training.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egopose.inference.estimator import Estimate
from egopose.motion.rotations import Array

FORESEEN, LATE, FALSE_ALARM, CUT_SHORT = "foreseen", "late", "false_alarm", "cut_short"


@dataclass(frozen=True)
class Trigger:
    """One trigger at ``frame`` of the fragment; ``lead`` frames before the fall, negative after it, None for none."""

    frame: int
    kind: str
    lead: int | None


@dataclass(frozen=True)
class TakeTriggers:
    """All of one take.

    Attributes:
        frames: of the take.
        fallen: how many of them the body lay, or stood too low.
        triggers: in order.
        missed: frames of falls that nothing triggered at.
        confidence: ``[T]`` V(s_t) over its running mean.
    """

    frames: int
    fallen: int
    triggers: tuple[Trigger, ...]
    missed: tuple[int, ...]
    confidence: Array


def take_triggers(estimate: Estimate, to_fall: Mapping[int, int | None], window: int) -> TakeTriggers:
    """Judge a take.

    Args:
        estimate: of the take.
        to_fall: by the frame of each trigger, how many frames later the body would have fallen without a reset; None
            where it would not within the window or before the take ends.
        window: frames.
    """
    frames = len(estimate.qpos)
    starts = [0, *np.flatnonzero(estimate.resets).tolist()]
    triggers, missed = [], []
    for first, end in zip(starts, [*starts[1:], frames], strict=True):
        falls, reported = (np.flatnonzero(flags[first:end]) + first for flags in (estimate.fallen, estimate.triggered))
        if not len(reported):
            # A start anew that nothing asked for: the physics broke.
            missed += [int(falls[0])] if len(falls) else [end] if end < frames else []
            continue
        at = int(reported[0])
        if len(falls) and falls[0] <= at:
            triggers.append(Trigger(at, LATE, int(falls[0]) - at))
        elif (lead := to_fall[at]) is not None:
            triggers.append(Trigger(at, FORESEEN, lead))
        else:
            triggers.append(Trigger(at, FALSE_ALARM if at + window < frames else CUT_SHORT, None))
    fallen = int(estimate.fallen.sum())
    return TakeTriggers(frames, fallen, tuple(triggers), tuple(missed), estimate.confidence)


def summary(takes: Sequence[TakeTriggers], fps: float) -> dict[str, Any]:
    """Counts over takes, lead times in frames of what was foreseen or late, and F1 of the triggers.

    ``f1`` is the harmonic mean of the share of triggers that foresaw a fall and the share of falls that were foreseen;
    triggers that are cut short count in neither. None where there was neither a trigger nor a fall.
    """
    kinds = Counter(trigger.kind for take in takes for trigger in take.triggers)
    leads = [trigger.lead for take in takes for trigger in take.triggers if trigger.lead is not None]
    missed, frames = sum(len(take.missed) for take in takes), sum(take.frames for take in takes)
    wrong = kinds[FALSE_ALARM] + kinds[LATE] + missed
    counted = kinds[FORESEEN] + wrong
    return {
        "triggers": sum(kinds.values()),
        **{kind: kinds[kind] for kind in (FORESEEN, LATE, FALSE_ALARM, CUT_SHORT)},
        "missed": missed,
        "f1": 2 * kinds[FORESEEN] / (2 * kinds[FORESEEN] + wrong) if counted else None,
        "median_lead_frames": float(np.median(leads)) if leads else None,
        "lead_frames": sorted(leads),
        "triggers_per_minute": sum(kinds.values()) * fps * 60.0 / frames,
        "fallen_share": sum(take.fallen for take in takes) / frames,
    }


def as_dict(names: Sequence[str], takes: Sequence[TakeTriggers], fps: float) -> dict[str, Any]:
    """:func:`summary`, and under ``takes`` each take's triggers, misses and per-frame confidence, for JSON."""
    each = [
        {
            "take": name,
            "triggers": [{"frame": t.frame, "kind": t.kind, "lead_frames": t.lead} for t in take.triggers],
            "missed": list(take.missed),
            "confidence": [round(float(c), 4) for c in take.confidence],
        }
        for name, take in zip(names, takes, strict=True)
    ]
    return {**summary(takes, fps), "takes": each}


def as_text(found: Mapping[str, Any]) -> str:
    """One line of :func:`summary`."""
    if not found["triggers"] and not found["missed"]:
        return "no trigger and no fall"
    lead = found["median_lead_frames"]
    ahead = "" if lead is None else f", median lead {lead:g} frames"
    parts = (found[FORESEEN], found[LATE], found[FALSE_ALARM], found[CUT_SHORT], found["missed"])
    counts = "{} foreseen, {} late, {} false alarms, {} cut short; {} falls missed".format(*parts)
    return f"{found['triggers']} triggers: {counts}{ahead}"
