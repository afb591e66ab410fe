"""Distances between joints that are estimated and true ones, in mm."""

from __future__ import annotations

import numpy as np

from egopose.motion.rotations import Array
from egopose.scene.lifting import POINTS
from egopose.scene.poses.keypoints import HUMANOID_JOINTS

#: Judged: shoulders, elbows, wrists, hips, knees, ankles; as keypoints and as rows of POINTS, in one order.
KEYPOINTS = tuple(HUMANOID_JOINTS)
ROWS = [POINTS.index(joint) for joint in HUMANOID_JOINTS.values()]
_HIPS = [KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip")]


def rooted(joints: Array) -> Array:
    """Joints ``[T, 12, 3]`` relative to the middle of the hips."""
    return np.asarray(joints - joints[:, _HIPS].mean(axis=1, keepdims=True))


def mpjpe(joints: Array, truth: Array) -> float:
    """Mean distance of ``[T, 12, 3]``, roots aligned; frames without a pose are left out."""
    return float(1000 * np.nanmean(np.linalg.norm(rooted(joints) - rooted(truth), axis=-1)))


def pa_mpjpe(joints: Array, truth: Array) -> float:
    """The same after turning, scaling and moving each frame's joints onto the true ones (Procrustes)."""
    known = np.isfinite(joints).all(axis=(1, 2))
    a, b = joints[known], truth[known]
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    u, s, v = np.linalg.svd(a.transpose(0, 2, 1) @ b)
    sign = np.ones_like(s)
    sign[:, 2] = np.sign(np.linalg.det(u @ v))
    scale = (s * sign).sum(axis=1) / (a**2).sum(axis=(1, 2))
    moved = scale[:, None, None] * a @ (u * sign[:, None]) @ v
    return float(1000 * np.linalg.norm(moved - b, axis=-1).mean())
