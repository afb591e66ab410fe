"""PathPose: a path through clusters of training poses, chosen by dynamic programming on egomotion.

After Jiang & Grauman, "Seeing invisible poses" (CVPR 2017), without static scene cues, as Yuan & Kitani 2019, section
4.2, compare with it. The energy of a path k_1 .. k_T of clusters is

    sum_t -log p(k_t | egomotion around t) + w sum_t -log p(k_t | k_{t-1})

with p(k | egomotion) by a classifier on coarse optical flow, and p(b | a) by the transitions counted in the training
poses, smoothed towards poses that are near.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn
from torchrl.modules import MLP

from egopose.motion.rotations import Array


def viterbi(unary: Array, pairwise: Array) -> np.ndarray:
    """The path ``[T]`` of states with the least ``sum_t unary[t, k_t] + sum_t pairwise[k_{t-1}, k_t]``.

    Args:
        unary: ``[T, K]`` costs.
        pairwise: ``[K, K]`` costs of going from the first state to the second.
    """
    frames, states = unary.shape
    cost = unary[0]
    before = np.zeros((frames, states), dtype=np.int64)
    for t in range(1, frames):
        through = cost[:, None] + pairwise
        before[t] = through.argmin(axis=0)
        cost = through[before[t], np.arange(states)] + unary[t]
    path = np.empty(frames, dtype=np.int64)
    path[-1] = cost.argmin()
    for t in range(frames - 1, 0, -1):
        path[t - 1] = before[t, path[t]]
    return path


def cluster_poses(poses: Array, clusters: int, seed: int) -> np.ndarray:
    """Labels ``[N]`` of poses ``[N, P]`` by k-means; without empty clusters, so there may be fewer."""
    _, labels = kmeans2(poses, min(clusters, len(poses)), minit="++", seed=seed)
    return np.unique(labels, return_inverse=True)[1]


def transition_costs(labels: Sequence[np.ndarray], centres: Array, smoothing: float) -> Array:
    """``[K, K]``: ``-log p(b | a)`` from counts, with ``smoothing`` pseudo-counts given to the poses near ``a``.

    They are shared out by ``exp(-d^2 / (2 s^2))``, d the distance of the centres and s the mean distance of a
    centre's nearest neighbour: a transition never seen between like poses is no surprise.

    Args:
        labels: of consecutive frames, one array a fragment.
        centres: ``[K, P]``.
        smoothing: pseudo-counts a row.
    """
    count = len(centres)
    seen = np.zeros((count, count))
    for row in labels:
        np.add.at(seen, (row[:-1], row[1:]), 1.0)
    squared = np.square(centres[:, None] - centres[None]).sum(-1)
    apart = np.where(np.eye(count, dtype=bool), np.inf, squared)
    scale = np.square(np.sqrt(apart.min(axis=1)).mean()) if count > 1 else 1.0
    near = np.exp(-squared / (2.0 * scale)) + 1e-9
    seen += smoothing * near / near.sum(axis=1, keepdims=True)
    return -np.log(seen / seen.sum(axis=1, keepdims=True))


def coarse_flow(flow: Any, grid: int) -> Tensor:
    """``[T, 2 * grid * grid]``: mean flow in the cells of a grid.

    Args:
        flow: ``[T, 2, S, S]`` in image widths a frame.
        grid: cells a side.
    """
    seen = torch.as_tensor(np.asarray(flow)).float()
    return nn.functional.adaptive_avg_pool2d(seen, grid).flatten(1)


def windows_around(table: Tensor, reach: int, stride: int) -> Tensor:
    """``[T, W * D]``: rows ``t - reach, t - reach + stride, .. t + reach`` of ``table [T, D]``, its ends repeated."""
    offsets = torch.arange(-reach, reach + 1, stride)
    rows = (torch.arange(len(table))[:, None] + offsets).clamp(0, len(table) - 1)
    return table[rows].flatten(1)


class PathPose(nn.Module):
    """The clusters, their transitions and the classifier.

    Args:
        clusters: K.
        state_size: S of the humanoid state z.
        grid, reach, stride: see :func:`coarse_flow` and :func:`windows_around`.
        hidden: widths of the classifier's hidden layers.
        dropout: in it.
    """

    centres: Tensor
    transitions: Tensor
    transition_weight: Tensor
    feature_mean: Tensor
    feature_std: Tensor

    def __init__(
        self, clusters: int, state_size: int, grid: int, reach: int, stride: int, hidden: Sequence[int], dropout: float
    ) -> None:
        super().__init__()
        self.grid, self.reach, self.stride = grid, reach, stride
        width = len(range(-reach, reach + 1, stride)) * 2 * grid * grid
        self.register_buffer("centres", torch.zeros(clusters, state_size))
        self.register_buffer("transitions", torch.zeros(clusters, clusters, dtype=torch.float64))
        self.register_buffer("transition_weight", torch.ones((), dtype=torch.float64))
        self.register_buffer("feature_mean", torch.zeros(width))
        self.register_buffer("feature_std", torch.ones(width))
        self.classifier = MLP(
            width, clusters, num_cells=list(hidden), activation_class=nn.ReLU, dropout=dropout or None
        )

    def egomotion(self, flow: Any) -> Tensor:
        """``[T, W]``: what the classifier reads in every frame of a clip's flow ``[T, 2, S, S]``."""
        return windows_around(coarse_flow(flow, self.grid), self.reach, self.stride)

    def forward(self, egomotion: Tensor) -> Tensor:
        """Logits ``[N, K]`` of egomotion ``[N, W]``."""
        return self.classifier((egomotion - self.feature_mean) / self.feature_std)

    @torch.no_grad()
    def path(self, egomotion: Tensor, transition_weight: float | None = None) -> np.ndarray:
        """The clusters ``[T]`` of the cheapest path of one clip."""
        weight = float(self.transition_weight) if transition_weight is None else transition_weight
        unary = -self.forward(egomotion).log_softmax(dim=-1).double().numpy()
        return viterbi(unary, weight * self.transitions.numpy())

    def states(self, flow: Any) -> Tensor:
        """Humanoid states z ``[T, S]`` of a clip's flow ``[T, 2, S, S]``: the mean of each frame's cluster."""
        return self.centres[torch.as_tensor(self.path(self.egomotion(flow)))]
