"""Scores of forecasts: windows of seen frames and unseen future, and the paper's metrics per forecasting horizon.

Yuan & Kitani 2019, section 5 and Tables 1 and 3: a window every second, 30 frames of context and 90 of future; a figure
at horizon h is the mean over the first h seconds of the future, then over the windows of a take, then over takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.data.windows import ForecastWindow
from egopose.evaluation import metrics
from egopose.motion.rotations import Array

#: Seconds, Table 3.
HORIZONS = (1 / 3, 2 / 3, 1.0, 2.0, 3.0)
METRICS = ("E_pose", "E_vel", "A_accl")


def true_futures(reference: Array, offsets: Sequence[int], windows: Sequence[ForecastWindow]) -> Array:
    """``[W, H, nq]``: what came after each window's context.

    Args:
        reference: ``[F, nq]`` qpos of all frames of the store (``store.reference["qpos"]``).
        offsets: first frame of each take in it.
        windows: all of one horizon H.
    """
    return np.stack([np.asarray(reference[offsets[w.take] + w.now + 1 : offsets[w.take] + w.stop]) for w in windows])


@dataclass(frozen=True)
class ForecastScores:
    """Figures of one method on windows.

    Args:
        takes: ``[W]`` take of each window.
        horizons: ``[R]`` seconds.
        samples: K, futures a window.
        mean: metric -> ``[W, R]``, the mean over the K futures of a window.
        best: metric -> ``[W, R]``, the future with the smallest E_pose at that horizon (its E_vel and A_accl, too).

    A horizon longer than the forecast is NaN. For K = 1 both are the same.
    """

    takes: NDArray[np.int64]
    horizons: Array
    samples: int
    mean: Mapping[str, Array]
    best: Mapping[str, Array]

    def per_take(self, metric: str, of: str = "mean") -> Array:
        """``[N, R]``: mean over the windows of each of the N takes that have windows, in order of the take's number."""
        table = (self.mean if of == "mean" else self.best)[metric]
        return np.stack([table[self.takes == take].mean(axis=0) for take in np.unique(self.takes)])

    def figure(self, metric: str, of: str = "mean") -> Array:
        """``[R]``: unweighted mean over takes."""
        return np.asarray(self.per_take(metric, of).mean(axis=0))


def score_forecasts(
    truth: Array,
    windows: Sequence[ForecastWindow],
    forecasts: Array,
    hand_dofs: Sequence[int] = (),
    fps: float = 30.0,
    horizons: Sequence[float] = HORIZONS,
) -> ForecastScores:
    """E_pose, E_vel and A_accl of every window at every horizon.

    At a horizon of n frames: E_pose over the first n frames, E_vel over the n - 1 differences among them, A_accl (of
    the forecast alone, as in the authors' program) over the n - 2 differences of those.

    Args:
        truth: ``[W, H, nq]``, see :func:`true_futures`.
        windows: W.
        forecasts: ``[W, K, H, nq]``, K futures a window, frame 0 being the first unseen one.
        hand_dofs: columns of the joint values that belong to the hands; zeroed in both.
        fps: frames per second.
        horizons: seconds, each of at least 3 frames.

    Raises:
        ValueError: shapes that do not fit, or a horizon of fewer than 3 frames.
    """
    count, samples, frames = forecasts.shape[:3]
    if truth.shape != (count, frames, forecasts.shape[3]) or len(windows) != count or samples < 1:
        raise ValueError(f"forecasts {forecasts.shape}, truth {truth.shape} and {len(windows)} windows do not fit")
    ends = [round(h * fps) for h in horizons]
    if min(ends) < 3:
        raise ValueError("a horizon must have at least 3 frames")
    table = np.full((len(METRICS), count, samples, len(ends)), np.nan)
    for w in range(count):
        for k in range(samples):
            future = forecasts[w, k]
            curves = (
                metrics.pose_error(future, truth[w], hand_dofs),
                metrics.velocity_error(future, truth[w], hand_dofs, fps),
                metrics.acceleration(future, hand_dofs, fps),
            )
            for r, end in enumerate(ends):
                if end <= frames:
                    table[:, w, k, r] = [curve[: end - lost].mean() for lost, curve in enumerate(curves)]
    chosen = np.nan_to_num(table[0], nan=np.inf).argmin(axis=1)
    best = np.take_along_axis(table, chosen[None, :, None, :], axis=2)[:, :, 0]
    return ForecastScores(
        np.array([w.take for w in windows]),
        np.array(horizons, dtype=np.float64),
        samples,
        dict(zip(METRICS, table.mean(axis=2), strict=True)),
        dict(zip(METRICS, best, strict=True)),
    )
