"""Iterative LQR: the linear problem as a direct solution has it, and simulations that never get worse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.mocap import default_humanoid
from helpers.walking import walking
from scipy.linalg import solve_discrete_are

from egopose.humanoid.derivatives import Simulator, state_difference
from egopose.humanoid.trajectory import Followed, Nominal, TrackingCost, TrajectoryOptimiser, feed_forward
from egopose.motion.motion import finite_difference

COST = TrackingCost(
    place=20.0,
    height=60.0,
    turn=60.0,
    linear=1.0,
    angular=0.5,
    joints=2.0,
    joint_rates=0.01,
    control=3.0,
    last=3.0,
)
NV, NU, HORIZON, COUNT = 8, 3, 6, 4


@dataclass(frozen=True)
class Linear:
    """A random linear system along a nominal, and how far that is from what is followed."""

    state: np.ndarray
    control: np.ndarray
    wrong: np.ndarray
    added: np.ndarray


def linear(seed: int = 0) -> Linear:
    rng = np.random.default_rng(seed)
    size = 2 * NV
    state = 0.4 * rng.normal(size=(COUNT, HORIZON, size, size)) / np.sqrt(size) + 0.8 * np.eye(size)
    control = rng.normal(size=(COUNT, HORIZON, size, NU))
    wrong, added = 0.1 * rng.normal(size=(COUNT, HORIZON + 1, size)), 0.1 * rng.normal(size=(COUNT, HORIZON, NU))
    return Linear(state.astype(np.float32), control.astype(np.float32), wrong, added)


def solved_at_once(system: Linear, body: int) -> np.ndarray:
    """All changes of the controls ``[H, nu]`` by one least squares: each state as a linear map of all of them."""
    weights, size = np.sqrt(COST.weights(NV)), 2 * NV
    of_controls, rows, targets = np.zeros((size, HORIZON * NU)), [], []
    for t in range(HORIZON + 1):
        factor = np.sqrt(COST.last) if t == HORIZON else 1.0
        rows.append(factor * weights[:, None] * of_controls)
        targets.append(-factor * weights * system.wrong[body, t])
        if t < HORIZON:
            own = np.zeros((NU, HORIZON * NU))
            own[:, t * NU : (t + 1) * NU] = np.eye(NU)
            rows.append(np.sqrt(COST.control) * own)
            targets.append(-np.sqrt(COST.control) * system.added[body, t])
            of_controls = system.state[body, t] @ of_controls + system.control[body, t] @ own
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0].reshape(HORIZON, NU)


def backward(system: Linear) -> tuple[np.ndarray, np.ndarray]:
    optimiser = TrajectoryOptimiser(None, COST)  # type: ignore[arg-type]
    return optimiser.backward(system.state, system.control, system.wrong, system.added)


def test_changes_and_gains_are_the_least_squares_solution() -> None:
    """Rolled out through the linear system, change and gain of each frame give the controls that are best at once."""
    system = linear()
    change, gains = backward(system)
    for body in range(COUNT):
        away, found = np.zeros(2 * NV), []
        for t in range(HORIZON):
            found.append(change[body, t] + gains[body, t] @ away)
            away = system.state[body, t] @ away + system.control[body, t] @ found[-1]
        np.testing.assert_allclose(found, solved_at_once(system, body), atol=2e-3)


def test_gains_are_the_derivative_of_the_best_control() -> None:
    """The first control that is best from a state that lies a little elsewhere, again by least squares."""
    system = linear(1)
    _, gains = backward(system)
    before = solved_at_once(system, 0)[0]
    for column in range(0, 2 * NV, 3):
        moved, size = linear(1), 0.01
        away = np.zeros(2 * NV)
        away[column] = size
        for t in range(HORIZON + 1):
            moved.wrong[0, t] += away
            away = moved.state[0, t] @ away if t < HORIZON else away
        np.testing.assert_allclose((solved_at_once(moved, 0)[0] - before) / size, gains[0, 0, :, column], atol=5e-3)


def test_a_far_horizons_gain_solves_the_riccati_equation() -> None:
    """Of a system that stays the same: SciPy's stationary solution."""
    system = linear(2)
    frames = 60
    state, control = (np.repeat(part[:1, :1], frames, axis=1) for part in (system.state, system.control))
    optimiser = TrajectoryOptimiser(None, COST)  # type: ignore[arg-type]
    _, gains = optimiser.backward(state, control, np.zeros((1, frames + 1, 2 * NV)), np.zeros((1, frames, NU)))
    a, b = state[0, 0].astype(np.float64), control[0, 0].astype(np.float64)
    value = solve_discrete_are(a, b, np.diag(COST.weights(NV)), COST.control * np.eye(NU))
    expected = -np.linalg.solve(b.T @ value @ b + COST.control * np.eye(NU), b.T @ value @ a)
    np.testing.assert_allclose(gains[0, 0], expected, atol=5e-3)


@pytest.mark.parametrize("fault", [np.nan, np.inf, 1e30])
def test_a_step_that_broke_leaves_the_other_bodies_alone(fault: float) -> None:
    system = linear()
    change, gains = backward(system)
    system.control[1, 3] = fault
    broken_change, broken_gains = backward(system)
    others = [0, 2, 3]
    np.testing.assert_allclose(broken_change[others], change[others], atol=1e-6)
    np.testing.assert_allclose(broken_gains[others], gains[others], atol=1e-6)
    assert np.isfinite(broken_change).all()
    assert np.isfinite(broken_gains).all()


def test_the_weights_are_of_their_parts() -> None:
    assert COST.weights(8).tolist() == [20, 20, 60, 60, 60, 60, 2, 2, 1, 1, 1, 0.5, 0.5, 0.5, 0.01, 0.01]


