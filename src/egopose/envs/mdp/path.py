"""The path that bodies follow, laid where each of them stands.

A path from video or a forecast has no place in the world. It is laid so that one of its rows is where a body stands
and faces. A placement ``[N, 3]`` is a turn (rad) and a shift x, y (m) that bring the path's rows into the world.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot


def root_on_floor(qpos: Tensor) -> Tensor:
    """``[N, 3]`` x, y (m) and heading (rad) of the roots of ``qpos [N, nq]``, in the world."""
    return torch.cat([qpos[:, :2], rot.yaw(qpos[:, 3:7])[:, None]], dim=-1)


def turned(places: Tensor, angle: Tensor) -> Tensor:
    """``places [N, 2]`` m turned about the origin by ``angle [N]`` rad."""
    cos, sin = angle.cos(), angle.sin()
    x, y = places.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def lay(rows: Tensor, root: Tensor) -> Tensor:
    """The placements ``[N, 3]`` that bring the path's ``rows [N, 3]`` to where the roots are, ``root [N, 3]``."""
    turn = rot.wrapped(root[:, 2] - rows[:, 2])
    return torch.cat([turn[:, None], root[:, :2] - turned(rows[:, :2], turn)], dim=-1)


def on_path(placement: Tensor, root: Tensor) -> Tensor:
    """``[N, 3]`` x, y (m) and heading (rad) of ``root [N, 3]`` in the path's own axes."""
    turn = placement[:, 0]
    return torch.cat([turned(root[:, :2] - placement[:, 1:], -turn), (root[:, 2] - turn)[:, None]], dim=-1)
