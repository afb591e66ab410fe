"""Offsets between knots, distances of states, and damped steps against NumPy's least squares."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.humanoid_stand_in import stand_in

from egopose.core.errors import InputError
from egopose.inference.gauss_newton import (
    Distance,
    DistanceWeights,
    check_steps,
    damped_steps,
    knot_lines,
    single_changes,
    steps_of,
)

BODIES = 12
NONE = dict.fromkeys(("bodies", "feet", "turn", "joints", "linear", "angular", "rates", "acceleration"), 0.0)


def test_knots_make_lines() -> None:
    lines = knot_lines(6, 3, 6)
    np.testing.assert_allclose(lines[0], [1 / 3, 2 / 3, 1, 2 / 3, 1 / 3, 0])
    np.testing.assert_allclose(lines[1], [0, 0, 0, 1 / 3, 2 / 3, 1])
    # Between two knots that are moved alike, nothing bends.
    np.testing.assert_allclose(lines.sum(axis=0)[2:], 1.0)
    np.testing.assert_array_equal(knot_lines(6, 3, 3), lines[:1])


def test_each_change_is_of_one_joint_along_one_line() -> None:
    lines = knot_lines(5, 2, 4)
    changes = single_changes(lines, 3, 0.1)
    assert changes.shape == (2 * 3, 5, 3)
    for number, change in enumerate(changes):
        knot, joint = divmod(number, 3)
        np.testing.assert_allclose(change[:, joint], 0.1 * lines[knot])
        assert not np.delete(change, joint, axis=1).any()


@pytest.mark.parametrize("damping", [0.1, 3.0])
def test_a_step_is_the_damped_least_squares(damping: float) -> None:
    rng = np.random.default_rng(0)
    slopes, residuals = rng.normal(size=(4, 9)), rng.normal(size=9)
    stacked = np.concatenate([slopes.T, np.sqrt(damping) * np.eye(4)])
    wanted = np.linalg.lstsq(stacked, -np.concatenate([residuals, np.zeros(4)]), rcond=None)[0]
    (step,) = damped_steps(slopes, residuals, [damping], reach=10.0)
    np.testing.assert_allclose(step, wanted, atol=1e-12)
    (short,) = damped_steps(slopes, residuals, [damping], reach=0.01)
    np.testing.assert_allclose(short, np.clip(wanted, -0.01, 0.01))


def test_what_broke_has_no_slope_and_a_broken_window_no_step() -> None:
    rng = np.random.default_rng(3)
    base, slopes, sound = rng.normal(size=9), rng.normal(size=(4, 9)), np.array([True, True, False, True, True])
    tried = np.concatenate([base[None], base + 0.1 * slopes])
    tried[2] = np.nan
    wanted = damped_steps(np.delete(slopes, 1, axis=0), base, [2.0], 10.0)
    found = steps_of(tried, sound, 0.1, [2.0], 10.0)
    np.testing.assert_allclose(np.delete(found, 1, axis=1), wanted, atol=1e-9)
    assert found[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert not steps_of(tried, np.zeros(5, dtype=bool), 0.1, [2.0], 10.0).any()


def test_a_distance_has_each_weight_once() -> None:
    humanoid = stand_in()
    rng, model = np.random.default_rng(1), humanoid.mj_model
    qpos = np.zeros((2, model.nq))
    qpos[:, 3] = 1.0
    qpos[1, 7:] = rng.normal(size=model.nu)
    qvel = rng.normal(size=(2, model.nv))
    places = rng.normal(size=(2, BODIES, 3))
    away, places_away = qvel[1] - qvel[0], places[1] - places[0]

    def cost(**weights: float) -> float:
        distance = Distance(humanoid, DistanceWeights(**{**NONE, **weights}), BODIES)
        state = distance.of_state(qpos[1], qvel[1], qpos[0], qvel[0])
        return float((state**2).sum() + (distance.of_bodies(places[1], places[0]) ** 2).sum())

    assert cost(joints=2.0) == pytest.approx(2.0 * (qpos[1, 7:] ** 2).sum())
    assert cost(linear=2.0) == pytest.approx(2.0 * (away[:3] ** 2).sum())
    assert cost(angular=2.0) == pytest.approx(2.0 * (away[3:6] ** 2).sum())
    assert cost(rates=2.0) == pytest.approx(2.0 * (away[6:] ** 2).sum())
    assert cost(bodies=2.0) == pytest.approx(2.0 * (places_away**2).sum(-1).mean())
    feet = list(humanoid.feet)
    assert cost(feet=2.0) == pytest.approx(2.0 * (places_away[feet] ** 2).sum() / BODIES)
    changed = Distance(humanoid, DistanceWeights(**{**NONE, "acceleration": 2.0}), BODIES).of_change(away)
    assert (changed**2).sum() == pytest.approx(2.0 * (10.0 * (away[:3] ** 2).sum() + (away[3:] ** 2).sum()))


@pytest.mark.parametrize("dampings", [(), (1.0, 0.0), (-1.0,)])
def test_dampings_that_cannot_be_are_named(dampings: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="dampings"):
        check_steps("planner", 0.1, 0.1, dampings)
