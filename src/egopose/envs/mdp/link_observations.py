"""What a reconstruction's policy sees of the body: its links in the root's frame (Yu, Park & Lee 2021, section 5)."""

from __future__ import annotations

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.observations import BodyView


def links_in_root_frame(body: BodyView) -> Tensor:
    """``[N, 15 B - 9]``: places 3 and turns 6 of all links but the root, then all linear and all angular velocities.

    Turns are the first two columns of the rotation matrix, for the quaternion of the paper has two signs.
    """
    back = rot.matrix(rot.conjugate(body.root_quaternion))
    away = body.xpos[:, 1:] - body.xpos[:, :1]
    turns = torch.matmul(back[:, None], rot.matrix(body.xquat[:, 1:])[..., :2])
    places, *velocities = (torch.matmul(part, back.mT) for part in (away, *body.link_velocities))
    return torch.cat([part.flatten(1) for part in (places, turns, *velocities)], dim=-1)


def up_in_root_frame(quaternion: Tensor) -> Tensor:
    """``[N, 3]`` the vertical, seen from roots with ``quaternion [N, 4]``."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=quaternion.dtype).expand(len(quaternion), 3)
    return rot.rotate(rot.conjugate(quaternion), up)


def boxes_from_root(root: Tensor, tops: Tensor, headings: Tensor) -> Tensor:
    """``[N, 5 K]``: the middle of each upper face in the root's heading frame 3 (m), cosine and sine of its heading.

    Args:
        root: ``[N, 7]`` place and quaternion.
        tops: ``[N, K, 3]`` m.
        headings: ``[N, K]`` rad.
    """
    facing = rot.heading(root[:, 3:])[:, None]
    places = rot.rotate_back(facing, tops - root[:, None, :3])
    turn = headings - rot.yaw(root[:, 3:])[:, None]
    return torch.cat([places, turn.cos()[..., None], turn.sin()[..., None]], dim=-1).flatten(1)
