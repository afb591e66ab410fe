"""Forward kinematics of a :class:`Skeleton`, batched over frames."""

from __future__ import annotations

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


def joint_transforms(skeleton: Skeleton, index: int, values: Array) -> tuple[Array, Array]:
    """Local translation ``[..., 3]`` and quaternion ``[..., 4]`` of one joint from its coordinates ``[..., d]``."""
    batch = values.shape[:-1]
    translation = np.zeros((*batch, 3))
    quat = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), (*batch, 4)).copy()
    for k, dof in enumerate(skeleton.joints[index].dofs):
        axis = np.array(dof.axis)
        if dof.kind == "slide":
            translation = translation + rot.rotate(quat, values[..., k : k + 1] * axis)
        else:
            quat = rot.multiply(quat, rot.from_axis_angle(axis, values[..., k]))
    return translation, quat


def forward_kinematics(skeleton: Skeleton, qpos: Array) -> tuple[Array, Array]:
    """World positions ``[..., J, 3]`` (m) and quaternions ``[..., J, 4]`` of all joints.

    Args:
        skeleton: the tree.
        qpos: ``[..., nq]``.

    Raises:
        ValueError: the last axis is not ``nq`` long.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    if qpos.shape[-1] != skeleton.nq:
        raise ValueError(f"qpos has {qpos.shape[-1]} columns, the skeleton wants {skeleton.nq}")
    batch = qpos.shape[:-1]
    positions = np.empty((*batch, len(skeleton), 3))
    quats = np.empty((*batch, len(skeleton), 4))
    positions[..., 0, :], quats[..., 0, :] = qpos[..., :3], rot.normalize(qpos[..., 3:7])
    for i in range(1, len(skeleton)):
        joint, columns = skeleton.joints[i], skeleton.dof_slices[i]
        parent_quat = quats[..., joint.parent, :]
        offset = np.array(joint.offset)
        if joint.dofs:
            translation, local = joint_transforms(skeleton, i, qpos[..., 7 + columns.start : 7 + columns.stop])
            offset = offset + translation
            quats[..., i, :] = rot.multiply(parent_quat, local)
        else:
            quats[..., i, :] = parent_quat
        positions[..., i, :] = positions[..., joint.parent, :] + rot.rotate(
            parent_quat, np.broadcast_to(offset, (*batch, 3))
        )
    return positions, quats


def tip_positions(skeleton: Skeleton, positions: Array, quats: Array) -> tuple[list[str], Array]:
    """Names (``joint`` the tip hangs on) and world positions ``[..., n_tips, 3]`` of the end sites."""
    names = [j.name for j in skeleton.joints for _ in j.tips]
    points = [
        positions[..., i, :] + rot.rotate(quats[..., i, :], np.broadcast_to(np.array(tip), positions[..., i, :].shape))
        for i, j in enumerate(skeleton.joints)
        for tip in j.tips
    ]
    if not points:
        return names, np.empty((*positions.shape[:-2], 0, 3))
    return names, np.stack(points, axis=-2)
