"""Where episodes start: pieces of takes, drawn or dealt out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class FragmentLike(Protocol):
    """Frames ``start`` to ``stop`` (exclusive) of take number ``take``, counted within the take."""

    @property
    def take(self) -> int: ...
    @property
    def start(self) -> int: ...
    @property
    def stop(self) -> int: ...


class Piece(NamedTuple):
    """The plainest fragment."""

    take: int
    start: int
    stop: int


def after_context(fragments: Sequence[FragmentLike], context: int, minimum: int = 2) -> list[Piece]:
    """Where forecasts of each fragment can begin and what follows: from the last of its first ``context`` frames on.

    Pieces of fewer than ``minimum`` frames are left out.
    """
    pieces = [Piece(f.take, f.start + context - 1, f.stop) for f in fragments]
    return [piece for piece in pieces if piece.stop - piece.start >= minimum]


@dataclass(frozen=True)
class Episodes:
    """``take [n]``, and global frames ``start [n]`` and ``stop [n]`` (exclusive), int64."""

    take: Tensor
    start: Tensor
    stop: Tensor


class Starts(Protocol):
    """Deals episodes to worlds."""

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        """Episodes for ``worlds [n]`` (indices)."""
        ...


def _bounds(fragments: Sequence[FragmentLike], offsets: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if not fragments:
        raise ValueError("no fragments to start episodes in")
    for f in fragments:
        if not 0 <= f.take < len(offsets) or not 0 <= f.start < f.stop <= int(lengths[f.take]) or f.stop - f.start < 2:
            raise ValueError(f"fragment {f} does not lie within its take, or has less than two frames")
    take = torch.tensor([f.take for f in fragments])
    local = torch.tensor([[f.start, f.stop] for f in fragments])
    return take, offsets[take] + local[:, 0], offsets[take] + local[:, 1]


class UniformStarts:
    """Every frame that leaves room enough is as likely a start as any other.

    Args:
        fragments: where episodes may lie.
        offsets, lengths: ``[K]`` of the takes.
        horizon: most frames of an episode, the first included (200 in the paper).
        minimum: frames an episode should have at least; fragments shorter than that start at their first frame.

    Raises:
        ValueError: no fragments, one outside its take, or a horizon or minimum that leave no step.
    """

    def __init__(
        self, fragments: Sequence[FragmentLike], offsets: Tensor, lengths: Tensor, horizon: int, minimum: int
    ) -> None:
        if not 2 <= minimum <= horizon:
            raise ValueError(f"2 <= minimum <= horizon must hold, got minimum {minimum}, horizon {horizon}")
        self._take, self._start, self._stop = _bounds(fragments, offsets, lengths)
        self._choices = (self._stop - self._start - minimum + 1).clamp_min(1)
        self._ends = self._choices.cumsum(0)
        self.horizon = horizon

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        pick = torch.randint(int(self._ends[-1]), worlds.shape, generator=generator)
        fragment = torch.searchsorted(self._ends, pick, right=True)
        start = self._start[fragment] + pick - (self._ends[fragment] - self._choices[fragment])
        return Episodes(self._take[fragment], start, torch.minimum(start + self.horizon, self._stop[fragment]))


class WholeFragments:
    """For evaluation: world i runs fragment i (modulo their number) from its first frame to its last."""

    def __init__(self, fragments: Sequence[FragmentLike], offsets: Tensor, lengths: Tensor) -> None:
        self._take, self._start, self._stop = _bounds(fragments, offsets, lengths)

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        fragment = worlds % len(self._take)
        return Episodes(self._take[fragment], self._start[fragment], self._stop[fragment])
