"""What a forecasting policy reads (Yuan & Kitani 2019, section 3.2): a context of the past, a memory of its states.

phi, the context, is the last output of a forward LSTM over the frames seen, fixed for the rollout; nu_t, the memory, is
the output of a forward LSTM over the states z_1 .. z_t. That one is TorchRL's ``LSTMModule``: step by step in acting,
its hidden state going from step to step in the TensorDict (:class:`egopose.envs.forecasting_transforms.RecurrentStates`
begins it), and whole sequences ``[N, T]`` at once under ``torchrl.modules.set_recurrent_mode`` while learning.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from egopose.core.errors import InputError
from egopose.models.context import ForwardContext
from egopose.models.episode_context import WindowCache, parameter_version


class PastContext(nn.Module):
    """Context of the frames up to an episode's first: ``episode_start - frames + 1 .. episode_start``.

    Computed once per distinct ``episode_start`` of a batch; anew where gradients flow, kept until a parameter changes
    where they do not.

    Args:
        features_table: ``[F, D]`` visual features of all frames in the store; data, so no part of a checkpoint.
        context: the recurrent network.
        take_bounds: ``[K, 2]`` int64 first and one-past-last global frame of each take, ascending.
        frames: of the past.
    """

    def __init__(self, features_table: Tensor, context: ForwardContext, take_bounds: Tensor, frames: int = 30) -> None:
        super().__init__()
        self.context, self.features_table, self.frames = context, features_table, frames
        self.take_bounds = torch.as_tensor(take_bounds, dtype=torch.int64)
        self._cache = WindowCache(context.output_size)

    def forward(self, episode_start: Tensor) -> Tensor:
        """``episode_start [..., 1]`` int64 global frames -> ``[..., D_context]``.

        Raises:
            InputError: an episode begins with less than ``frames`` frames of its take behind it.
        """
        shape, device = episode_start.shape[:-1], episode_start.device
        starts, row_of = torch.unique(episode_start.reshape(-1).cpu(), return_inverse=True)
        if torch.is_grad_enabled() and any(p.requires_grad for p in self.context.parameters()):
            contexts = self._compute(starts)
        else:
            contexts = self._from_cache(starts)
        return contexts[row_of.to(contexts.device)].to(device).reshape(*shape, -1)

    def _compute(self, starts: Tensor) -> Tensor:
        first = starts - self.frames + 1
        take = (torch.searchsorted(self.take_bounds[:, 0].contiguous(), starts, right=True) - 1).clamp(min=0)
        if (first < self.take_bounds[take, 0]).any() or (starts >= self.take_bounds[take, 1]).any():
            raise InputError("past context", "episode_start", f"leaves less than {self.frames} frames of its take")
        weight = next(self.context.parameters())
        window = self.features_table[first[:, None] + torch.arange(self.frames)]
        return self.context(window.to(weight.device, weight.dtype))

    def _from_cache(self, starts: Tensor) -> Tensor:
        self._cache.expect((*parameter_version(self.context), self.frames))
        missing = [start for start in starts.tolist() if start not in self._cache.offset]
        if missing:
            with torch.no_grad():
                contexts = self._compute(torch.tensor(missing))
            for start, context in zip(missing, contexts, strict=True):
                self._cache.add(start, context[None])
        return self._cache.table[[self._cache.offset[start] for start in starts.tolist()]]


def past_context_module(context: PastContext, out_key: str) -> TensorDictModule:
    """The module as TorchRL sees it: reads ``episode_start``, writes ``out_key``."""
    return TensorDictModule(context, in_keys=["episode_start"], out_keys=[out_key])


class _FirstStep(nn.Module):
    """``is_init``: whether a state is its episode's first."""

    def forward(self, episode_step: Tensor) -> Tensor:
        return episode_step == 0


def hidden_keys(owner: str) -> tuple[str, str]:
    """Keys of the LSTM's two hidden states ``[..., 1, H]``; ``owner`` is ``policy`` or ``value``."""
    return f"{owner}_hidden", f"{owner}_cell"


def state_memory(owner: str, state_key: str, state_size: int, hidden_size: int) -> tuple[list[TensorDictModule], str]:
    """Modules from the states so far to nu_t, and the key ``[..., hidden_size]`` it stands under.

    Reads ``state_key``, ``episode_step`` and :func:`hidden_keys`; writes the hidden states under ``next``.
    """
    hidden, cell = hidden_keys(owner)
    out = f"{owner}_memory"
    lstm = LSTMModule(
        state_size,
        hidden_size,
        in_keys=[state_key, hidden, cell],
        out_keys=[out, ("next", hidden), ("next", cell)],
    )
    return [TensorDictModule(_FirstStep(), in_keys=["episode_step"], out_keys=["is_init"]), lstm], out


def is_recurrent(module: nn.Module) -> bool:
    """Whether it learns from sequences and not from single rows."""
    return any(isinstance(part, LSTMModule) for part in module.modules())


def collecting_policy(actor: TensorDictModuleBase, critic: TensorDictModuleBase) -> TensorDictModuleBase:
    """What a collector runs: the actor, and behind a recurrent one the critic's memory.

    The critic looks at a batch only once it is whole; its hidden state at the batch's first step, amid an episode, has
    to come from when that episode began.
    """
    memories = [part for part in critic.modules() if isinstance(part, LSTMModule)]
    return TensorDictSequential(actor, *memories) if memories else actor
