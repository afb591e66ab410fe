"""Which unit a file's lengths are in: the one that makes the body and its motion the likeliest person's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egopose.motion.io.frames import UNITS
from egopose.motion.rotations import Array

STATURE_RANGE = (0.65, 2.4)

#: How often files are in each unit, ours: BVH is mostly in centimetres, and only CMU's is in Acclaim's unit.
_CUSTOM = {"m": 0.25, "dm": 0.02, "cm": 0.5, "mm": 0.1, "inch": 0.08, "asf": 0.05}

#: Stature of grown people, m: mean and spread over both sexes (NCD Risk Factor Collaboration 2016), the spread widened
#: by what the bones leave open. Children, one in twenty, have any from 0.65 to 1.5 m.
_ADULT, _SPREAD, _CHILDREN, _CHILD_RANGE = 1.7, 0.15, 0.05, (0.65, 1.5)

#: What a body's middle hardly exceeds: m/s of a sprint (the record's fastest is 12.3), and m/s^2 over a fifth of a
#: second: in flight it is 9.8, pushing off about twice that.
_SPEED, _ACCELERATION = 10.0, 25.0

#: What is told besides: a body outside these statures (m), and a unit that fewer files are in than this.
_USUAL, _RARE = (1.4, 2.1), 0.05

#: A unit with more than this share of the best one's likelihood is named beside it.
_RIVAL = 0.1


@dataclass(frozen=True)
class UnitGuess:
    """A unit, ``metres`` of it, and a sentence for the user where the guess may be wrong (else empty)."""

    name: str
    metres: float
    doubt: str


def guess_unit(height: float, root: Array, fps: float) -> UnitGuess | None:
    """The likeliest unit; None where none makes the body a person.

    Args:
        height: stature in units, see :func:`egopose.motion.io.body_size.stature`.
        root: ``[T, 3]`` positions of the hips in units.
        fps: frames per second.
    """
    possible = {
        unit: metres for unit, metres in UNITS.items() if STATURE_RANGE[0] <= height * metres <= STATURE_RANGE[1]
    }
    if not possible:
        return None
    speed, acceleration = _quickest(root, fps)
    score = {
        unit: np.log(_CUSTOM[unit] * _stature_density(height * metres))
        - _excess(speed * metres / _SPEED)
        - _excess(acceleration * metres / _ACCELERATION)
        for unit, metres in possible.items()
    }
    best, *others = sorted(score, key=lambda unit: -score[unit])
    rivals = [unit for unit in others if score[unit] > score[best] + np.log(_RIVAL)]
    doubt, (low, high) = "", _USUAL
    if rivals:
        other = " or ".join(f"{height * UNITS[u]:.2f} m in {u}" for u in rivals)
        doubt = (
            f"lengths are taken for {best}: a body of {height * UNITS[best]:.2f} m; it could be of {other}: "
            f"reader.unit={rivals[0]}"
        )
    elif _CUSTOM[best] < _RARE or not low <= height * UNITS[best] <= high:
        doubt = f"lengths are taken for {best}: a body of {height * UNITS[best]:.2f} m; reader.unit says otherwise"
    return UnitGuess(best, UNITS[best], doubt)


def _stature_density(stature: float) -> float:
    low, high = _CHILD_RANGE
    adult = np.exp(-0.5 * ((stature - _ADULT) / _SPREAD) ** 2) / (_SPREAD * np.sqrt(2 * np.pi))
    return float((1 - _CHILDREN) * adult + _CHILDREN * (low <= stature <= high) / (high - low) + 1e-9)


def _quickest(root: Array, fps: float) -> tuple[float, float]:
    """Speed and acceleration over tenths of a second that four fifths of the frames stay under."""
    step = max(1, round(0.1 * fps))
    if len(root) <= 2 * step:
        return 0.0, 0.0
    velocity = (root[step:] - root[:-step]) * fps / step
    change = (velocity[step:] - velocity[:-step]) * fps / step
    return _most(velocity), _most(change)


def _most(vectors: Array) -> float:
    return float(np.percentile(np.linalg.norm(vectors, axis=1), 80))


def _excess(ratio: float) -> float:
    return 4.0 * max(0.0, ratio - 1.0) ** 2
