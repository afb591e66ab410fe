"""Error bands of drawn futures, made to hold what they promise on windows kept for that.

A band holds the middle ``level`` of the K futures of each joint at each frame. It is widened about their median by
one scale a frame. The truth of the calibration windows then lies inside as often as the level says (split conformal
prediction, Lei et al. 2018, with the spread of the futures for the scale of the error).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

#: rad; joints that all futures hold still would otherwise have a band without width, which no scale widens.
_NARROWEST = 1e-3


@dataclass(frozen=True)
class Bands:
    """``low``, ``median`` and ``high``, each ``[W, H, D]`` rad."""

    low: Array
    median: Array
    high: Array

    def covers(self, truth: Array) -> NDArray[np.bool_]:
        """``[W, H, D]``: where ``truth`` lies within."""
        return (self.low <= truth) & (truth <= self.high)

    def scaled(self, scale: Array) -> Bands:
        """Wider by ``scale [H]`` about the median."""
        wide = scale[None, :, None]
        low, high = (self.median + wide * (edge - self.median) for edge in (self.low, self.high))
        return Bands(low, self.median, high)


def quantile_bands(futures: Array, level: float = 0.8) -> Bands:
    """Bands of futures ``[W, K, H, D]`` as they were drawn.

    Raises:
        ValueError: fewer than two futures, or a level outside 0..1.
    """
    if futures.shape[1] < 2 or not 0 < level < 1:
        raise ValueError(f"bands need two futures and a level within 0..1, got {futures.shape[1]} and {level}")
    low, median, high = np.quantile(futures, [(1 - level) / 2, 0.5, (1 + level) / 2], axis=1)
    return Bands(np.minimum(low, median - _NARROWEST), median, np.maximum(high, median + _NARROWEST))


def fit_scale(bands: Bands, truth: Array, level: float = 0.8) -> Array:
    """``[H]``: how much wider the bands of the calibration windows must be to cover ``level`` of their truth.

    Args:
        bands: of calibration windows, as drawn.
        truth: ``[W, H, D]``.
        level: share of windows and joints inside, at each frame.
    """
    beyond = np.maximum(
        (truth - bands.median) / (bands.high - bands.median), (bands.median - truth) / (bands.median - bands.low)
    )
    return np.asarray(np.quantile(beyond, level, axis=(0, 2), method="higher"))
