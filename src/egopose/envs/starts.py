"""Where episodes start: pieces of takes, drawn or dealt out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs.start_shares import StartShares


class Piece(NamedTuple):
    """The plainest fragment."""

    take: int
    start: int
    stop: int


def after_context(fragments: Sequence[FragmentLike], context: int, minimum: int = 2) -> list[Piece]:
    """The part of each fragment that can be forecast: from the last of its first ``context`` frames on.

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
    """Deals episodes to worlds. What it learns on the way is in its state."""

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        """Episodes for ``worlds [n]`` (indices)."""
        ...

    def ended(self, start: Tensor, frames: Tensor, fell: Tensor) -> None:
        """Take note of episodes that ended.

        Args:
            start: ``[n]`` global frames they began at.
            frames: ``[n]`` they lasted.
            fell: ``[n]`` whether they ended before their time.
        """
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """All that later episodes depend on, but for the generator."""
        ...

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on from :meth:`state_dict`."""
        ...


class Unlearning:
    """Starts that take no note of how episodes end."""

    def ended(self, start: Tensor, frames: Tensor, fell: Tensor) -> None:
        """See :class:`Starts`."""

    def state_dict(self) -> dict[str, Tensor]:
        """See :class:`Starts`."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """See :class:`Starts`."""


@dataclass(frozen=True)
class AdaptiveStartSettings:
    """See :class:`AdaptiveStarts`; the setting ``task.starts`` where its ``kind`` is ``adaptive``.

    Args:
        bin: frames whose episodes are judged together.
        unit: frames survived that halve how often a bin is drawn.
        rate: of the running estimate: the share of the newest episode in it.
        floor: share of the episodes that start uniformly.

    Raises:
        InputError: a value out of range.
    """

    bin: int
    unit: float
    rate: float
    floor: float

    def __post_init__(self) -> None:
        for name in ("bin", "unit"):
            if not getattr(self, name) > 0:
                raise InputError("task.starts", name, f"must be positive, not {getattr(self, name)}")
        for name in ("rate", "floor"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError("task.starts", name, f"must lie above 0 and be at most 1, not {getattr(self, name)}")


def _bounds(fragments: Sequence[FragmentLike], offsets: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if not fragments:
        raise ValueError("no fragments to start episodes in")
    for f in fragments:
        if not 0 <= f.take < len(offsets) or not 0 <= f.start < f.stop <= int(lengths[f.take]) or f.stop - f.start < 2:
            raise ValueError(f"fragment {f} does not lie within its take, or has less than two frames")
    take = torch.tensor([f.take for f in fragments])
    local = torch.tensor([[f.start, f.stop] for f in fragments])
    return take, offsets[take] + local[:, 0], offsets[take] + local[:, 1]


def _mean_frames(first: Tensor, choices: Tensor, stop: Tensor, horizon: int) -> Tensor:
    """``[N]`` frames an episode has on average that starts at any of ``choices`` frames from ``first`` on."""
    whole = (stop - horizon - first + 1).clamp_min(0).minimum(choices)
    cut = choices - whole
    # Those that the fragment's end cuts short have stop - (first + whole), one less, and so on: a sum of integers.
    longest = stop - first - whole
    return (whole * horizon + cut * longest - cut * (cut - 1) // 2).double() / choices


def _drawn(bounds: Tensor, uniform: Tensor) -> Tensor:
    """Which of the places with cumulative weights ``bounds [N]`` numbers in [0, 1) fall on."""
    return torch.searchsorted(bounds, uniform * bounds[-1], right=True).clamp_max(len(bounds) - 1)


class UniformStarts(Unlearning):
    """All frames that leave enough room are equally likely starts, except for groups of takes with a limit.

    Args:
        fragments: where episodes may lie.
        offsets, lengths: ``[K]`` of the takes.
        horizon: most frames of an episode, the first included (200 in the paper).
        minimum: frames an episode should have at least; fragments shorter than that start at their first frame.
        shares: limits on what groups of takes may have of the frames that episodes see, if none falls; None for none.

    Raises:
        ValueError: no fragments, one outside its take, or a horizon or minimum that leave no step.
    """

    def __init__(
        self,
        fragments: Sequence[FragmentLike],
        offsets: Tensor,
        lengths: Tensor,
        horizon: int,
        minimum: int,
        shares: StartShares | None = None,
    ) -> None:
        if not 2 <= minimum <= horizon:
            raise ValueError(f"2 <= minimum <= horizon must hold, got minimum {minimum}, horizon {horizon}")
        self._take, self._start, self._stop = _bounds(fragments, offsets, lengths)
        self._choices = (self._stop - self._start - minimum + 1).clamp_min(1)
        self._ends = self._choices.cumsum(0)
        self._shift = self._start - (self._ends - self._choices)
        self.horizon = horizon
        self._shares = shares
        self._bounds = None
        if shares is not None:
            frames = _mean_frames(self._start, self._choices, self._stop, horizon)
            self._bounds = shares(self._choices, self._take, frames).cumsum(0)

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        if self._bounds is None:
            pick = torch.randint(int(self._ends[-1]), worlds.shape, generator=generator)
            fragment = torch.searchsorted(self._ends, pick, right=True)
        else:
            draw = torch.rand(2, len(worlds), dtype=torch.float64, generator=generator)
            fragment = _drawn(self._bounds, draw[0])
            choices = self._choices[fragment]
            pick = self._ends[fragment] - choices + (draw[1] * choices).long()
        start = pick + self._shift.index_select(0, fragment)
        stop = torch.minimum(start + self.horizon, self._stop.index_select(0, fragment))
        return Episodes(self._take.index_select(0, fragment), start, stop)


class AdaptiveStarts(UniformStarts):
    """Starts near early falls are drawn more often, by bins of neighbouring frames.

    A bin of ``s`` frames is drawn in proportion to ``s / (n / unit + 1)``, n being a running estimate of the frames its
    episodes survived (Yu, Park & Lee 2021, eq. 13, which counts samples instead). A share ``floor`` of the starts stays
    uniform, so that no start vanishes. Before the first episodes all starts are uniform.

    Args:
        fragments, offsets, lengths, horizon, minimum, shares: see :class:`UniformStarts`.
        settings: see :class:`AdaptiveStartSettings`.
    """

    def __init__(
        self,
        fragments: Sequence[FragmentLike],
        offsets: Tensor,
        lengths: Tensor,
        horizon: int,
        minimum: int,
        settings: AdaptiveStartSettings,
        shares: StartShares | None = None,
    ) -> None:
        super().__init__(fragments, offsets, lengths, horizon, minimum, shares)
        self.settings = settings
        order = self._start.argsort()
        bins = [
            (first, min(first + settings.bin, start + choices), fragment)
            for fragment, start, choices in zip(
                order.tolist(), self._start[order].tolist(), self._choices[order].tolist(), strict=True
            )
            for first in range(start, start + choices, settings.bin)
        ]
        self._first, ends, self._fragment = torch.tensor(bins).T.contiguous().unbind()
        self._size = ends - self._first
        self._frames = _mean_frames(self._first, self._size, self._stop[self._fragment], horizon)
        #: ``[B]`` frames survived from each bin, the running estimate; a whole horizon where nothing fell.
        self.survived = torch.zeros(len(bins), dtype=torch.float64)

    @property
    def probability(self) -> Tensor:
        """``[B]`` of each bin, summing to one."""
        uniform = self._size / self._size.sum()
        urgent = self._size / (self.survived / self.settings.unit + 1)
        drawn = self.settings.floor * uniform + (1 - self.settings.floor) * urgent / urgent.sum()
        if self._shares is None:
            return drawn
        drawn = self._shares(drawn, self._take[self._fragment], self._frames)
        return drawn / drawn.sum()

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        pick = torch.rand(2, len(worlds), dtype=torch.float64, generator=generator)
        drawn = _drawn(self.probability.cumsum(0), pick[0])
        start = self._first[drawn] + (pick[1] * self._size[drawn]).long()
        fragment = self._fragment[drawn]
        return Episodes(self._take[fragment], start, torch.minimum(start + self.horizon, self._stop[fragment]))

    def ended(self, start: Tensor, frames: Tensor, fell: Tensor) -> None:
        """Take note of episodes that ended.

        Args:
            start: ``[n]`` global frames they began at.
            frames: ``[n]`` they lasted.
            fell: ``[n]`` whether a fall ended them; what did not fall counts as a whole horizon.
        """
        number = torch.searchsorted(self._first, start, right=True) - 1
        lasted = torch.where(fell, frames, self.horizon).double()
        for at, value in zip(number.tolist(), lasted.tolist(), strict=True):
            self.survived[at] += self.settings.rate * (value - self.survived[at])

    def state_dict(self) -> dict[str, Tensor]:
        """See :class:`Starts`."""
        return {"survived": self.survived.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """See :class:`Starts`."""
        self.survived = state["survived"].clone()


class WholeFragments(Unlearning):
    """For evaluation: world i runs fragment i (modulo their number) from its first frame to its last."""

    def __init__(self, fragments: Sequence[FragmentLike], offsets: Tensor, lengths: Tensor) -> None:
        self._take, self._start, self._stop = _bounds(fragments, offsets, lengths)

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        fragment = worlds % len(self._take)
        return Episodes(self._take[fragment], self._start[fragment], self._stop[fragment])


def training_starts(
    settings: Mapping[str, Any] | None,
    fragments: Sequence[FragmentLike],
    offsets: Tensor,
    lengths: Tensor,
    horizon: int,
    minimum: int,
    shares: StartShares | None = None,
) -> UniformStarts:
    """The starts that ``task.starts`` asks for.

    Args:
        settings: ``{kind: uniform}``, or ``{kind: adaptive}`` and :class:`AdaptiveStartSettings`; None for uniform.
        fragments, offsets, lengths, horizon, minimum, shares: see :class:`UniformStarts`.

    Raises:
        InputError: another kind, or a setting of it is wrong.
        ValueError: see :class:`UniformStarts`.
    """
    values = dict(settings or {"kind": "uniform"})
    kind = values.pop("kind", None)
    if kind == "adaptive":
        adaptive = from_mapping(AdaptiveStartSettings, values, "task.starts")
        return AdaptiveStarts(fragments, offsets, lengths, horizon, minimum, adaptive, shares)
    if kind != "uniform" or values:
        raise InputError("task.starts", "kind", f"must be uniform, or adaptive with its settings, not {settings!r}")
    return UniformStarts(fragments, offsets, lengths, horizon, minimum, shares)
