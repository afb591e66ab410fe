"""Left and right exchanged: a wearer's mirror image is as likely a person, seen by a mirrored camera.

Used to double the training data of the state regressor. The model frame is x forward, y left, z up; the mirror is its
x-z plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.humanoid.state_layout import StateLayout
from egopose.motion.skeleton import Skeleton

_PLANE = np.array([1.0, -1.0, 1.0])
"""A vector's image; an axis of rotation's is the opposite."""


@dataclass(frozen=True)
class StateMirror:
    """``mirrored[..., i] = sign[i] * state[..., index[i]]`` for z ``[..., S]``."""

    index: Tensor
    sign: Tensor

    def state(self, state: Tensor) -> Tensor:
        """Mirror image of states z ``[..., S]``."""
        return state[..., self.index] * self.sign

    def poses(self) -> StateMirror:
        """The mirror of a state's first numbers, which are its pose: all but the joints' velocities."""
        pose = StateLayout.of_size(len(self.index)).pose
        return StateMirror(self.index[pose], self.sign[pose])

    @staticmethod
    def flow(flow: Tensor) -> Tensor:
        """Mirror image of flow ``[..., 2, H, W]`` (channel 0 points right)."""
        return flow.flip(-1) * torch.tensor([-1.0, 1.0], dtype=flow.dtype, device=flow.device)[:, None, None]


def joint_mirror(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Index and sign ``[D]``: angle ``i`` of the mirror image is ``sign[i]`` times angle ``index[i]`` of the original.

    Joints are paired by ``Left`` and ``Right`` in their names; all others mirror onto themselves.

    Raises:
        InputError: a joint without its opposite, or whose axes are not the other's mirror image.
    """
    index = np.zeros(skeleton.n_dofs, dtype=np.int64)
    sign = np.ones(skeleton.n_dofs)
    for i, joint in enumerate(skeleton.joints):
        swap = {"Left": "Right", "Right": "Left"}
        opposite = next((joint.name.replace(a, b) for a, b in swap.items() if a in joint.name), joint.name)
        if opposite not in skeleton.names:
            raise InputError("mirror", joint.name, f"the skeleton has no {opposite}")
        k = skeleton.index(opposite)
        theirs, columns = skeleton.joints[k].dofs, skeleton.dof_slices[k]
        if len(theirs) != len(joint.dofs):
            raise InputError("mirror", joint.name, f"has other degrees of freedom than {opposite}")
        for d, (mine, other) in enumerate(zip(joint.dofs, theirs, strict=True)):
            image = np.array(other.axis) * (_PLANE if other.kind == "slide" else -_PLANE)
            along = float(image @ np.array(mine.axis))
            if mine.kind != other.kind or abs(abs(along) - 1.0) > 1e-6:
                raise InputError("mirror", joint.name, f"axis {d} is not the mirror image of {opposite}'s")
            at = skeleton.dof_slices[i].start + d
            index[at], sign[at] = columns.start + d, np.sign(along)
    return index, sign


def state_mirror(skeleton: Skeleton) -> StateMirror:
    """The mirror of z (layout of ``envs.mdp.observations.humanoid_state``) for a skeleton.

    Raises:
        InputError: see :func:`joint_mirror`.
    """
    joints, joint_sign = joint_mirror(skeleton)
    layout = StateLayout(skeleton.n_dofs)
    index = np.arange(layout.size)
    for part in (layout.joint_angles, layout.joint_velocities):
        index[part] = index[part][joints]
    quat = np.concatenate([[1.0], -_PLANE])
    sign = np.concatenate([[1.0], quat, joint_sign, _PLANE, -_PLANE, joint_sign])
    return StateMirror(torch.as_tensor(index), torch.as_tensor(sign, dtype=torch.float32))
