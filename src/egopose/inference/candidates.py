"""What planners try: perturbations of N bodies' actions over a horizon, and what the simulator makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.humanoid.physics import Array


@dataclass(frozen=True)
class Futures:
    """What M worlds did in H frames.

    Args:
        qpos: ``[H, M, nq]`` after each step.
        qvel: ``[H + 1, M, nv]``, that before the first step too.
        row: ``[H * M]`` of the target motion.
        number: ``[H * M]`` steps into the episode.
        broken: ``[M]`` steps whose physics broke.
        value: ``[M]`` V of the last state.
    """

    qpos: Array
    qvel: Array
    row: Tensor
    number: Tensor
    broken: Tensor
    value: Tensor


@dataclass(frozen=True)
class Tried:
    """Candidates and what came of them. The first is no perturbation, the second the current plan.

    Args:
        candidates: ``[K, N, H, nu]``.
        score: ``[K, N]``; the best has most.
        returns: ``[K, N]`` rewards in the heading frame alone.
        low: ``[K, N]`` m that the head ends below its target.
    """

    candidates: Tensor
    score: Tensor
    returns: Tensor
    low: Tensor

    def joined(self, more: Tried) -> Tried:
        """These and ``more``."""
        return Tried(
            *(torch.cat([mine, theirs]) for mine, theirs in zip(vars(self).values(), vars(more).values(), strict=True))
        )

    def falls(self, drop: float) -> bool:
        """Whether a body's best candidate ends more than ``drop`` m too low."""
        best = self.score.argmax(0)
        return bool((self.low[best, torch.arange(len(best))] > drop).any())
