"""Bootstrap intervals over takes and seeds.

Scores stand in an array ``[S, K]``: S runs (training seeds) by K takes, one figure each; a single run is ``[1, K]``.
Runs and takes are both drawn with replacement, so that an interval covers another training run *and* another set of
takes. The figure of a table is the unweighted mean over takes, then over runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Interval:
    """A figure with its percentile interval and how much it rests on."""

    value: float
    low: float
    high: float
    runs: int
    takes: int


def mean_interval(scores: ArrayLike, level: float = 0.95, draws: int = 2000, seed: int = 0) -> Interval:
    """Mean of ``scores [S, K]`` and its percentile bootstrap interval over runs and takes.

    Takes without a figure (NaN in every run) are left out.

    Raises:
        ValueError: not two axes, nothing finite, or a figure missing in some runs only.
    """
    scores = _complete(scores)
    runs, takes = _draws(scores.shape, draws, seed)
    return _interval(float(scores.mean()), _resampled_means(scores, runs, takes), scores.shape, level)


def ratio_interval(
    method: ArrayLike, baseline: ArrayLike, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> Interval:
    """Ratio of means ``mean(method) / mean(baseline)`` on the same takes, with its interval.

    Each draw takes the same takes (and, where both have as many runs, the same runs) for both, so that what makes a
    take hard for both cancels.

    Args:
        method: ``[S, K]``.
        baseline: ``[S', K]`` with S' either S or 1.

    Raises:
        ValueError: other shapes, or nothing finite.
    """
    above, below = np.asarray(method, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    if above.ndim != 2 or below.ndim != 2 or above.shape[1] != below.shape[1] or len(below) not in (1, len(above)):
        raise ValueError(f"scores of the two methods do not pair up: {above.shape} and {below.shape}")
    both = np.isfinite(above).all(axis=0) & np.isfinite(below).all(axis=0)
    above, below = _complete(above[:, both]), _complete(np.broadcast_to(below, above.shape)[:, both])
    runs, takes = _draws(above.shape, draws, seed)
    below_means = _resampled_means(below, runs, takes)
    # A draw of takes on which the baseline makes no error at all says that nothing bounds the ratio above.
    ratios = np.divide(
        _resampled_means(above, runs, takes), below_means, out=np.full(len(below_means), np.inf), where=below_means != 0
    )
    return _interval(float(above.mean() / below.mean()), ratios, above.shape, level)


def _complete(scores: ArrayLike) -> Array:
    array = np.asarray(scores, dtype=np.float64)
    if array.ndim != 2:
        raise ValueError(f"scores must be [runs, takes], got {list(array.shape)}")
    finite = np.isfinite(array)
    if (finite.any(axis=0) != finite.all(axis=0)).any():
        raise ValueError("a take has a figure in some runs and not in others")
    array = array[:, finite.all(axis=0)]
    if array.size == 0:
        raise ValueError("no finite scores")
    return array


def _draws(shape: tuple[int, ...], draws: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    generator = np.random.default_rng(seed)
    return generator.integers(shape[0], size=(draws, shape[0])), generator.integers(shape[1], size=(draws, shape[1]))


def _resampled_means(scores: Array, runs: NDArray[np.int64], takes: NDArray[np.int64]) -> Array:
    return scores[runs[:, :, None], takes[:, None, :]].mean(axis=(1, 2))


def _interval(value: float, resampled: Array, shape: tuple[int, ...], level: float) -> Interval:
    # Between a number and infinity nothing can be interpolated.
    method: Literal["linear", "nearest"] = "linear" if np.isfinite(resampled).all() else "nearest"
    low, high = np.quantile(resampled, [(1 - level) / 2, (1 + level) / 2], method=method)
    return Interval(value, float(low), float(high), runs=shape[0], takes=shape[1])
