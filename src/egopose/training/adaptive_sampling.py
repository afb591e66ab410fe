"""As many tuples of every frame of a clip as can be had: Yu, Park & Lee 2021, section 5.2, equation 13.

Episodes that fall fill a batch with the frames they begin in. So each episode gives a fixed number of consecutive
tuples, and frames of which few have been taken are likelier to be their first:
``P(t) = (1 / (n_t + 1)) / sum_i 1 / (n_i + 1)``, n_t being the tuples of frame t that the buffer holds already.
"""

from __future__ import annotations

import torch
from torch import Tensor


def first_frame_probability(counts: Tensor) -> Tensor:
    """P ``[F]`` of each of F frames, of which the buffer holds ``counts [F]`` tuples (equation 13)."""
    weight = 1.0 / (counts.double() + 1.0)
    return weight / weight.sum()


def sampled_tuples(frame: Tensor, done: Tensor, length: int) -> Tensor:
    """``[M]`` int64 rows of the flattened batch that are learned from, in the order they were taken.

    An episode that began in an earlier batch, or goes on in a later one, counts with the part that is in this one. One
    of up to ``length`` tuples is taken whole. Numbers are drawn from torch's own generator.

    Args:
        frame: ``[N, T]`` int64 the clip's frame of each tuple.
        done: ``[N, T]`` bool whether an episode ends with it.
        length: tuples of each episode, 32 in the paper.
    """
    worlds, steps = frame.shape
    ends = done.clone()
    ends[:, -1] = True
    # Of all worlds in the order in which episodes ended.
    order = ends.T.nonzero().tolist()
    begun = [0] * worlds
    counts = torch.zeros(int(frame.max()) + 1, dtype=torch.int64)
    taken = []
    for step, world in order:
        first, last = begun[world], step + 1
        begun[world] = last
        if last - first > length:
            # Where in the episode the tuples may begin.
            choices = frame[world, first : last - length + 1]
            pick = int(torch.multinomial(first_frame_probability(counts[choices]), 1))
            first, last = first + pick, first + pick + length
        rows = torch.arange(first, last)
        counts.index_add_(0, frame[world, rows], torch.ones(len(rows), dtype=torch.int64))
        taken.append(world * steps + rows)
    return torch.cat(taken)
