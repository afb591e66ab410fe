"""The paper's metrics on pose sequences: E_pose, E_vel, A_accl and E_key (Yuan & Kitani, ICCV 2019, section 4.3).

Everything is NumPy float64. A sequence is ``qpos [T, 7 + D]``: root position (m), root quaternion (wxyz), D joint
values (rad), at 30 Hz unless said otherwise. ``hand_dofs`` are columns of the D joint values; both sequences have them
zeroed before comparison, as the paper's program does. Each function returns one value *a frame*: a take's figure is
their mean, and a table's is the unweighted mean over takes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.motion import finite_difference
from egopose.motion.rotations import Array


def pose_vector(qpos: Array, hand_dofs: Sequence[int] = ()) -> Array:
    """``[T, 3 + D]``: root roll, pitch (static xyz Euler, rad), yaw set to 0, joint values with the hands zeroed.

    Static xyz means ``R = Rz(yaw) Ry(pitch) Rx(roll)``: roll and pitch do not depend on where the person is heading.
    """
    qpos = _without_hands(qpos, hand_dofs)
    w, x, y, z = np.moveaxis(rot.normalize(qpos[:, 3:7]), -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.column_stack([roll, pitch, np.zeros_like(roll), qpos[:, 7:]])


def velocity_vector(qpos: Array, hand_dofs: Sequence[int] = (), fps: float = 30.0) -> Array:
    """``[T - 1, 6 + D]`` finite-difference velocities.

    Root linear velocity in the heading frame of the earlier frame (m/s), root angular velocity in its root frame, and
    joint velocities (rad/s), hands zeroed.
    """
    qpos = _without_hands(qpos, hand_dofs)
    qvel = finite_difference(qpos, fps)[:-1]
    qvel[:, :3] = rot.rotate(rot.conjugate(rot.heading(qpos[:-1, 3:7])), qvel[:, :3])
    return qvel


def pose_error(estimate: Array, reference: Array, hand_dofs: Sequence[int] = ()) -> Array:
    """E_pose of each frame ``[T]`` (rad): ``|| p_t - p^_t ||_2`` over :func:`pose_vector`.

    The difference of the root's roll is taken the short way round; pitch is in [-pi/2, pi/2] and joint values are
    compared as they stand.

    Raises:
        ValueError: the sequences differ in shape.
    """
    _same_shape(estimate, reference)
    difference = pose_vector(estimate, hand_dofs) - pose_vector(reference, hand_dofs)
    difference[:, 0] = (difference[:, 0] + np.pi) % (2 * np.pi) - np.pi
    return np.linalg.norm(difference, axis=1)


def velocity_error(estimate: Array, reference: Array, hand_dofs: Sequence[int] = (), fps: float = 30.0) -> Array:
    """E_vel of each frame ``[T - 1]``: ``|| v_t - v^_t ||_2`` over :func:`velocity_vector`.

    Raises:
        ValueError: the sequences differ in shape or have fewer than 2 frames.
    """
    _same_shape(estimate, reference)
    _at_least(estimate, 2)
    return np.linalg.norm(
        velocity_vector(estimate, hand_dofs, fps) - velocity_vector(reference, hand_dofs, fps), axis=1
    )


def acceleration(qpos: Array, hand_dofs: Sequence[int] = (), fps: float = 30.0) -> Array:
    """A_accl of each frame ``[T - 2]`` as in the authors' program: mean of ``|dv/dt|`` over all ``6 + D`` velocities.

    Raises:
        ValueError: fewer than 3 frames.
    """
    _at_least(qpos, 3)
    return np.abs(np.diff(velocity_vector(qpos, hand_dofs, fps), axis=0) * fps).mean(axis=1)


def acceleration_actuated(qpos: Array, hand_dofs: Sequence[int] = (), fps: float = 30.0) -> Array:
    """A_accl of each frame ``[T - 2]`` as the paper's text has it: ``||dv_t/dt||_1 / G`` over the G actuated joints.

    Raises:
        ValueError: fewer than 3 frames.
    """
    _at_least(qpos, 3)
    return np.abs(np.diff(velocity_vector(qpos, hand_dofs, fps)[:, 6:], axis=0) * fps).mean(axis=1)


def keypoint_error(estimate: Array, reference: Array, hips: Sequence[int], shoulders: Sequence[int]) -> Array:
    """E_key of each frame ``[T]``: mean over joints of ``|| x_t^j - x^_t^j ||_2``, for views without 3D reference.

    Both sets are moved so that the hip keypoint (the mean of ``hips``) is the origin, and scaled so that the height
    between shoulder (mean of ``shoulders``) and hip is 0.5 (the paper uses 12 joints in a side view).

    Args:
        estimate: ``[T, J, 2]`` image coordinates.
        reference: the same.
        hips: indices of the hip keypoints.
        shoulders: indices of the shoulder keypoints.

    Raises:
        ValueError: shapes differ, or shoulder and hip are at the same height in some frame.
    """
    _same_shape(estimate, reference)

    def normalised(points: Array) -> Array:
        hip = points[:, list(hips)].mean(axis=1, keepdims=True)
        height = np.abs(points[:, list(shoulders)].mean(axis=1) - hip[:, 0])[:, 1]
        if (height <= 0).any():
            raise ValueError(f"frame {int(np.argmin(height))}: shoulder and hip keypoints are at the same height")
        return (points - hip) * (0.5 / height)[:, None, None]

    return np.linalg.norm(normalised(estimate) - normalised(reference), axis=-1).mean(axis=1)


def _without_hands(qpos: Array, hand_dofs: Sequence[int]) -> Array:
    out = np.array(qpos, dtype=np.float64)
    out[:, [7 + d for d in hand_dofs]] = 0.0
    return out


def _same_shape(estimate: Array, reference: Array) -> None:
    if np.shape(estimate) != np.shape(reference):
        raise ValueError(f"estimate {np.shape(estimate)} and reference {np.shape(reference)} differ in shape")


def _at_least(qpos: Array, frames: int) -> None:
    if len(qpos) < frames:
        raise ValueError(f"needs at least {frames} frames, got {len(qpos)}")
