"""Actor and critic as TensorDict modules for TorchRL (Yuan & Kitani 2019, section 3.1).

Both are an MLP (300, 200) on the humanoid's state and the visual context; they share nothing. The context either comes
with the observation (frozen, from the state regressor) or from a recurrent network of the module's own, trained by PPO.
Forecasting's have a memory of the states so far in place of the state (section 3.2).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.models.context import BidirectionalContext, ForwardContext
from egopose.models.episode_context import EpisodeContext, episode_context_module
from egopose.models.feedback import BalanceFeedback, FeedbackSettings
from egopose.models.mixed_precision import MixedPrecisionMLP
from egopose.models.recurrent import PastContext, past_context_module, state_memory

_log = logging.getLogger(__name__)

_ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "silu": nn.SiLU}


@dataclass(frozen=True)
class ContextSettings:
    """``source``: ``frozen`` (``visual_context`` is in the observation), ``trainable`` (own BiLSTM over the episode),
    ``past`` (own LSTM over the ``horizon`` frames up to the episode's first) or ``none`` (nothing is seen); units and
    frames are not read by ``frozen`` and ``none``, ``padding`` by ``trainable`` only."""

    source: str
    hidden_size: int
    horizon: int
    padding: int


@dataclass(frozen=True)
class MemorySettings:
    """Units of the LSTM over the states so far, one in the actor and one in the critic."""

    hidden_size: int


@dataclass(frozen=True)
class CriticSettings:
    """``privileged``: observation keys only the critic reads (asymmetric actor-critic)."""

    hidden: tuple[int, ...]
    privileged: tuple[str, ...]


@dataclass(frozen=True)
class PolicySettings:
    """The group ``conf/model``.

    Args:
        hidden: widths of the actor's hidden layers.
        activation: ``relu``, ``tanh``, ``elu`` or ``silu``.
        sigma: standard deviation of each action, rad; where it is learned, its start.
        learn_sigma: one trained log-sigma an action.
        final_gain: gain of the orthogonal start of the actor's last layer.
        feedback: see :class:`egopose.models.feedback.FeedbackSettings`, or None for none; reads ``tracking_error``.
        inputs: further observation keys actor and critic read, such as ``tracking_error``.
        context: see :class:`ContextSettings`.
        critic: see :class:`CriticSettings`.
        memory: see :class:`MemorySettings`, or None to read the state itself.
        base: observation key ``[A]`` (rad) that the network's mean is added to, or None for the mean itself.
    """

    hidden: tuple[int, ...]
    activation: str
    sigma: float
    learn_sigma: bool
    final_gain: float
    inputs: tuple[str, ...]
    feedback: FeedbackSettings | None
    context: ContextSettings
    critic: CriticSettings
    memory: MemorySettings | None = None
    base: str | None = None

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> PolicySettings:
        """From the resolved config group. Raises InputError naming the setting that is missing, unknown or wrong."""
        parts: dict[str, Any] = {
            name: from_mapping(part, config[name], f"model.{name}")
            for name, part in (
                ("context", ContextSettings),
                ("critic", CriticSettings),
                ("feedback", FeedbackSettings),
                ("memory", MemorySettings),
            )
            if config.get(name) is not None
        }
        settings = from_mapping(cls, {**config, **parts}, "model")
        if settings.context.source not in ("frozen", "trainable", "past", "none"):
            raise InputError(
                "model", "context.source", f"must be frozen, trainable, past or none, not {settings.context.source!r}"
            )
        if settings.activation not in _ACTIVATIONS:
            raise InputError("model", "activation", f"must be one of {', '.join(_ACTIVATIONS)}")
        if settings.feedback is not None and "tracking_error" not in settings.inputs:
            raise InputError("model", "feedback", "needs tracking_error among model.inputs")
        if not settings.sigma > 0:
            raise InputError("model", "sigma", f"must be positive, not {settings.sigma}")
        return settings


class GaussianHead(nn.Module):
    """MLP to the mean of the action, and a diagonal sigma that does not depend on the state.

    Args:
        in_features: width of the concatenated inputs.
        action_size: degrees of freedom driven.
        settings: of the policy.
        feedback: added to the mean; reads the input number ``feedback_input``.
    """

    def __init__(
        self,
        in_features: int,
        action_size: int,
        settings: PolicySettings,
        feedback: BalanceFeedback | None = None,
        feedback_input: int = 0,
    ) -> None:
        super().__init__()
        self.feedback, self.feedback_input = feedback, feedback_input
        self.mean = _mlp(in_features, action_size, settings.hidden, settings.activation)
        last = self.mean[-1]
        # The start policy is the action's reference pose: any visible offset would make the body fall sooner.
        nn.init.orthogonal_(last.weight, settings.final_gain)
        nn.init.zeros_(last.bias)
        log_sigma = torch.full((action_size,), math.log(settings.sigma))
        if settings.learn_sigma:
            self.log_sigma = nn.Parameter(log_sigma)
        else:
            self.register_buffer("log_sigma", log_sigma)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Inputs ``[..., d_i]`` -> mean ``[..., A]`` and sigma ``[..., A]`` (rad)."""
        mean = self.mean(*inputs)
        if self.feedback is not None:
            mean = mean + self.feedback(inputs[self.feedback_input])
        return mean, self.log_sigma.exp().expand_as(mean)


def build_actor(
    settings: PolicySettings,
    widths: Mapping[str, int],
    action_size: int,
    features_table: Tensor | None = None,
    take_bounds: Tensor | None = None,
    state_key: str = "humanoid_state",
    dof_names: Sequence[str] = (),
) -> TensorDictModuleBase:
    """The policy pi(a | z, phi): a diagonal Gaussian, its mean under ``ExplorationType.DETERMINISTIC``.

    Writes ``loc``, ``scale``, ``action`` and ``action_log_prob``.

    Args:
        settings: of the policy.
        widths: last dimension of each observation key (``humanoid_state``; ``visual_context`` where it is frozen).
        action_size: degrees of freedom driven.
        features_table: ``[F, D]`` visual features, only where the context is not frozen.
        take_bounds: ``[K, 2]`` int64 global frames of the takes, only where the context is not frozen.
        state_key: observation that holds the humanoid's state.
        dof_names: of the actions, in order; read only where the settings have a feedback.

    Raises:
        InputError: an observation or a hinge the settings need is not there.
    """
    context, context_key, context_width = _context(settings, widths, "visual_context", features_table, take_bounds)
    memory, state_key, state_width = _memory(settings, widths, state_key, "policy")
    width = state_width + context_width + sum(_width(widths, key, "inputs") for key in settings.inputs)
    in_keys = [state_key, *context_key, *settings.inputs]
    feedback = None if settings.feedback is None else BalanceFeedback(settings.feedback, dof_names)
    at = in_keys.index("tracking_error") if feedback is not None else 0
    head = GaussianHead(width, action_size, settings, feedback, at)
    gaussian = [TensorDictModule(head, in_keys=in_keys, out_keys=["loc", "scale"])]
    if settings.base is not None:
        if _width(widths, settings.base, "base") != action_size:
            raise InputError(
                "model", "base", f"{settings.base!r} has {widths[settings.base]} numbers, not {action_size}"
            )
        gaussian.append(TensorDictModule(torch.add, in_keys=["loc", settings.base], out_keys=["loc"]))
    module = TensorDictSequential(*context, *memory, *gaussian)
    actor = ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    log_parameter_count("actor", actor)
    return actor


def build_critic(
    settings: PolicySettings,
    widths: Mapping[str, int],
    features_table: Tensor | None = None,
    take_bounds: Tensor | None = None,
    state_key: str = "humanoid_state",
) -> TensorDictModuleBase:
    """The value V(z, phi[, privileged]) -> ``state_value [..., 1]``: a network of its own, with its own context.

    Arguments and errors as :func:`build_actor`. A trainable context is written to ``critic_visual_context``.
    """
    context, context_key, context_width = _context(
        settings, widths, "critic_visual_context", features_table, take_bounds
    )
    memory, state_key, state_width = _memory(settings, widths, state_key, "value")
    privileged = (*settings.inputs, *settings.critic.privileged)
    in_keys = [state_key, *context_key, *privileged]
    width = state_width + context_width
    width += sum(_width(widths, key, "critic.privileged") for key in privileged)
    value = ValueOperator(_mlp(width, 1, settings.critic.hidden, settings.activation), in_keys=in_keys)
    critic = TensorDictSequential(*context, *memory, value)
    log_parameter_count("critic", critic)
    return critic


def _context(
    settings: PolicySettings,
    widths: Mapping[str, int],
    out_key: str,
    features_table: Tensor | None,
    take_bounds: Tensor | None,
) -> tuple[list[TensorDictModule], list[str], int]:
    """Modules that make the context (none where it is frozen), the key it stands under, if any, its width."""
    if settings.context.source == "none":
        return [], [], 0
    if settings.context.source == "frozen":
        return [], ["visual_context"], _width(widths, "visual_context", "context.source")
    if features_table is None or take_bounds is None:
        cause = f"{settings.context.source} needs the store's visual features and take bounds"
        raise InputError("model", "context.source", cause)
    if settings.context.source == "past":
        past = ForwardContext(features_table.shape[1], settings.context.hidden_size)
        seen = PastContext(features_table, past, take_bounds, settings.context.horizon)
        return [past_context_module(seen, out_key)], [out_key], past.output_size
    network = BidirectionalContext(features_table.shape[1], settings.context.hidden_size)
    window = EpisodeContext(features_table, network, take_bounds, settings.context.padding, settings.context.horizon)
    return [episode_context_module(window, out_key)], [out_key], network.output_size


def _memory(
    settings: PolicySettings, widths: Mapping[str, int], state_key: str, owner: str
) -> tuple[list[TensorDictModule], str, int]:
    """Modules that make the memory of the states so far (none where there is none), what is read for the state, and
    its width."""
    width = _width(widths, state_key, "humanoid_state")
    if settings.memory is None:
        return [], state_key, width
    modules, key = state_memory(owner, state_key, width, settings.memory.hidden_size)
    return modules, key, settings.memory.hidden_size


def _width(widths: Mapping[str, int], key: str, setting: str) -> int:
    if key not in widths:
        raise InputError("model", setting, f"needs the observation {key!r}; there are {', '.join(sorted(widths))}")
    return int(widths[key])


def _mlp(in_features: int, out_features: int, hidden: Sequence[int], activation: str) -> MixedPrecisionMLP:
    return MixedPrecisionMLP(
        in_features, out_features, num_cells=list(hidden), activation_class=_ACTIVATIONS[activation]
    )


def log_parameter_count(label: str, module: nn.Module) -> int:
    """Logs and returns the number of parameters, with each direct part's share."""
    parts = {name: sum(p.numel() for p in child.parameters()) for name, child in module.named_children()}
    total = sum(p.numel() for p in module.parameters())
    _log.info("%s: %s parameters (%s)", label, f"{total:,}", ", ".join(f"{k} {v:,}" for k, v in parts.items() if v))
    return total
