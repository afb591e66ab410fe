"""Windows and scores of forecasts against numbers made by hand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from egopose.data.windows import ForecastWindow, forecast_windows
from egopose.evaluation.forecast_metrics import score_forecasts, true_futures


class Piece(NamedTuple):
    take: int
    start: int
    stop: int


def still(*shape: int) -> np.ndarray:
    """A body of two joints that stands still."""
    qpos = np.zeros((*shape, 9))
    qpos[..., 3] = 1.0
    return qpos


def test_windows_lie_whole_in_their_fragment_one_a_second() -> None:
    windows = forecast_windows([Piece(0, 5, 125), Piece(2, 10, 190), Piece(3, 0, 119)])
    assert windows == [ForecastWindow(0, 5, 30, 90), *(ForecastWindow(2, s, 30, 90) for s in (10, 40, 70))]
    assert (windows[0].now, windows[0].stop) == (34, 125)
    with pytest.raises(ValueError, match="positive"):
        forecast_windows([Piece(0, 0, 99)], every=0)


def test_the_future_begins_after_the_last_frame_seen() -> None:
    reference = np.arange(40.0)[:, None].repeat(9, axis=1)
    futures = true_futures(reference, [0, 10], [ForecastWindow(1, 2, 3, 4), ForecastWindow(1, 12, 3, 4)])
    assert futures[:, :, 0].tolist() == [[15, 16, 17, 18], [25, 26, 27, 28]]


def test_figures_are_means_up_to_the_horizon() -> None:
    truth, forecasts = still(1, 90), still(1, 1, 90)
    forecasts[0, 0, 10:, 7] = 0.3  # right for 10 frames, then off: one velocity of 9 rad/s, 270 and -270 rad/s^2
    scores = score_forecasts(truth, [ForecastWindow(0, 0, 30, 90)], forecasts)
    n = np.array([10, 20, 30, 60, 90])
    np.testing.assert_allclose(scores.mean["E_pose"][0], 0.3 * (n - 10) / n, atol=1e-12)
    np.testing.assert_allclose(scores.mean["E_vel"][0], np.where(n > 10, 9.0 / (n - 1), 0.0), atol=1e-9)
    np.testing.assert_allclose(scores.mean["A_accl"][0], np.where(n > 10, 540.0 / 8 / (n - 2), 0.0), atol=1e-8)
    np.testing.assert_array_equal(scores.mean["E_pose"], scores.best["E_pose"])
    hands = score_forecasts(truth, [ForecastWindow(0, 0, 30, 90)], forecasts, hand_dofs=[0])
    assert (hands.mean["E_pose"] == 0).all()


def test_windows_are_averaged_in_a_take_before_takes_are() -> None:
    truth, forecasts = still(3, 30), still(3, 1, 30)
    forecasts[:, 0, :, 7] = np.array([0.1, 0.3, 0.6])[:, None]
    windows = [ForecastWindow(4, 0, 30, 30), ForecastWindow(4, 30, 30, 30), ForecastWindow(7, 0, 30, 30)]
    scores = score_forecasts(truth, windows, forecasts)
    np.testing.assert_allclose(scores.per_take("E_pose")[:, 2], [0.2, 0.6])
    np.testing.assert_allclose(scores.figure("E_pose")[:3], [0.4] * 3)
    assert np.isnan(scores.figure("E_pose")[3:]).all()  # 2 s and 3 s are beyond this forecast


def test_of_several_futures_mean_and_best_are_told_apart() -> None:
    truth, forecasts = still(1, 30), still(1, 2, 30)
    forecasts[0, 0, :10, 7] = 0.5  # off at first
    forecasts[0, 1, 10:, 7] = 0.5  # off later
    scores = score_forecasts(truth, [ForecastWindow(0, 0, 30, 30)], forecasts)
    np.testing.assert_allclose(scores.mean["E_pose"][0, :3], [0.25, 0.25, 0.25])
    np.testing.assert_allclose(scores.best["E_pose"][0, :3], [0.0, 0.25, 0.5 / 3])
    assert scores.samples == 2
    with pytest.raises(ValueError, match="fit"):
        score_forecasts(truth[:, :-1], [ForecastWindow(0, 0, 30, 30)], forecasts)
