"""How far the boxes of a scene may be from their first guess, and boxes drawn within that.

A change ``[..., K, 4]`` of each box is along its own x (m), along its own y (m), in height (m) and in heading (rad).
The scene parameters e of Yu, Park & Lee 2021 (section 5) are the changes that are free, over their range: within
[-1, 1]. All is differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.envs.mdp.rotations import wrapped
from egopose.envs.problem import Scene

#: m: what is deeper under an upper face came from the side.
_DEEPEST = 0.6
#: m: no upper face is lower, for a box must reach above the floor to be one.
_LOWEST = 0.0


@dataclass(frozen=True)
class SceneRanges:
    """K boxes.

    Args:
        tops: ``[K, 3]`` m, the first guess of the upper faces' middles.
        headings: ``[K]`` rad.
        low, high: ``[K, 4]`` least (0 or less) and largest (0 or more) change; both 0 where nothing is free.
        highest: m, of an upper face.
    """

    tops: Tensor
    headings: Tensor
    low: Tensor
    high: Tensor
    highest: float

    @property
    def free(self) -> Tensor:
        """``[K, 4]`` bool."""
        return self.high > self.low

    @property
    def size(self) -> int:
        """P, numbers of e."""
        return int(self.free.sum())

    def changed(self, change: Tensor) -> tuple[Tensor, Tensor]:
        """Upper faces ``[..., K, 3]`` m and headings ``[..., K]`` rad of boxes changed by ``change [..., K, 4]``."""
        return moved_boxes(self.tops, self.headings, change, self.highest)

    def change(self, tops: Tensor, headings: Tensor) -> Tensor:
        """The change ``[..., K, 4]`` that leads to boxes there: the opposite of :meth:`changed`."""
        cos, sin = self.headings.cos(), self.headings.sin()
        x, y, up = (tops - self.tops).unbind(-1)
        turn = wrapped(headings - self.headings)
        return torch.stack([cos * x + sin * y, cos * y - sin * x, up, turn], dim=-1)

    def parameters(self, change: Tensor) -> Tensor:
        """e ``[..., P]`` of ``change [..., K, 4]``."""
        half, middle = 0.5 * (self.high - self.low), 0.5 * (self.high + self.low)
        free = self.free
        return (change[..., free] - middle[free]) / half[free]

    def change_of(self, parameters: Tensor) -> Tensor:
        """``[..., K, 4]`` of e ``[..., P]``; what is not free stays."""
        half, middle = 0.5 * (self.high - self.low), 0.5 * (self.high + self.low)
        free = self.free
        out = torch.zeros(*parameters.shape[:-1], *free.shape, dtype=parameters.dtype)
        out[..., free] = middle[free] + half[free] * parameters
        return out

    def drawn(self, count: int, generator: torch.Generator) -> Tensor:
        """Changes ``[count, K, 4]``, uniform within their ranges."""
        share = torch.rand(count, *self.low.shape, generator=generator, dtype=torch.float64)
        return self.low + share * (self.high - self.low)

    def scene(self, change: Tensor) -> Scene:
        """The boxes of n worlds, changed by ``change [n, K, 4]``."""
        tops, headings = self.changed(change)
        return Scene(tops, headings, torch.ones(headings.shape, dtype=torch.bool))


def moved_boxes(tops: Tensor, headings: Tensor, change: Tensor, highest: float = float("inf")) -> tuple[Tensor, Tensor]:
    """Upper faces and headings of boxes that are changed; no face is under the floor.

    Args:
        tops: ``[K, 3]`` m. headings: ``[K]`` rad.
        change: ``[..., K, 4]`` along and across the heading and in height (m), in heading (rad).
        highest: m, of an upper face.

    Returns:
        ``[..., K, 3]`` m and ``[..., K]`` rad.
    """
    cos, sin = headings.cos(), headings.sin()
    along, across, up, turn = change.unbind(-1)
    x, y = tops[:, 0] + (cos * along - sin * across), tops[:, 1] + (sin * along + cos * across)
    return torch.stack([x, y, (tops[:, 2] + up).clamp(_LOWEST, highest)], dim=-1), headings + turn


def moved_with(
    qpos: Tensor, qvel: Tensor, start: tuple[Tensor, Tensor], to: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Bodies that stand on boxes, moved as the boxes are.

    Args:
        qpos, qvel: ``[n, nq]``, ``[n, nv]``.
        start: ``[n, 3]`` m and ``[n]`` rad, where each body's box stood.
        to: where it stands now.
    """
    turn = to[1] - start[1]
    cos, sin = turn.cos(), turn.sin()

    def turned(level: Tensor) -> Tensor:
        x, y = level.unbind(-1)
        return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)

    level = turned(qpos[:, :2] - start[0][:, :2]) + to[0][:, :2]
    height = qpos[:, 2] + to[0][:, 2] - start[0][:, 2]
    w, x, y, z = qpos[:, 3:7].unbind(-1)
    c, s = (0.5 * turn).cos(), (0.5 * turn).sin()
    quaternion = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], dim=-1)
    moved = torch.cat([level, height[:, None], quaternion, qpos[:, 7:]], dim=-1)
    return moved, torch.cat([turned(qvel[:, :2]), qvel[:, 2:]], dim=-1)


def depth_in_scene(points: Tensor, tops: Tensor, headings: Tensor, sizes: Tensor) -> Tensor:
    """``[n]`` m: how far bodies must be raised so that none of their points is in a box or the floor.

    Args:
        points: ``[n, P, 3]`` m.
        tops: ``[n, K, 3]`` m. headings: ``[n, K]`` rad. sizes: ``[K, 2]`` m, of the upper faces.
    """
    away = points[:, :, None] - tops[:, None]
    cos, sin = headings.cos()[:, None], headings.sin()[:, None]
    along, across = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    over = (along.abs() < 0.5 * sizes[:, 0]) & (across.abs() < 0.5 * sizes[:, 1])
    depth = torch.where(over & (away[..., 2] > -_DEEPEST), -away[..., 2], 0.0)
    return torch.cat([depth.flatten(1), -points[..., 2]], dim=-1).amax(-1).clamp_min(0.0)
