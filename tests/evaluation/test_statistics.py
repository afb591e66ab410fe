"""Bootstrap intervals: coverage on data whose truth is known, pairing, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from egopose.evaluation.statistics import mean_interval, ratio_interval


def test_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    hits = 0
    for trial in range(300):
        takes, runs = generator.normal(0, 0.5, 30), generator.normal(0, 0.05, (8, 1))
        interval = mean_interval(1 + takes + runs + generator.normal(0, 0.1, (8, 30)), draws=300, seed=trial)
        hits += interval.low <= 1 <= interval.high
    assert 0.89 <= hits / 300 <= 0.985  # a nominal 95 %


def test_ratio_is_narrower_than_its_parts_on_the_same_takes() -> None:
    generator = np.random.default_rng(1)
    difficulty = generator.lognormal(0, 0.8, 40)
    baseline = difficulty[None] * generator.normal(1, 0.02, (1, 40))
    method = 0.8 * difficulty[None] * generator.normal(1, 0.02, (3, 40))
    ratio = ratio_interval(method, baseline)
    assert ratio.value == pytest.approx(0.8, abs=0.02)
    assert ratio.low < ratio.value < ratio.high < 0.85
    spread = mean_interval(method)
    assert (ratio.high - ratio.low) / ratio.value < 0.2 * (spread.high - spread.low) / spread.value


def test_seed_fixes_the_interval_and_counts_are_kept() -> None:
    scores = np.random.default_rng(2).normal(size=(2, 9))
    scores[:, 3] = np.nan
    one, two, other = mean_interval(scores, seed=4), mean_interval(scores, seed=4), mean_interval(scores, seed=5)
    assert one == two
    assert one.low != other.low
    assert (one.runs, one.takes) == (2, 8)
    assert one.value == pytest.approx(np.nanmean(scores))


@pytest.mark.parametrize(
    ("scores", "message"),
    [([1.0, 2.0], "runs, takes"), ([[np.nan]], "no finite"), ([[1.0, np.nan], [1.0, 2.0]], "some runs")],
)
def test_what_cannot_be_averaged_is_refused(scores: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mean_interval(scores)


def test_ratio_needs_the_same_takes() -> None:
    with pytest.raises(ValueError, match="pair up"):
        ratio_interval(np.ones((1, 3)), np.ones((1, 4)))


def test_a_baseline_without_error_on_some_takes_leaves_the_ratio_open_above() -> None:
    with np.errstate(all="raise"):
        found = ratio_interval([[1.0, 1.0, 1.0]], [[0.0, 0.0, 1.0]])
    assert found.high == np.inf
    assert np.isfinite(found.low)
    assert found.value == pytest.approx(3.0)
