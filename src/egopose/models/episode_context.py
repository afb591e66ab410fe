"""The trainable visual context of an episode, inside the policy, so that PPO's gradient reaches the LSTM."""

from __future__ import annotations

from collections.abc import Hashable

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.models.context import BidirectionalContext

# Frames of context kept between steps (134 MB at 128 numbers); more than 1000 episodes of 220 frames.
CACHED_FRAMES = 1 << 18


class EpisodeContext(nn.Module):
    """Context of the frame a world is at, from the window of video its episode lies in.

    SPEC: the BiLSTM sees the episode's 200 frames and 10 frames of padding either side, clipped to the take. A window
    depends only on the episode's first frame, so it is computed once per distinct ``episode_start`` of a batch. Where
    gradients flow it is computed anew; without gradients windows are kept until a parameter changes.

    ``horizon`` and ``lookahead`` are plain attributes, set at test time: ``horizon=None`` reaches to the take's end
    (a single pass over a take), ``lookahead=10`` is the causal form (:meth:`BidirectionalContext.causal`).

    Args:
        features_table: ``[F, D]`` visual features of all frames in the store, float; kept outside the module's buffers,
            for it is data and has no place in a checkpoint.
        context: the recurrent network.
        take_bounds: ``[K, 2]`` int64 first and one-past-last global frame of each take, ascending.
        padding: frames either side of the episode.
        horizon: frames of an episode, or None for the rest of the take.
        lookahead: future frames a context may see, or None for the whole window.

    Raises:
        InputError: ``take_bounds`` are not ascending inside the table.
    """

    def __init__(
        self,
        features_table: Tensor,
        context: BidirectionalContext,
        take_bounds: Tensor,
        padding: int = 10,
        horizon: int | None = 200,
        lookahead: int | None = None,
    ) -> None:
        super().__init__()
        bounds = torch.as_tensor(take_bounds, dtype=torch.int64)
        flat = bounds.flatten()
        if len(flat) == 0 or flat[0] < 0 or flat[-1] > len(features_table) or (flat[1:] < flat[:-1]).any():
            raise InputError("episode context", "take_bounds", f"must ascend within 0..{len(features_table)}")
        self.context = context
        self.features_table = features_table
        self.take_bounds = bounds
        self.padding, self.horizon, self.lookahead = padding, horizon, lookahead
        self._cache = WindowCache(context.output_size)

    def forward(self, episode_start: Tensor, frame: Tensor) -> Tensor:
        """Args: ``episode_start [..., 1]`` and ``frame [..., 1]`` int64 global frames. Returns: ``[..., D_context]``.

        Raises:
            InputError: a frame lies outside its episode's window.
        """
        shape, device = frame.shape[:-1], frame.device
        starts, row_of = torch.unique(episode_start.reshape(-1).cpu(), return_inverse=True)
        first, last = self.windows(starts)
        index = frame.reshape(-1).cpu() - first[row_of]
        if ((index < 0) | (index >= (last - first)[row_of])).any():
            raise InputError("episode context", "frame", "lies outside the window of its episode_start")
        if torch.is_grad_enabled() and any(p.requires_grad for p in self.context.parameters()):
            contexts = self._compute(first, last)
            out = contexts[row_of.to(contexts.device), index.to(contexts.device)]
        else:
            out = self._from_cache(starts, first, last, row_of, index)
        return out.to(device).reshape(*shape, -1)

    def windows(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        """First and one-past-last global frame ``[U]`` of the windows of episodes that begin at ``starts [U]``."""
        take = (torch.searchsorted(self.take_bounds[:, 0].contiguous(), starts, right=True) - 1).clamp(min=0)
        begin, end = self.take_bounds[take, 0], self.take_bounds[take, 1]
        last = end if self.horizon is None else torch.minimum(starts + self.horizon + self.padding, end)
        return torch.maximum(starts - self.padding, begin), last

    def _compute(self, first: Tensor, last: Tensor) -> Tensor:
        """Contexts ``[U, L, D_context]`` of windows, left-aligned."""
        lengths = last - first
        at = (first[:, None] + torch.arange(int(lengths.max()))).clamp(max=len(self.features_table) - 1)
        weight = next(self.context.parameters())
        features = self.features_table[at].to(weight.device, weight.dtype)
        if self.lookahead is None:
            return self.context(features, lengths.to(weight.device))
        # A row's neighbours behind its end must not be seen: each row by itself.
        rows = [self.context.causal(f[None, :n], self.lookahead)[0] for f, n in zip(features, lengths, strict=True)]
        return nn.utils.rnn.pad_sequence(rows, batch_first=True)

    def _from_cache(self, starts: Tensor, first: Tensor, last: Tensor, row_of: Tensor, index: Tensor) -> Tensor:
        self._cache.expect((*parameter_version(self.context), self.padding, self.horizon, self.lookahead))
        keys, lengths = starts.tolist(), last - first
        missing = [i for i, key in enumerate(keys) if key not in self._cache.offset]
        if self._cache.used + int(lengths[missing].sum()) > CACHED_FRAMES:
            self._cache.clear()
            missing = list(range(len(keys)))
        with torch.no_grad():
            for at in range(0, len(missing), 64):
                part = missing[at : at + 64]
                contexts = self._compute(first[part], last[part])
                for row, i in zip(contexts, part, strict=True):
                    self._cache.add(keys[i], row[: int(lengths[i])])
        offset = torch.tensor([self._cache.offset[key] for key in keys], dtype=torch.int64)
        return self._cache.table[(offset[row_of] + index).to(self._cache.table.device)]


def parameter_version(module: nn.Module) -> tuple[Hashable, ...]:
    """A key that changes with the parameters' values.

    Version counters alone are not enough: a copy into ``.data`` (as weight synchronisers do) leaves them as they were;
    so the norms stand beside them. About 0.1 ms for the context network.
    """
    parameters = [p.detach() for p in module.parameters()]
    norms = torch._foreach_norm(parameters, 2.0)
    return (*((p.data_ptr(), p._version) for p in parameters), *torch.stack(norms).tolist())


class WindowCache:
    """Contexts of windows end to end in one growing table; ``offset`` says where each episode's begins."""

    def __init__(self, width: int) -> None:
        self.key: tuple[Hashable, ...] | None = None
        self.offset: dict[int, int] = {}
        self.table = torch.empty(0, width)
        self.used = 0

    def expect(self, key: tuple[Hashable, ...]) -> None:
        """Forgets everything where ``key`` is not the one the contents were made under."""
        if key != self.key:
            self.clear()
            self.key = key

    def clear(self) -> None:
        self.offset.clear()
        self.table = self.table.new_empty(0, self.table.shape[1])
        self.used = 0

    def add(self, start: int, contexts: Tensor) -> None:
        end = self.used + len(contexts)
        if end > len(self.table):
            grown = contexts.new_empty(max(end, 2 * len(self.table)), contexts.shape[1])
            grown[: self.used] = self.table[: self.used]
            self.table = grown
        self.table[self.used : end] = contexts
        self.offset[start] = self.used
        self.used = end


def episode_context_module(context: EpisodeContext, out_key: str = "visual_context") -> TensorDictModule:
    """The module as TorchRL sees it: reads ``episode_start`` and ``frame``, writes ``out_key``."""
    return TensorDictModule(context, in_keys=["episode_start", "frame"], out_keys=[out_key])
