"""VGAIL: PPO whose reward is a discriminator's, learned beside it, on the humanoid state under its visual context.

Generative adversarial imitation (Ho & Ermon 2016; Merel et al. 2017 for humanoids): D tells the reference's states from
the policy's, both together with the visual context of their frame; the policy earns ``-log(1 - D(z, phi))``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.models.regressor import state_statistics
from egopose.training.ppo import PPO, PPOSettings

_CLIP = 5.0  # deviations, as the policy's own view of the state


@dataclass(frozen=True)
class DiscriminatorSettings:
    """``conf/algo/vgail.yaml``: ``discriminator``.

    Args:
        hidden: widths.
        learning_rate, weight_decay: AdamW's.
        batch: rows of each kind a gradient step.
        steps: gradient steps an iteration.
        gradient_penalty: weight of the squared gradient at the reference's rows.
        reward_limit: the largest reward.
    """

    hidden: tuple[int, ...]
    learning_rate: float
    weight_decay: float
    batch: int
    steps: int
    gradient_penalty: float
    reward_limit: float

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/algo: discriminator") -> DiscriminatorSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        settings = from_mapping(cls, values, source)
        for name in ("batch", "steps"):
            if getattr(settings, name) < 1:
                raise InputError(source, name, f"must be at least 1, not {getattr(settings, name)}")
        return settings


class Discriminator(nn.Module):
    """Logit ``[B, 1]`` that a state z under a visual context is the reference's.

    Args:
        mean, std: ``[S]`` of the reference's states; buffers.
        context_size: of phi.
        hidden: widths.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor, context_size: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        self.network = MLP(len(mean) + context_size, 1, num_cells=list(hidden), activation_class=nn.ReLU)

    def forward(self, state: Tensor, context: Tensor) -> Tensor:
        """``state [..., S]`` in its own units, ``context [..., C]``."""
        return self.network(torch.cat([((state - self.mean) / self.std).clamp(-_CLIP, _CLIP), context], dim=-1))


class AdversarialPPO(PPO):
    """:class:`PPO` that learns the discriminator from each batch and rewards the batch by it.

    Args:
        actor, critic, settings: see :class:`PPO`.
        discriminator: settings.
        states, contexts: ``[R, S]`` and ``[R, C]`` of the reference's training frames.
        std_floor: of the deviations states are divided by.

    The batch holds ``raw_state`` (z in its own units) and ``visual_context``.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule,
        settings: PPOSettings,
        discriminator: DiscriminatorSettings,
        states: Tensor,
        contexts: Tensor,
        std_floor: float,
    ) -> None:
        super().__init__(actor, critic, settings)
        self.discriminator_settings = discriminator
        self.states, self.contexts = states, contexts
        self.discriminator = Discriminator(
            *state_statistics(states, std_floor), contexts.shape[1], discriminator.hidden
        )
        self.discriminator_optimizer = torch.optim.AdamW(
            self.discriminator.parameters(), lr=discriminator.learning_rate, weight_decay=discriminator.weight_decay
        )

    def advantages(self, batch: TensorDictBase) -> TensorDictBase:
        """As :meth:`PPO.advantages`, after the discriminator's steps and with its reward."""
        after = batch["next"]
        states, contexts = after["raw_state"].flatten(0, 1), after["visual_context"].flatten(0, 1)
        for _ in range(self.discriminator_settings.steps):
            self._discriminator_step(states, contexts)
        # A world whose physics broke earns nothing, as in the environment.
        earned = self.rewards(after["raw_state"], after["visual_context"]) * ~after["diverged"]
        batch["next", "reward"] = earned
        return super().advantages(batch)

    @torch.no_grad()
    def rewards(self, states: Tensor, contexts: Tensor) -> Tensor:
        """``-log(1 - D)`` ``[..., 1]``, at most ``reward_limit``."""
        logit = self.discriminator(states, contexts)
        return nn.functional.softplus(logit).clamp(max=self.discriminator_settings.reward_limit)

    def state(self) -> dict[str, Any]:
        """See :meth:`PPO.state`; the discriminator and its optimiser beside them."""
        return {
            **super().state(),
            "discriminator": self.discriminator,
            "discriminator_optimizer": self.discriminator_optimizer,
        }

    def _discriminator_step(self, states: Tensor, contexts: Tensor) -> None:
        """One step of logistic loss with a penalty on the gradient at the reference's rows (Mescheder et al. 2018, R1).

        Not TorchRL's GAILLoss. It takes probabilities: beyond a logit of 17 a float32 sigmoid is 1, and a discriminator
        that is surely wrong gets no gradient. Its penalty draws the slope of the probability to one between the rows,
        and of the context too. With ``experiment=vgail`` (30 iterations, one seed, its rows in deviations as here) the
        mean action survived 13.9 frames, with this 15.9; the reference's mean logit stood at 5.3 and rose, here at 2.9.
        """
        settings = self.discriminator_settings
        ours = torch.randint(len(states), (settings.batch,))
        theirs = torch.randint(len(self.states), (settings.batch,))
        real = self.states[theirs].requires_grad_()
        said = self.discriminator(real, self.contexts[theirs])
        loss = nn.functional.softplus(-said).mean()
        loss = loss + nn.functional.softplus(self.discriminator(states[ours], contexts[ours])).mean()
        (slope,) = torch.autograd.grad(said.sum(), real, create_graph=True)
        # By the deviations: the gradient in the network's own units.
        loss = loss + settings.gradient_penalty * (slope * self.discriminator.std).square().sum(dim=-1).mean()
        self.discriminator_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.discriminator.parameters(), 10.0)
        if torch.isfinite(norm):
            self.discriminator_optimizer.step()
