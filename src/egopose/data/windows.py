"""Scores of forecasts: windows of seen frames and unseen future, and the paper's metrics per forecasting horizon.

Yuan & Kitani 2019, section 5 and Tables 1 and 3: a window every second, 30 frames of context and 90 of future; a figure
at horizon h is the mean over the first h seconds of the future, then over the windows of a take, then over takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from egopose.data.fragments import FragmentLike


class ForecastWindow(NamedTuple):
    """Frames ``start .. stop - 1`` of a take, counted within the take: ``context`` seen ones, then ``horizon`` unseen.

    It serves as a fragment wherever one is asked for.
    """

    take: int
    start: int
    context: int
    horizon: int

    @property
    def now(self) -> int:
        """The last frame seen: its state is where a forecast begins, and is no part of it."""
        return self.start + self.context - 1

    @property
    def stop(self) -> int:
        """One past the last frame of the future."""
        return self.start + self.context + self.horizon


def forecast_windows(
    fragments: Sequence[FragmentLike], context: int = 30, horizon: int = 90, every: int = 30
) -> list[ForecastWindow]:
    """Windows that lie whole in a fragment, one each ``every`` frames from the fragment's first.

    Raises:
        ValueError: a count of frames that is not positive.
    """
    if min(context, horizon, every) < 1:
        raise ValueError(f"context, horizon and every must be positive, got {context}, {horizon}, {every}")
    return [
        ForecastWindow(f.take, start, context, horizon)
        for f in fragments
        for start in range(f.start, f.stop - context - horizon + 1, every)
    ]