def test_of_two_simulations_each_body_takes_the_cheaper() -> None:
    def made(value: float, cost: list[float]) -> Nominal:
        return Nominal(*(np.full((3, *shape), value) for shape in ((2, 9), (2, 8), (1, 2))), np.array(cost))

    best = made(0.0, [1.0, 2.0, 3.0]).chosen(made(1.0, [2.0, 1.0, 3.0]))
    assert best.cost.tolist() == [1.0, 1.0, 3.0]
    for part in (best.qpos, best.qvel, best.ctrl):
        assert part[:, 0, 0].tolist() == [0.0, 1.0, 0.0]


# --- simulated -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Any:
    """Bodies at the first frames of their motion, and that motion with its feed-forward."""
    body, frames = stand_in(), 10
    reference, _ = reference_motion(body)
    starts = np.array([0, 7])
    rows = starts[:, None] + np.arange(frames + 1)
    qpos, qvel = reference["qpos"].numpy()[rows], reference["qvel"].numpy()[rows]
    ctrl = feed_forward(body, qpos, qvel, np.zeros((*rows.shape, body.mj_model.nu)), 1.0)  # type: ignore[arg-type]
    simulator = Simulator(body, 64, 1)  # type: ignore[arg-type]
    yield body, Followed(qpos, qvel, ctrl), TrajectoryOptimiser(simulator, COST)
    simulator.close()


def test_the_feed_forward_holds_a_joint_against_lag_and_load() -> None:
    """A PD controller's torque at its target: kp (target - q) - kd qdot is the torque of inverse dynamics."""
    body = stand_in()
    rng, nu = np.random.default_rng(0), body.mj_model.nu
    qpos, qvel = np.zeros((1, 3, nu + 7)), np.zeros((1, 3, nu + 6))
    qpos[..., 7:], qvel[..., 6:] = rng.normal(size=(1, 3, nu)), rng.normal(size=(1, 3, nu))
    torques = np.repeat(rng.normal(size=(1, 1, nu)), 3, axis=1)
    target = feed_forward(body, qpos, qvel, torques, 1.0)  # type: ignore[arg-type]
    torque = body.kp * (target - qpos[:, 1:, 7:]) - body.kd * qvel[:, 1:, 6:]
    np.testing.assert_allclose(torque, torques[:, 1:], atol=1e-9)


def test_the_cost_of_a_simulation_is_the_sum_of_its_frames(scene: Any) -> None:
    _, followed, optimiser = scene
    found = optimiser.simulate(followed.qpos[:, 0] + 0.0, followed.qvel[:, 0], followed)
    weights = COST.weights(followed.qvel.shape[-1])
    wrong = state_difference(found.qpos, found.qvel, followed.qpos, followed.qvel)
    each = (weights * wrong**2).sum(-1)
    np.testing.assert_allclose(found.cost, each[:, :-1].sum(1) + COST.last * each[:, -1], rtol=1e-9)
    assert np.array_equal(found.ctrl, followed.ctrl)


def test_an_iteration_never_costs_more_and_soon_costs_less(scene: Any) -> None:
    _, followed, optimiser = scene
    qvel = followed.qvel[:, 0].copy()
    qvel[:, 0] += 0.4
    nominal = optimiser.simulate(followed.qpos[:, 0], qvel, followed)
    costs = [nominal.cost]
    for _ in range(3):
        nominal, _ = optimiser.improve(nominal, followed)
        costs.append(nominal.cost)
    assert (np.diff(costs, axis=0) <= 0).all()
    assert (costs[-1] < 0.8 * costs[0]).all()
    again = optimiser.simulate(followed.qpos[:, 0], qvel, followed, nominal)
    np.testing.assert_allclose(again.cost, nominal.cost, rtol=1e-9)


def test_controls_stay_within_reach(scene: Any) -> None:
    _, followed, optimiser = scene
    change = np.full(followed.ctrl.shape, 5.0)
    nominal = optimiser.simulate(followed.qpos[:, 0], followed.qvel[:, 0], followed)
    found = optimiser.simulate(followed.qpos[:, 0], followed.qvel[:, 0], followed, nominal, change)
    np.testing.assert_allclose(found.ctrl - followed.ctrl, optimiser.reach, atol=1e-12)


def test_gains_bring_a_pushed_walker_back() -> None:
    """From a push that the plan knows nothing of, gains lead nearer to the motion than the plan's controls alone."""
    humanoid, motion, frames = default_humanoid(4), walking(), 7
    qvel = finite_difference(motion.qpos, motion.fps)
    rows = np.array([5])[:, None] + np.arange(frames + 1)
    torques = np.zeros((*rows.shape, humanoid.mj_model.nu))
    ctrl = feed_forward(humanoid, motion.qpos[rows], qvel[rows], torques, 1.0)
    followed = Followed(motion.qpos[rows], qvel[rows], ctrl)
    simulator = Simulator(humanoid, 64, 1)
    optimiser = TrajectoryOptimiser(simulator, COST)
    plan = optimiser.simulate(followed.qpos[:, 0], followed.qvel[:, 0], followed)
    plan, gains = optimiser.improve(plan, followed)
    pushed = followed.qvel[:, 0].copy()
    pushed[:, :2] += 0.3
    alone = optimiser.simulate(followed.qpos[:, 0], pushed, followed, plan)
    helped = optimiser.simulate(followed.qpos[:, 0], pushed, followed, plan, gains=gains)
    simulator.close()
    assert (helped.cost < 0.9 * alone.cost).all()
