"""From a policy and the state at the end of a context to futures: the mean one, or several drawn.

Yuan & Kitani 2019, section 3.2: the context of the video seen is fixed, and the policy goes on from its own states, so
that a future may be of any length.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egopose.humanoid.foot_geometry import out_of_floor
from egopose.humanoid.model import HumanoidModel
from egopose.models.pose_regression import state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array


def placed_states(states: Array, reference: Array, humanoid: HumanoidModel) -> tuple[Tensor, Tensor]:
    """States z ``[W, S]`` as qpos ``[W, nq]`` and qvel ``[W, nv]``, standing and facing as ``reference [W, nq]``, feet
    out of the floor."""
    qpos, qvel = state_to_qpos(states, reference[:, :2], rot.heading(reference[:, 3:7]), humanoid.joint_range)
    return torch.from_numpy(out_of_floor(humanoid, qpos)), torch.from_numpy(qvel)
