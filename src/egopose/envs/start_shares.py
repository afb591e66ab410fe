"""Shares of the frames that training sees, by groups of takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.core.config import convert
from egopose.core.errors import InputError


@dataclass(frozen=True)
class StartShares:
    """Limits on how much of what episodes see may come from a group of takes. ``data.shares``.

    Args:
        groups: of each take.
        largest: group -> largest share of the frames, above 0 and below 1; groups not named have no limit.

    Raises:
        InputError: a share out of range, or of a group that no take belongs to.
    """

    groups: Sequence[str]
    largest: Mapping[str, float]

    def __post_init__(self) -> None:
        if not isinstance(self.largest, Mapping):
            raise InputError("data", "data.shares", f"must be {{GROUP: SHARE}}, not {self.largest!r:.60}")
        for group, share in self.largest.items():
            if not 0 < convert(share, float, "data.shares", group) < 1:
                raise InputError("data.shares", group, f"must lie above 0 and below 1, not {share}")
            if group not in self.groups:
                there = ", ".join(sorted(set(self.groups) - {""})) or "none"
                raise InputError("data.shares", group, f"no take belongs to this group; there are {there}")

    def __call__(self, weight: Tensor, take: Tensor, frames: Tensor) -> Tensor:
        """The weights with those of too large groups lowered, until each has the share it may have.

        Args:
            weight: ``[N]`` how often each place is drawn, of any sum.
            take: ``[N]`` it lies in.
            frames: ``[N]`` an episode that starts there has on average.

        Returns:
            ``[N]`` float64. Within a group, and among groups below their limit, proportions stay.

        Raises:
            InputError: all places belong to groups that are at their limits, and nothing makes up the rest.
        """
        seen = weight.double() * frames
        members = {g: torch.tensor([self.groups[t] == g for t in take.tolist()]) for g in self.largest}
        sums = {g: float(seen[m].sum()) for g, m in members.items()}
        limited: set[str] = set()
        free = total = float(seen.sum())
        while over := {g for g in set(sums) - limited if sums[g] > self.largest[g] * total * (1 + 1e-12)}:
            limited |= over
            free = float(seen.sum()) - sum(sums[g] for g in limited)
            if free <= 1e-12 * float(seen.sum()):
                cause = "all that is trained on is at its limit, and nothing is left to draw the rest from"
                raise InputError("data.shares", ", ".join(sorted(limited)), cause)
            # A lower total can put another group over its limit, never one below it again.
            total = free / (1 - sum(self.largest[g] for g in limited))
        out = weight.double().clone()
        for g in limited:
            out[members[g]] *= self.largest[g] * total / sums[g]
        return out
