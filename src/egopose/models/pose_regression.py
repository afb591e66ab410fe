"""From the state z back to a body in the world: placing one state, and the PoseReg baseline.

PoseReg (Yuan & Kitani 2019, section 4.2) is the state regressor's poses with the root put together by integrating its
velocities; no physics. NumPy, float64, quaternions wxyz.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from egopose.humanoid.state_layout import StateLayout
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


class StateParts(NamedTuple):
    """z by its parts, last axis as said; the inverse of ``envs.mdp.observations.humanoid_state``."""

    root_height: Array
    """``[..., 1]`` m."""
    deheaded: Array
    """``[..., 4]`` root quaternion without its heading, unit, z component zero."""
    joint_angles: Array
    """``[..., D]`` rad."""
    linear_velocity: Array
    """``[..., 3]`` m/s, root, heading frame."""
    angular_velocity: Array
    """``[..., 3]`` rad/s, root frame."""
    joint_velocities: Array
    """``[..., D]`` rad/s."""


def split_state(state: Array, joint_range: Array | None = None) -> StateParts:
    """Parts of z ``[..., 11 + 2 D]``, an estimated one made valid.

    A de-headed quaternion has no z component and no negative scalar part: both are restored, then it is normalised.

    Args:
        state: z in its own units.
        joint_range: ``[D, 2]`` rad, to which joint angles are clipped; None leaves them.

    Raises:
        ValueError: the last axis is not ``11 + 2 D`` long.
    """
    state = np.asarray(state, dtype=np.float64)
    layout = StateLayout.of_size(state.shape[-1])
    if joint_range is not None and len(joint_range) != layout.dofs:
        raise ValueError(f"a state of {layout.dofs} degrees of freedom does not fit {len(joint_range)} joint ranges")
    joints = state[..., layout.joint_angles]
    quat = state[..., layout.root_rotation] * np.array([1.0, 1.0, 1.0, 0.0])
    quat[..., 0] = np.maximum(quat[..., 0], 1e-9)
    if joint_range is not None:
        joints = np.clip(joints, joint_range[:, 0], joint_range[:, 1])
    return StateParts(
        root_height=state[..., layout.root_height],
        deheaded=rot.normalize(quat),
        joint_angles=joints,
        linear_velocity=state[..., layout.root_linear_velocity],
        angular_velocity=state[..., layout.root_angular_velocity],
        joint_velocities=state[..., layout.joint_velocities],
    )


def state_to_qpos(
    state: Array, position: Array, heading: Array, joint_range: Array | None = None
) -> tuple[Array, Array]:
    """Bodies in states z, placed: the start of an estimate and the fail-safe's reset.

    Args:
        state: z ``[..., 11 + 2 D]``.
        position: ``[..., 2]`` m, the root's x and y in the world.
        heading: ``[..., 4]`` heading quaternion (x and y components zero).
        joint_range: ``[D, 2]`` rad, see :func:`split_state`.

    Returns:
        qpos ``[..., 7 + D]`` and qvel ``[..., 6 + D]`` in MuJoCo's convention (root linear velocity in the world, root
        angular velocity in the root frame).
    """
    parts = split_state(state, joint_range)
    batch = parts.root_height.shape[:-1]
    heading = np.broadcast_to(heading, (*batch, 4))
    quat = rot.multiply(heading, parts.deheaded)
    position = np.broadcast_to(position, (*batch, 2))
    qpos = np.concatenate([position, parts.root_height, quat, parts.joint_angles], axis=-1)
    linear = rot.rotate(heading, parts.linear_velocity)
    return qpos, np.concatenate([linear, parts.angular_velocity, parts.joint_velocities], axis=-1)


def integrate_root(parts: StateParts, position: Array, heading: Array, fps: float) -> tuple[Array, Array]:
    """Horizontal position ``[..., T, 2]`` (m) and heading quaternion ``[..., T, 4]`` of the root from its velocities.

    Each step turns the root by its angular velocity for 1/fps and keeps the heading of the result; roll and pitch stay
    those of the states. Exact for velocities that are forward differences at the same rate.

    Args:
        parts: of T states ``[..., T]``.
        position: ``[2]`` m at the first frame.
        heading: ``[4]`` at the first frame.
        fps: frames per second.
    """
    turned = rot.heading(rot.multiply(parts.deheaded, rot.from_rotvec(parts.angular_velocity / fps)))
    turn = 2.0 * np.arctan2(turned[..., 3], turned[..., 0])
    yaw = 2.0 * np.arctan2(heading[3], heading[0]) + _summed(turn[..., None])[..., 0]
    headings = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), yaw)
    return _summed(rot.rotate(headings, parts.linear_velocity)[..., :2] / fps) + position, headings


def _summed(steps: Array) -> Array:
    """Of ``steps [..., T, d]`` the sum of those before each frame."""
    return np.concatenate([np.zeros_like(steps[..., :1, :]), np.cumsum(steps[..., :-1, :], axis=-2)], axis=-2)


def integrated_path(state: Array, fps: float) -> Array:
    """``[..., T, 3]`` x, y (m) and heading (rad, no jumps of a whole turn) of the root, by :func:`integrate_root`.

    Args:
        state: z ``[..., T, 11 + 2 D]`` of takes; their first frames are at the origin and face along x.
        fps: frames per second.
    """
    positions, headings = integrate_root(split_state(state), np.zeros(2), np.array([1.0, 0.0, 0.0, 0.0]), fps)
    return np.concatenate([positions, np.unwrap(rot.yaw(headings))[..., None]], axis=-1)


def pose_regression(
    state: Array,
    skeleton: Skeleton,
    position: Array,
    heading: Array,
    fps: float,
    joint_range: Array | None = None,
    name: str = "",
) -> Motion:
    """The PoseReg baseline: states z ``[T, 11 + 2 D]`` of a take to a motion.

    Args:
        state: z at each frame.
        skeleton: with D degrees of freedom.
        position: ``[2]`` m, the root's start in the world.
        heading: ``[4]`` the root's heading at the start.
        fps: frames per second.
        joint_range: ``[D, 2]`` rad, see :func:`split_state`.
        name: of the take.
    """
    positions, headings = integrate_root(split_state(state, joint_range), position, heading, fps)
    qpos, _ = state_to_qpos(state, positions, headings, joint_range)
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    return Motion(skeleton, qpos, fps, name=name)
