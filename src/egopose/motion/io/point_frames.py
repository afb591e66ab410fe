"""Frames of a body's segments from points: bone directions, and the plane in which a limb bends."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

_AXES = {sign + name: (k, -1.0 if sign else 1.0) for sign in ("", "-") for k, name in enumerate("xyz")}

#: Sine of a limb's bend below which its plane says nothing, and above which it says all (6 and 20 degrees).
_BEND = (0.1, 0.35)
#: A straight limb's plane is that of the moments around (s), and of how the limb hangs on the trunk this much.
_AROUND, _HANGING = 0.2, 0.05
#: Shorter than this a bone has no direction, m.
_SHORTEST = 1e-4


def frame(first: tuple[str, Array], second: tuple[str, Array]) -> Array:
    """Quaternions ``[T, 4]`` whose first axis lies along a direction and whose second lies nearest another one.

    Args:
        first, second: axis (``"x"``, ``"-y"`` ...) and world vectors ``[T, 3]``. Frames whose vectors are too short or
            parallel take the nearest frame's that are not.
    """
    (i, sign), (j, other) = _AXES[first[0]], _AXES[second[0]]
    a, raw = sign * first[1], other * second[1]
    length = np.linalg.norm(a, axis=-1, keepdims=True)
    a = a / np.maximum(length, 1e-12)
    b = raw - np.sum(raw * a, axis=-1, keepdims=True) * a
    across = np.linalg.norm(b, axis=-1, keepdims=True)
    good = (length[..., 0] > _SHORTEST) & (across[..., 0] > 1e-3 * np.linalg.norm(raw, axis=-1))
    if not good.any():
        return np.tile([1.0, 0.0, 0.0, 0.0], (len(a), 1))
    b = b / np.maximum(across, 1e-12)
    matrix = np.empty((*a.shape, 3))
    k = 3 - i - j
    matrix[..., i], matrix[..., j] = a, b
    matrix[..., k] = np.cross(a, b) * (1.0 if (j - i) % 3 == 1 else -1.0)
    matrix = matrix[_nearest(good)]
    return rot.continuous(rot.from_scipy(Rotation.from_matrix(matrix), (len(a),)))


def carried(parent: Array, rest: str | Array, bone: Array) -> Array:
    """The parent's frames ``[T, 4]`` turned the shortest way that brings ``rest`` along ``bone [T, 3]``.

    ``rest`` is an axis or a vector ``[3]`` of the parent's frame; where it or the bone is too short to point anywhere
    the parent's frame is kept.
    """
    if isinstance(rest, str):
        k, sign = _AXES[rest]
        rest = sign * np.eye(3)[k]
    if np.linalg.norm(rest) < _SHORTEST:
        return parent
    direction = rot.rotate(parent, np.broadcast_to(rest, bone.shape))
    long = np.linalg.norm(bone, axis=-1) > _SHORTEST
    turn = rot.between(direction, np.where(long[:, None], bone, direction))
    return rot.multiply(turn, parent)


def bend_axis(parent: Array, hanging: Array, upper: Array, lower: Array, fps: float, one_way: bool) -> Array:
    """The axis ``[T, 3]`` (world) that a limb bends about, steady where the limb is straight.

    Args:
        parent: ``[T, 4]`` frames of the trunk that the limb hangs on.
        hanging: ``[T, 3]`` where the axis would be if the limb's upper bone had no twist against the trunk.
        upper, lower: ``[T, 3]`` the limb's two bones.
        fps: frames per second.
        one_way: bends against ``hanging`` are noise (a knee), not a twist of the upper bone (an elbow).
    """
    lengths = np.linalg.norm(upper, axis=1) * np.linalg.norm(lower, axis=1)
    normal = np.cross(upper, lower) / np.maximum(lengths, 1e-9)[:, None]
    sine = np.linalg.norm(normal, axis=1)
    weight = np.clip((sine - _BEND[0]) / (_BEND[1] - _BEND[0]), 0.0, 1.0)[:, None]
    if one_way:
        weight = weight * (np.sum(normal * hanging, axis=1, keepdims=True) > 0)
    back = rot.conjugate(parent)
    seen = rot.rotate(back, normal / np.maximum(sine, 1e-9)[:, None])
    around = gaussian_filter1d(weight * seen, _AROUND * fps, axis=0, mode="nearest") + _HANGING * rot.rotate(
        back, hanging
    )
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-9)
    return rot.rotate(parent, weight * seen + (1.0 - weight) * around)


def _nearest(good: np.ndarray) -> np.ndarray:
    """For each frame the index of the nearest good one."""
    at = np.flatnonzero(good)
    place = np.searchsorted(at, np.arange(len(good)))
    before, after = at[np.maximum(place - 1, 0)], at[np.minimum(place, len(at) - 1)]
    frames = np.arange(len(good))
    return np.where(np.abs(frames - before) <= np.abs(after - frames), before, after)
