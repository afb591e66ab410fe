"""The path that simulated bodies follow: laid where each of them stands, and drawn slowly towards it.

A path from video or a head's sensors has no place in the world, and no body keeps to it for ever. It is laid where the
body stands and faces at its first frame. From then on the place and the heading that are followed approach the body's
own, each with a time constant. So a body need not sprint after half a metre that it lost long ago.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.path import turned


class FollowedPath:
    """A path and how it lies in the world of each of N bodies.

    Of each body a turn and a shift are kept, which bring the path's rows into its world. At each frame the heading that
    is followed comes nearer to the body's by the share ``1 - exp(-dt / heading_time)`` of their difference. It turns
    about the place that is followed. That place then comes nearer to the body's by ``1 - exp(-dt / place_time)``.

    Args:
        path: ``[R, 3]`` x, y (m) and heading (rad), see :class:`egopose.envs.problem.Followed`.
        control_dt: s between frames.
        place_time, heading_time: s; infinity for a path that stays where it was laid.
    """

    def __init__(
        self, path: Tensor, control_dt: float, place_time: float = math.inf, heading_time: float = math.inf
    ) -> None:
        self._places, self._headings = path[:, :2].double(), path[:, 2].double()
        self._shares = tuple(-math.expm1(-control_dt / time) for time in (place_time, heading_time))
        self._turn: Tensor | None = None
        self._shift = torch.zeros(0, 2, dtype=torch.float64)

    def advance(self, row: Tensor, qpos: Tensor) -> None:
        """A frame has passed: the bodies are at ``qpos [N, nq]`` and should be at the path's ``row [N]``.

        The first call lays the path where the bodies stand.
        """
        body, facing = qpos[:, :2], rot.yaw(qpos[:, 3:7])
        near, nearer = self._shares
        if self._turn is None:
            self._turn, self._shift = torch.zeros_like(facing), torch.zeros_like(body)
            near, nearer = 1.0, 1.0
        place, heading = self.at(row)
        self._turn = self._turn + nearer * rot.wrapped(facing - heading)
        place = torch.lerp(place, body, near)
        self._shift = place - turned(self._places.index_select(0, row), self._turn)

    def at(self, row: Tensor, bodies: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Place ``[n, 2]`` m and heading ``[n]`` rad that are followed at ``row [n]``, each in the world of its body.

        Args:
            row: of the path.
            bodies: ``[n]`` which bodies they are for; None for copies of all N in their order, as often as fit.

        Raises:
            ValueError: the path was not laid yet.
        """
        if self._turn is None:
            raise ValueError("a path is laid by its first frame, which has not passed")
        copies = len(row) // len(self._turn)
        turn = self._turn.repeat(copies) if bodies is None else self._turn[bodies]
        shift = self._shift.repeat(copies, 1) if bodies is None else self._shift[bodies]
        return turned(self._places.index_select(0, row), turn) + shift, self._headings.index_select(0, row) + turn
