"""Stretches of the store's frames, and the windows a training epoch is made of."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Span(NamedTuple):
    """Consecutive frames ``start .. stop - 1`` of one take, in global frames of the store."""

    start: int
    stop: int


class Window(NamedTuple):
    """What the BiLSTM sees, ``start .. stop - 1``, and the frames among it that carry loss."""

    start: int
    stop: int
    loss_start: int
    loss_stop: int

    def carries_loss(self) -> Tensor:
        """``[stop - start]`` booleans."""
        frame = torch.arange(self.start, self.stop)
        return (frame >= self.loss_start) & (frame < self.loss_stop)


def split_validation(fragments: Sequence[Span], share: float, margin: int) -> tuple[list[Span], list[tuple[Span, int]]]:
    """Training fragments, and held-out ones with the count of frames before the first that is judged.

    The end of each fragment is held out. The ``margin`` frames before it belong to neither: they are the held-out
    part's context. A fragment too short to give more than ``margin`` frames is trained on whole.
    """
    train, held_out = [], []
    for fragment in fragments:
        count = round(share * (fragment.stop - fragment.start))
        if count <= margin:
            train.append(fragment)
            continue
        cut = fragment.stop - count
        train.append(fragment._replace(stop=cut - margin))
        held_out.append((fragment._replace(start=cut - margin), margin))
    return train, held_out


def cross_fit_blocks(fragments: Sequence[Span], folds: int) -> list[list[Span]]:
    """``folds`` lists of stretches that together are ``fragments``: each cut into as many equal pieces of time.

    A fragment shorter than ``folds`` frames gives some folds nothing.
    """
    cuts = [[f.start + (f.stop - f.start) * k // folds for k in range(folds + 1)] for f in fragments]
    return [[Span(c[k], c[k + 1]) for c in cuts if c[k] < c[k + 1]] for k in range(folds)]


def without_block(fragments: Sequence[Span], block: Sequence[Span], margin: int, shortest: int) -> list[Span]:
    """What is left of ``fragments`` without ``block`` and ``margin`` frames either side of it.

    Args:
        fragments: stretches.
        block: stretches of the same frames, at most one in each fragment.
        margin: frames.
        shortest: frames; shorter pieces are dropped.
    """
    left = []
    for fragment in fragments:
        inside = [b for b in block if fragment.start <= b.start and b.stop <= fragment.stop]
        pieces = [fragment]
        if inside:
            pieces = [Span(fragment.start, inside[0].start - margin), Span(inside[0].stop + margin, fragment.stop)]
        left += [p for p in pieces if p.stop - p.start >= shortest]
    return left


def training_windows(fragments: Sequence[Span], length: int, margin: int, generator: torch.Generator) -> list[Window]:
    """One epoch's windows, in random order.

    Windows tile each fragment at a new random phase; each frame carries loss in exactly one window.
    """
    stride = length - 2 * margin
    windows = []
    for begin, end in fragments:
        phase = int(torch.randint(stride, (1,), generator=generator))
        edges = [begin, *range(begin + stride - phase, end, stride), end]
        for a, b in itertools.pairwise(edges):
            windows.append(Window(max(a - margin, begin), min(b + margin, end), a, b))
    order = torch.randperm(len(windows), generator=generator)
    return [windows[i] for i in order.tolist()]


def group_blocks(fragments: Sequence[Span], groups: Sequence[object], folds: int) -> list[list[Span]]:
    """At most ``folds`` lists of whole fragments that together are ``fragments``, no group in two of them.

    The largest groups are dealt first, each to the list with the fewest frames.

    Args:
        fragments: stretches.
        groups: of each fragment, whatever must stay together: a person.
        folds: lists wanted; there are no more than groups.
    """
    members: dict[object, list[Span]] = {}
    for fragment, group in zip(fragments, groups, strict=True):
        members.setdefault(group, []).append(fragment)

    def frames(spans: Sequence[Span]) -> int:
        return sum(span.stop - span.start for span in spans)

    blocks: list[list[Span]] = [[] for _ in range(min(folds, len(members)))]
    for spans in sorted(members.values(), key=frames, reverse=True):
        min(blocks, key=frames).extend(spans)
    return blocks
