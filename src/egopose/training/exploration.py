"""How far actions are drawn from their mean while a run goes on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from egopose.envs.aids import ramp


@dataclass(frozen=True)
class SigmaSchedule:
    """Sigma from ``first`` to ``last`` rad over ``steps`` control steps, and exactly ``last`` from then on.

    It is set between iterations, before collecting: what is collected and what learns from it have the same sigma, and
    PPO's ratio begins at one. (Workers that collect ahead keep the probabilities of the sigma they drew with.)

    Args:
        log_sigma: the policy's buffers.
    """

    log_sigma: tuple[Tensor, ...]
    first: float
    last: float
    steps: int

    def set(self, taken: int) -> None:
        """As it should be after ``taken`` control steps."""
        sigma = float(ramp(self.first, self.last, self.steps, torch.tensor(taken)))
        for buffer in self.log_sigma:
            buffer.fill_(math.log(sigma))


def sigma_buffers(policy: nn.Module) -> tuple[Tensor, ...]:
    """The fixed ``log_sigma`` of a policy; none where it is learned."""
    return tuple(buffer for name, buffer in policy.named_buffers() if name.rsplit(".", 1)[-1] == "log_sigma")
