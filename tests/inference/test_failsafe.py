"""The fail-safe on values whose right answer is known."""

from __future__ import annotations

import pytest
import torch

from egopose.core.errors import InputError
from egopose.inference.failsafe import FailSafe, FailSafeSettings


def guarding(num_envs: int, mode: str) -> FailSafe:
    return FailSafe(num_envs, FailSafeSettings(mode, reset_threshold=0.6, fallen_height=0.3))


ACTIVE = torch.ones(2, dtype=torch.bool)
STANDING = torch.tensor([1.6, 1.6])


def test_value_mode_triggers_under_kappa_times_the_mean() -> None:
    guard = guarding(2, "value")
    for _ in range(9):
        assert not guard.update(torch.tensor([10.0, 10.0]), STANDING, ACTIVE).any()
    # With this frame the means are 9.59 and 9.53: the bars stand at 5.754 and 5.718.
    assert guard.update(torch.tensor([5.9, 5.3]), STANDING, ACTIVE).tolist() == [False, True]
    assert guard.confidence[-1].tolist() == pytest.approx([5.9 / 9.59, 5.3 / 9.53])


def test_naive_mode_looks_at_the_head_alone() -> None:
    guard = guarding(2, "naive")
    guard.update(torch.tensor([10.0, 10.0]), STANDING, ACTIVE)
    assert guard.update(torch.tensor([0.1, 10.0]), torch.tensor([1.6, 0.29]), ACTIVE).tolist() == [False, True]


def test_off_never_triggers_but_keeps_the_record() -> None:
    guard = guarding(2, "off")
    guard.update(torch.tensor([10.0, 10.0]), STANDING, ACTIVE)
    assert not guard.update(torch.tensor([0.0, 0.0]), torch.tensor([0.0, 0.0]), ACTIVE).any()
    assert [c.tolist() for c in guard.confidence] == [[1.0, 1.0], [0.0, 0.0]]


def test_worlds_are_apart_and_finished_ones_stay_out() -> None:
    guard = guarding(2, "value")
    guard.update(torch.tensor([10.0, 1.0]), STANDING, ACTIVE)
    only_first = torch.tensor([True, False])
    assert guard.update(torch.tensor([9.0, -5.0]), STANDING, only_first).tolist() == [False, False]
    assert torch.isnan(guard.confidence[-1]).tolist() == [False, True]
    assert guard.update(torch.tensor([9.0, 0.9]), STANDING, ACTIVE).tolist() == [False, False]


def test_no_trigger_while_the_mean_says_nothing() -> None:
    guard = guarding(2, "value")
    for value in (-1.0, -5.0, -9.0):
        assert not guard.update(torch.tensor([value, value]), STANDING, ACTIVE).any()


def test_a_stretch_rated_low_throughout_lowers_the_bar() -> None:
    guard = guarding(1, "value")
    one = torch.ones(1, dtype=torch.bool)
    for _ in range(20):
        guard.update(torch.tensor([10.0]), STANDING[:1], one)
    triggered = [bool(guard.update(torch.tensor([4.0]), STANDING[:1], one)) for _ in range(60)]
    assert triggered[0]
    assert not triggered[-1]


def test_unknown_mode_is_refused() -> None:
    with pytest.raises(InputError, match="value, naive, off"):
        guarding(1, "never")
