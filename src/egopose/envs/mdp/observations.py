"""What the policy sees of the body: the humanoid state z of Yuan & Kitani 2019, section 3."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.mdp import rotations as rot


def root_linear_velocity(state: TensorDictBase) -> Tensor:
    """``[N, 3]`` m/s in the heading frame."""
    return rot.rotate(rot.conjugate(rot.heading(state["qpos"][:, 3:7])), state["qvel"][:, :3])


def root_angular_velocity(state: TensorDictBase) -> Tensor:
    """``[N, 3]`` rad/s in the heading frame. MuJoCo's ``qvel[3:6]`` is in the root frame."""
    return rot.rotate(rot.dehead(state["qpos"][:, 3:7]), state["qvel"][:, 3:6])


def end_effectors(state: TensorDictBase, bodies: Tensor) -> Tensor:
    """``[N, E, 3]`` m: vectors from the root to each of ``bodies [E]``, in the heading frame."""
    vectors = state["xpos"][:, bodies] - state["qpos"][:, None, :3]
    return rot.rotate(rot.conjugate(rot.heading(state["qpos"][:, 3:7]))[:, None], vectors)


def joint_rotations(state: TensorDictBase, parents: Tensor) -> Tensor:
    """``[N, J, 4]``: each body but the root relative to its parent, ``conj(xquat[parent]) * xquat[child]``."""
    quats = state["xquat"]
    return rot.multiply(rot.conjugate(quats[:, parents]), quats[:, 1:])


def humanoid_state(state: TensorDictBase) -> Tensor:
    """z ``[N, 2 nq - 3]`` (115 numbers at 58 degrees of freedom), float64.

    In order: root height 1, de-headed root quaternion 4, joint angles, root linear velocity in the heading frame 3,
    root angular velocity in the root frame 3, joint velocities (Yuan & Kitani 2019, section 3, "State").
    """
    qpos, qvel = state["qpos"], state["qvel"]
    return torch.cat(
        [
            qpos[:, 2:3],
            rot.dehead(qpos[:, 3:7]),
            qpos[:, 7:],
            root_linear_velocity(state),
            qvel[:, 3:6],
            qvel[:, 6:],
        ],
        dim=-1,
    )
