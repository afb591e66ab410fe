"""Plant the feet: soles that stand on the floor lie flat on it, none is under it.

After :mod:`egopose.motion.ground_alignment` a standing foot may still be tilted by the few degrees mocap and
retargeting leave, with its heel on the floor and its ball a centimetre above. A simulated foot rocks flat at once, and
the body sinks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def plant_feet(
    motion: Motion,
    sole_joints: np.ndarray,
    sole_offsets: Array,
    sole_points: Array,
    limits: Array,
    depth: float,
    smoothing: float = 0.05,
) -> Motion:
    """The motion with its legs moved a little so that touching sole points are at the floor.

    Args:
        motion: settled, with ``contacts [T, K]`` of the sole points.
        sole_joints: ``[K]`` the joint each point hangs on.
        sole_offsets: ``[K, 3]`` in that joint's frame, m.
        sole_points: ``[T, K, 3]`` where they are now, m.
        limits: ``[D, 2]`` rad.
        depth: how far a standing sole rests in the floor, m.
        smoothing: standard deviation in time of the points' correction, s.

    Returns:
        The motion; the root stays where it is, only hips, knees and ankles move.

    Raises:
        ValueError: the motion has no contacts.
    """
    if motion.contacts is None:
        raise ValueError("the motion has no contacts; settle it first")
    height = sole_points[..., 2] + depth
    correction = np.where(motion.contacts, -height, np.maximum(-height, 0.0))
    correction = gaussian_filter1d(correction, smoothing * motion.fps, axis=0, mode="nearest")
    goal = sole_points.copy()
    goal[..., 2] += correction
    root = motion.qpos[:, :3]
    targets = Targets(
        point_joint=np.concatenate([sole_joints, [0]]),
        point_offset=np.concatenate([sole_offsets, np.zeros((1, 3))]),
        positions=np.concatenate([goal, root[:, None]], axis=1),
        position_weight=np.array([1.0] * len(sole_joints) + [10.0]),
        frame_joint=np.array([0]),
        orientations=motion.qpos[:, None, 3:7],
        orientation_weight=np.array([10.0]),
    )
    # `stay` in metres per radian: soles count a hundred times what the legs' pose does.
    qpos = solve(motion.skeleton, motion.qpos, targets, limits, iterations=6, stay=0.01)
    return replace(motion, qpos=qpos)
