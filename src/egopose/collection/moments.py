"""Running moments of several workers, merged exactly (Chan, Golub & LeVeque 1979, the parallel variance)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

#: The names a running normaliser keeps its moments by, in this order (see ``StateNormalizer``).
NAMES = ("count", "mean", "sum_of_squares")


@dataclass(frozen=True)
class Moments:
    """``count`` rows with ``mean [D]`` and ``sum_of_squares [D]`` of their deviations from it, float64."""

    count: int
    mean: Tensor
    sum_of_squares: Tensor

    def __add__(self, other: Moments) -> Moments:
        """The moments of both sets of rows together."""
        total = self.count + other.count
        if total == 0:
            return self
        delta = other.mean - self.mean
        return Moments(
            total,
            self.mean + delta * (other.count / total),
            self.sum_of_squares + other.sum_of_squares + delta.square() * (self.count * other.count / total),
        )

    def __sub__(self, part: Moments) -> Moments:
        """The moments of the rows that are not in ``part``, all of whose rows are in this set.

        Rounding is of the order of this set's own; added to ``part`` again it does not grow.
        """
        rest = self.count - part.count
        if rest <= 0:
            return Moments(0, torch.zeros_like(self.mean), torch.zeros_like(self.mean))
        mean = part.mean + (self.mean - part.mean) * (self.count / rest)
        squares = self.sum_of_squares - part.sum_of_squares
        squares = squares - (mean - part.mean).square() * (part.count * rest / self.count)
        # The spread of still features is rounding noise, of either sign.
        return Moments(rest, mean, squares.clamp_min(0.0))


def merge_states(
    total: Mapping[str, Any], states: Sequence[Mapping[str, Any]], given: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """A transforms' state dict that holds the statistics of all workers.

    Args:
        total: of everything counted before.
        states: of each worker now.
        given: of each worker when it last received them; its counts since then are added to ``total``.

    Returns:
        A state dict as ``total``; entries that are no moments are left as they are.
    """
    out = dict(total)
    for prefix in _prefixes(total):
        moments = _read(total, prefix)
        for state, before in zip(states, given, strict=True):
            moments = moments + (_read(state, prefix) - _read(before, prefix))
        out |= _written(total, prefix, moments)
    return out


def without_counts(state: Mapping[str, Any]) -> dict[str, Any]:
    """The state dict as it was before anything was counted."""
    out = dict(state)
    for prefix in _prefixes(state):
        still = torch.zeros_like(state[f"{prefix}mean"])
        out |= _written(state, prefix, Moments(0, still, still))
    return out


def _prefixes(state: Mapping[str, Any]) -> list[str]:
    """Where in a state dict moments stand: ``transforms.2.`` for ``transforms.2.count`` and its two fellows."""
    candidates = [key.removesuffix(NAMES[0]) for key in state if key.split(".")[-1] == NAMES[0]]
    return [prefix for prefix in candidates if all(f"{prefix}{name}" in state for name in NAMES)]


def _read(state: Mapping[str, Any], prefix: str) -> Moments:
    count, mean, squares = (state[f"{prefix}{name}"] for name in NAMES)
    return Moments(int(count), mean, squares)


def _written(like: Mapping[str, Any], prefix: str, moments: Moments) -> dict[str, Tensor]:
    count = torch.full_like(like[f"{prefix}count"], moments.count)
    return dict(zip([f"{prefix}{name}" for name in NAMES], (count, moments.mean, moments.sum_of_squares), strict=True))
