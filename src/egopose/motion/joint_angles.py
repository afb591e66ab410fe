"""A model's joint angles from the orientations of its joints."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


def read_angles(model: Skeleton, orientations: dict[str, Array], limits: Array) -> Array:
    """``[T, nq]`` from world orientations: three hinges by Euler angles, one by its twist about the axis."""
    frames = len(orientations["Hips"])
    qpos = np.zeros((frames, model.nq))
    qpos[:, 3:7] = orientations["Hips"]
    quats: list[Array] = [orientations["Hips"]]
    for j, joint in enumerate(model.joints[1:], start=1):
        parent = quats[joint.parent]
        local = rot.multiply(rot.conjugate(parent), orientations[joint.name])
        axes = np.array([d.axis for d in joint.dofs])
        columns = slice(7 + model.dof_slices[j].start, 7 + model.dof_slices[j].stop)
        if len(axes) == 1:
            along = np.sum(local[:, 1:] * axes[0], axis=1)
            angles = 2.0 * np.arctan2(along, local[:, 0])[:, None]
        else:
            angles = Rotation.as_davenport(rot.to_scipy(local), axes, "intrinsic")
        low, high = limits[model.dof_slices[j], 0], limits[model.dof_slices[j], 1]
        qpos[:, columns] = np.clip(_within(angles, axes, low, high), low, high)
        reached = np.broadcast_to(np.array([1.0, 0, 0, 0]), (frames, 4))
        for k, axis in enumerate(axes):
            reached = rot.multiply(reached, rot.from_axis_angle(axis, qpos[:, columns.start + k]))
        quats.append(rot.multiply(parent, reached))
    return qpos


def _within(angles: Array, axes: Array, low: Array, high: Array) -> Array:
    """The equal set of angles ``[T, d]`` about ``axes [d, 3]`` that fits the limits best.

    Three hinges reach every orientation twice, (a, b, c) and (a + pi, 2 lock - b, c + pi), where ``lock`` is the middle
    angle that lays the third axis along the first; and each angle may be moved by a whole turn.
    """
    centre = (low + high) / 2
    ways = [angles]
    if len(axes) == 3:
        lock = np.arctan2(np.dot(np.cross(axes[2], axes[0]), axes[1]), np.dot(axes[2], axes[0]))
        ways.append(angles * [1, -1, 1] + [np.pi, 2 * lock, np.pi])
    ways = [w - 2 * np.pi * np.round((w - centre) / (2 * np.pi)) for w in ways]
    # Outside the limits costs most; inside, the nearer the middle the better, which keeps time smooth.
    cost = [np.sum((w - np.clip(w, low, high)) ** 2 + 0.01 * (w - centre) ** 2, axis=1) for w in ways]
    return np.take_along_axis(np.stack(ways), np.argmin(cost, axis=0)[None, :, None], axis=0)[0]
