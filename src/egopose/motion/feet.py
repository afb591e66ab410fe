"""How a foot's frame lies in the model's: which way its sole faces, whatever the line from ankle to toe does.

That line falls by 10 degrees in one rig and by 66 in another, both with flat soles; a dancer's falls as steeply on the
tips of the toes. Three things tell them apart: the floor's normal while the foot stands, the rest pose where it is one
that stands, and the other foot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.calibration import Stance, align, angle_between, bone_direction
from egopose.motion.contacts import point_speeds
from egopose.motion.rotations import Array

_UP = np.array([0.0, 0.0, 1.0])
#: A foot that stands steeper than its rig does by more than this is on its toes, rad; real feet and rigs that fit them
#: badly differ by up to 10 degrees, heels lifted by 5 cm by 15.
_ON_TOES = np.deg2rad(15.0)
#: A line that falls by less or by more may be drawn along an axis, not measured, rad.
_LEVEL, _DOWN = np.deg2rad(5.0), np.deg2rad(75.0)
#: A flat foot's line rises by this at most, rad.
_RISES = np.deg2rad(-10.0)
#: Then a foot that stands up to this much steeper than the model's is still a flat one, rad.
_STEEP = np.deg2rad(12.0)


@dataclass(frozen=True)
class Foot:
    """One foot of the source and of the model.

    Args:
        joint: the source's ankle joint.
        quats: ``[T, 4]`` its orientation.
        ankle, toe: ``[T, 3]`` m.
        across: ``[T, 3]`` the knee's axis in the world.
        model_toe: ``[3]`` from ankle to toe in the model's foot, m.
        model_across: ``[3]`` the knee's axis in the model's foot.
    """

    joint: int
    quats: Array
    ankle: Array
    toe: Array
    across: Array
    model_toe: Array
    model_across: Array


def foot_constants(feet: dict[str, Foot], stance: Stance, upright: Array, size: float, fps: float) -> dict[str, Array]:
    """For each foot the constant quaternion ``[4]`` c with ``model orientation = source orientation * c``.

    Args:
        feet: by side.
        stance: of the source.
        upright: ``[T]`` of :func:`egopose.motion.calibration.uprightness`: only an upright body stands on its soles.
        size: the source's legs over an adult's.
        fps: frames per second.
    """
    stands = upright > 0.3
    contact = {side: _floor_normal(foot, stands, size, fps) for side, foot in feet.items()}
    falls = {
        side: _fall(foot, normal)
        for side, foot in feet.items()
        if (normal := contact[side]) is not None and _RISES <= _fall(foot, normal) <= _DOWN
    }
    out = {}
    for side, foot in feet.items():
        model = angle_between(_UP, foot.model_toe) - np.pi / 2
        rest = rot.rotate(rot.conjugate(stance.orientations[foot.joint]), _UP) if stance.is_rest else None
        rig = None if rest is None else _fall(foot, rest)
        if rig is None or not _RISES <= rig <= _DOWN:
            # No rest pose: rigs are alike on both sides, so of two feet the flatter one shows it.
            flat, rest = min(falls.values(), default=model), None
        elif rig < _LEVEL and side in falls and falls[side] < model + _STEEP:
            flat = falls[side]
        else:
            flat = rig
        normal = contact[side]
        if normal is not None and side in falls and falls[side] < flat + _ON_TOES:
            out[side] = align((normal, _direction(foot)), (_UP, foot.model_toe))
        elif rest is not None:
            out[side] = align((rest, _direction(foot)), (_UP, foot.model_toe))
        else:
            # Never flat, and no rest pose: the ankle's mean turn against the knee's axis is taken for none.
            across = bone_direction(foot.quats, foot.across)
            forward = np.cross(foot.model_across, _UP)
            line = np.cos(flat) * forward / np.linalg.norm(forward) - np.sin(flat) * _UP
            out[side] = align((_direction(foot), across), (line, foot.model_across))
    return out


def _direction(foot: Foot) -> Array:
    """``[3]`` from ankle to toe in the foot's frame."""
    return bone_direction(foot.quats, foot.toe - foot.ankle)


def _fall(foot: Foot, normal: Array) -> float:
    """How far the line from ankle to toe falls below a plane of this normal ``[3]``, rad."""
    return angle_between(normal, _direction(foot)) - np.pi / 2


def _floor_normal(foot: Foot, stands: np.ndarray, size: float, fps: float) -> Array | None:
    """The floor's normal ``[3]`` in the foot's frame: the mean of up while the foot stands (low and slow).

    None where the body never stands.
    """
    if not stands.any():
        return None
    speed = point_speeds(np.stack([foot.ankle, foot.toe], axis=1), fps).sum(axis=1) / size
    height = (foot.ankle[:, 2] + foot.toe[:, 2]) / size
    score = (height - np.quantile(height[stands], 0.02)) / 0.05 + speed / 0.5
    # 1.5 cm at rest, or 0.15 m/s on the floor; of a restless foot the best twentieth of the frames.
    flat = stands & (score <= max(0.3, np.quantile(score[stands], 0.05)))
    return rot.rotate(rot.conjugate(foot.quats[flat]), np.broadcast_to(_UP, (int(flat.sum()), 3))).mean(axis=0)
