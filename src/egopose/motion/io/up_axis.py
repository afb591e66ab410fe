"""Which axis is up where the rest pose and the posed body disagree: people do lie, and stand on their hands.

Three witnesses: the axis the rest pose stands along, the axis the posed body stands along on average, and the floor,
which most files have at 0. A body whose rest pose stands along y and whose frames lie along z lies on a floor with y
up, or stands in a world with z up (SMPL's rest pose in AMASS's world): the floor tells which.
"""

from __future__ import annotations

import numpy as np

from egopose.motion.kinematics import forward_kinematics, tip_positions
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: Cosine of the angle within which legs and trunk of a standing rest pose lie along one axis (18 degrees).
_STANDS = 0.95
#: A floor lies at 0 if the body's lowest point comes this near to it, as a share of the stature; and another axis than
#: the rest pose's has to have it nearer by this much.
_AT_FLOOR, _NEARER = 0.08, 0.03


def settle_up(skeleton: Skeleton, qpos: Array, head: int, feet: list[int], height: float, posed: str) -> str:
    """The up axis of a file.

    Args:
        skeleton: in the file's own axes.
        qpos: ``[T, nq]`` a sample of its frames.
        head, feet: joints.
        height: stature in the file's unit.
        posed: the axis the posed body stands along, or the custom where it stands along none.
    """
    rest = _rest_axis(skeleton, head, feet)
    if rest is None or rest == posed:
        return posed
    positions, quats = forward_kinematics(skeleton, qpos)
    points = np.concatenate([positions, tip_positions(skeleton, positions, quats)[1]], axis=1)

    def floor(up: str) -> float:
        """How far the body's lowest point is from 0, as a share of its height."""
        along = points[..., "xyz".index(up[-1])] * (-1.0 if up[0] == "-" else 1.0)
        return abs(float(np.quantile(along.min(axis=1), 0.05))) / height

    other = min((posed, "y"), key=floor)
    return other if floor(other) < min(_AT_FLOOR, floor(rest) - _NEARER) else rest


def _rest_axis(skeleton: Skeleton, head: int, feet: list[int]) -> str | None:
    """The axis legs and trunk of the rest pose stand along; None where it does not stand."""
    positions = forward_kinematics(skeleton, skeleton.rest_qpos())[0]
    ancestors = [_ancestors(skeleton, foot) for foot in feet]
    hips = next(i for i in ancestors[0] if all(i in others for others in ancestors))
    trunk, legs = positions[head] - positions[hips], positions[hips] - positions[feet].mean(axis=0)
    if not (np.linalg.norm(trunk) > 0 and np.linalg.norm(legs) > 0):
        return None
    axis = int(np.argmax(np.abs(trunk)))
    along = [vector[axis] / np.linalg.norm(vector) for vector in (trunk, legs)]
    if min(along) > _STANDS:
        return "xyz"[axis]
    return "-" + "xyz"[axis] if max(along) < -_STANDS else None


def _ancestors(skeleton: Skeleton, index: int) -> list[int]:
    chain = [index]
    while skeleton.joints[chain[-1]].parent >= 0:
        chain.append(skeleton.joints[chain[-1]].parent)
    return chain
