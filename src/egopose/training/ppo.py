"""Proximal policy optimisation (Schulman et al. 2017) from TorchRL's GAE and ClipPPOLoss.

A batch is what a collector yields: TensorDict ``[N, T]``, worlds by steps, time last. ``terminated`` (a fall)
bootstraps nothing, ``truncated`` (the time limit) bootstraps from the critic's value of the state it was cut at.
Networks with a memory learn from whole sequences ``[T]``, each begun with the hidden state it was collected with.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
from torchrl.objectives.value import GAE

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.models.mixed_precision import bfloat16_products, has_bfloat16_products
from egopose.models.recurrent import is_recurrent
from egopose.training.adaptive_sampling import sampled_tuples

AUTOCAST = ("auto", "bfloat16", "none")
OPTIMIZERS = ("adam", "nesterov")


class TrainingDiverged(RuntimeError):
    """Minibatch after minibatch gave a loss or gradient that is not finite."""


@dataclass(frozen=True)
class PPOSettings:
    """See ``conf/algo`` for values and their sources.

    Args:
        gamma: discount a step.
        lmbda: GAE's lambda.
        clip_epsilon: the ratio's clip.
        entropy_coeff: weight of the entropy bonus; 0 for none.
        epochs: passes over a batch.
        minibatch_size: steps in the environment a gradient step learns from; None for the full batch. Networks with a
            memory take as many whole sequences as that makes, at least one.
        policy_lr: the optimiser's step size for the actor.
        value_lr: the optimiser's step size for the critic.
        policy_grad_norm: the actor's gradient is scaled down to this norm.
        value_grad_norm: the same for the critic; None for no limit.
        normalize_advantage: to zero mean and unit deviation over the batch.
        target_kl: after each epoch TorchRL's KLAdaptiveLR adapts the actor's step size to keep KL(old || new), over the
            rows of one minibatch, near this; None to keep it.
        policy_lr_range: bounds of the adapted step size.
        smoothness: weight of the mean action's squared distance (summed over actions, rad^2) from the mean of those a
            step before and after it; 0 for none.
        max_nonfinite: gradient steps in a row that may be skipped for values that are not finite.
        autocast: ``bfloat16``: the MLPs learn in it, all else in float32; ``none``: float32 throughout; ``auto``:
            bfloat16 where the processor multiplies it. Runs from before this setting go on without.
        optimizer: ``adam``, or ``nesterov``: gradient descent with that momentum.
        momentum: of ``nesterov``.
        adaptive_sampling: tuples of each episode that are learned from, see
            :func:`egopose.training.adaptive_sampling.sampled_tuples`; None for all.
        truncation_bootstraps: whether a time limit bootstraps from the critic; False where nothing comes after it, as
            after a clip's end.
    """

    gamma: float
    lmbda: float
    clip_epsilon: float
    entropy_coeff: float
    epochs: int
    minibatch_size: int | None
    policy_lr: float
    value_lr: float
    policy_grad_norm: float
    value_grad_norm: float | None
    normalize_advantage: bool
    target_kl: float | None
    policy_lr_range: tuple[float, float]
    smoothness: float
    max_nonfinite: int
    autocast: str = "none"
    optimizer: str = "adam"
    momentum: float = 0.9
    adaptive_sampling: int | None = None
    truncation_bootstraps: bool = True

    @classmethod
    def from_config(cls, values: Any, source: str = "conf/algo") -> PPOSettings:
        """From a resolved config group; keys of other users are left alone.

        Raises:
            InputError: a key is missing or its value of the wrong kind or range; names it.
        """
        settings = from_mapping(cls, {f.name: values.get(f.name, ...) for f in fields(cls)}, source)
        settings._check(source)
        return settings

    @property
    def in_bfloat16(self) -> bool:
        """What :attr:`autocast` comes to on this processor."""
        return self.autocast == "bfloat16" or (self.autocast == "auto" and has_bfloat16_products())

    def _check(self, source: str) -> None:
        if self.autocast not in AUTOCAST:
            raise InputError(source, "autocast", f"must be one of {', '.join(AUTOCAST)}, not {self.autocast!r}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(source, "optimizer", f"must be {' or '.join(OPTIMIZERS)}, not {self.optimizer!r}")
        if not 0 < self.momentum < 1:
            raise InputError(source, "momentum", f"must lie between 0 and 1, not {self.momentum}")
        if self.adaptive_sampling is not None and self.adaptive_sampling < 1:
            raise InputError(source, "adaptive_sampling", f"must be null or at least 1, not {self.adaptive_sampling}")
        for name in ("policy_lr", "value_lr", "policy_grad_norm", "clip_epsilon"):
            if getattr(self, name) <= 0:
                raise InputError(source, name, f"must be positive, not {getattr(self, name)}")
        for name in ("gamma", "lmbda"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(source, name, f"must lie in 0..1, not {getattr(self, name)}")
        for name in ("epochs", "max_nonfinite"):
            if getattr(self, name) < 1:
                raise InputError(source, name, f"must be at least 1, not {getattr(self, name)}")
        if self.target_kl is not None and self.target_kl <= 0:
            raise InputError(source, "target_kl", f"must be positive or null, not {self.target_kl}")
        low, high = self.policy_lr_range
        if not 0 < low <= high:
            raise InputError(source, "policy_lr_range", f"must be two positive numbers in order, not {[low, high]}")
        if self.minibatch_size is not None and self.minibatch_size < 2:
            raise InputError(source, "minibatch_size", f"must be null or at least 2, not {self.minibatch_size}")


class PPO:
    """The learner: advantages, gradient steps, optimisers.

    Args:
        actor: a probabilistic module from observations to ``action``, its log-probability and distribution parameters.
        critic: from observations to ``state_value [..., 1]``.
        settings: see :class:`PPOSettings`.
    """

    def __init__(
        self, actor: ProbabilisticTensorDictSequential, critic: TensorDictModule, settings: PPOSettings
    ) -> None:
        self.actor, self.critic, self.settings = actor, critic, settings
        self.in_bfloat16 = settings.in_bfloat16
        self.recurrent = is_recurrent(actor) or is_recurrent(critic)
        if self.recurrent and settings.adaptive_sampling is not None:
            raise InputError("conf/algo", "adaptive_sampling", "takes tuples apart: not for networks with a memory")
        # Of the actor only its distribution: `_losses` runs its network, once for all that reads the mean action.
        self.loss = ClipPPOLoss(
            actor.module[-1],
            critic,
            functional=False,
            clip_epsilon=settings.clip_epsilon,
            entropy_bonus=settings.entropy_coeff > 0,
            entropy_coeff=settings.entropy_coeff if settings.entropy_coeff > 0 else None,
            critic_coeff=1.0,
            loss_critic_type="l2",
            # Its own is of each minibatch while the critic moves; `update` takes one of the whole batch before.
            log_explained_variance=False,
        )
        # Without a network it reads the values that `_values` has written.
        self.gae = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=None)
        # Two sets of parameters, two step sizes: a module that both networks shared would be stepped twice.
        self.policy_parameters = [p for p in actor.parameters() if p.requires_grad]
        self.value_parameters = [p for p in critic.parameters() if p.requires_grad]
        if {id(p) for p in self.policy_parameters} & {id(p) for p in self.value_parameters}:
            raise ValueError("actor and critic share parameters; each needs its own")
        self.policy_optimizer = _optimizer(self.policy_parameters, settings.policy_lr, settings)
        self.value_optimizer = _optimizer(self.value_parameters, settings.value_lr, settings)
        # Its only state is the step size, which the optimiser's own state holds.
        self.step_size: KLAdaptiveLR | None = None
        if settings.target_kl is not None:
            low, high = settings.policy_lr_range
            self.step_size = KLAdaptiveLR(self.policy_optimizer, settings.target_kl, min_lr=low, max_lr=high)
        #: Whether the critic alone learns.
        self.policy_held = False
        self._nonfinite_in_a_row = 0
        #: What a gradient step reads of a row.
        self._read = [*actor.in_keys, *critic.in_keys, "action", "action_log_prob", "advantage", "value_target"]
        if settings.smoothness > 0:
            self._read.append("smooth_loc")

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase) -> TensorDictBase:
        """Rows for the update with what the losses read, ``advantage`` and ``value_target`` among it.

        They are ``[N * T]`` (fewer with ``adaptive_sampling``), or sequences ``[N, T]`` where a network has a memory.

        Args:
            batch: ``[N, T]`` as collected.
        """
        self._values(batch)
        if not self.settings.truncation_bootstraps:
            batch = batch.copy()  # not of the tensors: what is collected goes on saying which episodes fell
            batch["next", "terminated"] = batch["next", "done"]
        self.gae(batch)
        if self.in_bfloat16:
            self._act_again(batch)
        names = [*self._read, *self.loss.in_keys, "state_value"]
        if self.settings.smoothness > 0:
            batch["smooth_loc"] = _between_neighbours(batch["loc"], batch["next", "done"])
        rows = batch.select(*[n for n in names if _root(n) != "next"], strict=False)
        rows = rows if self.recurrent else rows.reshape(-1)
        if self.settings.adaptive_sampling is not None:
            frame, done = batch["frame"].squeeze(-1), batch["next", "done"].squeeze(-1)
            rows = _taken(rows, sampled_tuples(frame, done, self.settings.adaptive_sampling))
        advantage = rows["advantage"]
        if self.settings.normalize_advantage:
            rows["advantage"] = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        return rows

    def _act_again(self, batch: TensorDictBase) -> None:
        """Mean actions and log-probabilities as the update sees them.

        They were collected in float32. Against those the ratio would not begin at 1, the less so the larger the mean
        actions: after 12 iterations it was off by up to 0.04 (0.006 by deviation), the KL by 2e-5.
        """
        old = self._distribution_entries(batch)
        batch.update(old)
        batch["action_log_prob"] = self.actor.build_dist_from_params(old).log_prob(batch["action"])

    def _distribution_entries(self, rows: TensorDictBase) -> TensorDictBase:
        """``loc`` and ``scale`` of the policy now."""
        with set_recurrent_mode(self.recurrent), bfloat16_products(self.in_bfloat16):
            return self.actor.get_dist_params(rows.select(*self.actor.in_keys)).select("loc", "scale")

    def _values(self, batch: TensorDictBase) -> None:
        """Write ``state_value [N, T, 1]`` of every state and of the one after it.

        What follows a step is the state of the next column, unless an episode or the batch ends there: only those are
        looked at by themselves. (TorchRL's ``shifted=True`` is wrong where a row holds resets, ``shifted=False`` looks
        at every state twice.)

        In float32 always: rounded by themselves, the values of neighbouring states would add noise to each advantage.
        """
        with set_recurrent_mode(self.recurrent):
            value = self.critic(batch.select(*self.critic.in_keys))["state_value"]
        ends = batch["next", "done"].squeeze(-1).clone()
        ends[:, -1] = True
        after = value.roll(-1, dims=1)
        after[ends] = self.critic(batch["next"].select(*self.critic.in_keys)[ends])["state_value"]
        batch["state_value"], batch["next", "state_value"] = value, after

    def update(self, rows: TensorDictBase) -> dict[str, float]:
        """All epochs over the rows of :meth:`advantages`; returns the iteration's figures.

        Raises:
            TrainingDiverged: more than ``max_nonfinite`` gradient steps in a row had to be skipped.
        """
        sums: dict[str, list[Tensor]] = defaultdict(list)
        explained = _explained_variance(rows)
        skipped, kl = 0, 0.0
        learned = rows.select(*self._read)
        for epoch in range(self.settings.epochs):
            minibatches = self._minibatches(rows)
            for index in minibatches:
                figures = self._gradient_step(learned if index is None else _taken(learned, index))
                if figures is None:
                    skipped += 1
                    continue
                for name, value in figures.items():
                    sums[name].append(value)
            if self.step_size is not None or epoch == self.settings.epochs - 1:
                # A fresh draw of rows every epoch, and a quarter of the cost of all at four minibatches.
                first = minibatches[0]
                kl = self.divergence(rows if first is None else _taken(rows, first))
                # TorchRL raises where it is not finite. One that overflowed is too large; NaN is `_gradient_step`'s.
                if self.step_size is not None and not math.isnan(kl) and not self.policy_held:
                    self.step_size.step(min(kl, torch.finfo(torch.float32).max))
        out = {name: float(torch.stack(values).mean()) for name, values in sums.items()}
        return out | {
            "kl": kl,
            "explained_variance": explained,
            "policy_lr": self.policy_optimizer.param_groups[0]["lr"],
            "skipped_minibatches": float(skipped),
        }

    @torch.no_grad()
    def divergence(self, rows: TensorDictBase) -> float:
        """Mean KL(policy that collected ``rows`` || policy now), in closed form."""
        old = self.actor.build_dist_from_params(rows)
        new = self.actor.build_dist_from_params(self._distribution_entries(rows))
        return float(torch.distributions.kl_divergence(old, new).mean())

    def state(self) -> dict[str, Any]:
        """The objects whose ``state_dict`` a checkpoint keeps, by component name."""
        return {
            "policy": self.actor,
            "critic": self.critic,
            "policy_optimizer": self.policy_optimizer,
            "value_optimizer": self.value_optimizer,
        }

    def _minibatches(self, rows: TensorDictBase) -> list[Tensor | None]:
        size, count = self.settings.minibatch_size, len(rows)
        if size is None or size >= rows.numel():
            return [None]
        size = max(1, size // rows[0].numel())
        parts = torch.randperm(count).split(size)
        # A short rest would be a gradient step of its own, as long as the others and noisier.
        return list(parts if len(parts[-1]) == size else parts[:-1])

    def _gradient_step(self, rows: TensorDictBase) -> dict[str, Tensor] | None:
        """One step of critic and actor, or None where loss or gradient was not finite and nothing was stepped."""
        losses, roughness = self._losses(rows)
        policy_loss = losses["loss_objective"] + losses.get("loss_entropy", 0.0)
        policy_loss = policy_loss + self.settings.smoothness * roughness
        self.policy_optimizer.zero_grad()
        self.value_optimizer.zero_grad()
        # The networks share nothing, so one backward pass gives both gradients, and the order of the steps is the
        # paper's: value, then policy.
        (policy_loss + losses["loss_critic"]).backward()
        value_limit = self.settings.value_grad_norm
        value_norm = torch.nn.utils.clip_grad_norm_(
            self.value_parameters, float("inf") if value_limit is None else value_limit
        )
        policy_norm = torch.nn.utils.clip_grad_norm_(self.policy_parameters, self.settings.policy_grad_norm)
        if not torch.isfinite(policy_norm + value_norm + policy_loss + losses["loss_critic"]):
            self._nonfinite_in_a_row += 1
            if self._nonfinite_in_a_row > self.settings.max_nonfinite:
                raise TrainingDiverged(
                    f"{self._nonfinite_in_a_row} gradient steps in a row had a loss or gradient that is not finite "
                    f"(policy loss {policy_loss.item():g}, value loss {losses['loss_critic'].item():g}); "
                    "lower algo.policy_lr or look for non-finite observations"
                )
            return None
        self._nonfinite_in_a_row = 0
        self.value_optimizer.step()
        if not self.policy_held:
            self.policy_optimizer.step()
        return {
            "policy_loss": policy_loss.detach(),
            "roughness": roughness.detach(),
            "value_loss": losses["loss_critic"].detach(),
            "clip_fraction": losses["clip_fraction"],
            "policy_grad_norm": policy_norm,
            "value_grad_norm": value_norm,
        }

    def _losses(self, rows: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """TorchRL's losses, and the mean squared distance of the mean actions from those of their neighbours, rad^2.

        The distance is zero where it has no weight. A policy paid for not falling alone answers every wobble of the
        state with a jerk (Mysore et al. 2021, "Regularizing action policies for smooth control", eq. 1, with the
        neighbours' actions as they were collected).
        """
        now = self._distribution_entries(rows)
        with set_recurrent_mode(self.recurrent), bfloat16_products(self.in_bfloat16):
            losses = self.loss(rows.copy().update(now))
        if self.settings.smoothness <= 0:
            return losses, torch.zeros(())
        return losses, (now["loc"] - rows["smooth_loc"]).square().sum(dim=-1).mean()


def _optimizer(parameters: list[torch.nn.Parameter], lr: float, settings: PPOSettings) -> torch.optim.Optimizer:
    if settings.optimizer == "adam":
        return torch.optim.Adam(parameters, lr=lr, fused=True)
    return torch.optim.SGD(parameters, lr=lr, momentum=settings.momentum, nesterov=True, fused=True)


def _between_neighbours(loc: Tensor, done: Tensor) -> Tensor:
    """Mean of the actions ``loc [N, T, A]`` a step before and after each, within its episode; alone, the action itself.

    Args:
        loc: mean actions.
        done: ``[N, T, 1]`` whether an episode ends with the step.
    """
    before, after = torch.zeros_like(done), torch.zeros_like(done)
    before[:, 1:] = after[:, :-1] = ~done[:, :-1]
    total = before * loc.roll(1, dims=1) + after * loc.roll(-1, dims=1)
    count = before.int() + after.int()
    return torch.where(count > 0, total / count.clamp_min(1), loc)


def _taken(rows: TensorDictBase, index: Tensor) -> TensorDictBase:
    """``rows[index]``, in less than half of its time."""
    return rows.apply(lambda entry: entry.index_select(0, index), batch_size=[len(index), *rows.batch_size[1:]])


def _root(key: Any) -> Any:
    return key[0] if isinstance(key, tuple) else key


def _explained_variance(rows: TensorDictBase) -> float:
    """1 - var(target - value) / var(target), of the critic before the update."""
    target, value = rows["value_target"], rows["state_value"]
    return float(1 - (target - value).var() / target.var().clamp_min(1e-12))
