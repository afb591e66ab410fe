"""Small changes of a state and what a control step makes of them, against MuJoCo's own."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.humanoid.derivatives import Differences, Simulator, difference, linearised, moved, state_difference
from egopose.motion import rotations as rot


@pytest.fixture(scope="module")
def body() -> StandIn:
    return stand_in()


def poses(body: StandIn, seed: int, count: int = 4) -> np.ndarray:
    rng, nq = np.random.default_rng(seed), body.mj_model.nq
    qpos = rng.normal(size=(count, nq))
    qpos[:, 3:7] = rot.normalize(qpos[:, 3:7])
    return qpos


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.floats(0.0, 2.5))
def test_a_change_is_mujocos(seed: int, size: float) -> None:
    body = stand_in()
    model, rng = body.mj_model, np.random.default_rng(seed)
    qpos, change = poses(body, seed), rng.uniform(-1.0, 1.0, (4, body.mj_model.nv)) * size / np.sqrt(3.0)
    after = moved(qpos, change)
    for row, step, mine in zip(qpos, change, after, strict=True):
        theirs = row.copy()
        mujoco.mj_integratePos(model, theirs, step, 1.0)
        same = np.sign(theirs[3:7] @ mine[3:7])
        theirs[3:7] *= same
        np.testing.assert_allclose(mine, theirs, atol=1e-12)
        back = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, back, 1.0, row, mine)
        np.testing.assert_allclose(difference(mine, row), back, atol=1e-9)
    np.testing.assert_allclose(difference(after, qpos), change, atol=1e-9)


def test_no_change_is_none(body: StandIn) -> None:
    qpos = poses(body, 1)
    assert np.abs(difference(qpos, qpos)).max() < 1e-12
    negated = qpos.copy()
    negated[:, 3:7] *= -1.0  # the same rotation
    assert np.abs(difference(negated, qpos)).max() < 1e-12


def standing(body: StandIn, count: int = 3, height: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    reference, _ = reference_motion(body)  # type: ignore[arg-type]
    qpos, qvel = (reference[key][5 : 5 + count].numpy().copy() for key in ("qpos", "qvel"))
    qpos[:, 2] += height
    return qpos, qvel, qpos[:, 7:] + 0.05


def transition(body: StandIn, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> tuple[Any, Any]:
    """A and B of one physics step by MuJoCo's own central differences."""
    model, data = body.mj_model, mujoco.MjData(body.mj_model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
    mujoco.mj_forward(model, data)
    state, control = np.zeros((2 * model.nv, 2 * model.nv)), np.zeros((2 * model.nv, model.nu))
    mujoco.mjd_transitionFD(model, data, 1e-6, 1, state, control, None, None)
    return state, control


def test_in_the_air_a_physics_step_changes_as_mujoco_says() -> None:
    """Without contacts the step is smooth, so differences of any small size agree with MuJoCo's."""
    body = stand_in(substeps=1)
    qpos, qvel, ctrl = standing(body, height=0.5)
    small = Differences(position=1e-5, velocity=1e-5, control=1e-4)
    simulator = Simulator(body, 16, 1)  # type: ignore[arg-type]
    state, control = linearised(simulator, qpos, qvel, ctrl, small)
    for row in range(len(qpos)):
        theirs = transition(body, qpos[row], qvel[row], ctrl[row])
        np.testing.assert_allclose(state[row], theirs[0], atol=2e-3, rtol=2e-3)
        np.testing.assert_allclose(control[row], theirs[1], atol=2e-3, rtol=2e-3)
    simulator.close()


def test_columns_are_one_sided_differences_of_a_whole_step(body: StandIn) -> None:
    """On the floor as well, each by itself, and the two of the place without a simulation."""
    qpos, qvel, ctrl = standing(body)
    sizes = Differences()
    simulator = Simulator(body, 7, 1)  # type: ignore[arg-type]
    state, control = linearised(simulator, qpos, qvel, ctrl, sizes)
    nv, nu = body.mj_model.nv, body.mj_model.nu
    assert simulator.steps == len(qpos) * (2 * nv + nu - 1)
    plain = simulator.step(qpos, qvel, ctrl)
    for column in range(2 * nv + nu):
        size = sizes.position if column < nv else sizes.velocity if column < 2 * nv else sizes.control
        change = np.zeros((len(qpos), 2 * nv + nu))
        change[:, column] = size
        after = simulator.step(moved(qpos, change[:, :nv]), qvel + change[:, nv : 2 * nv], ctrl + change[:, 2 * nv :])
        expected = state_difference(*after, *plain) / size
        found = state[:, :, column] if column < 2 * nv else control[:, :, column - 2 * nv]
        np.testing.assert_allclose(found, expected, atol=1e-4 * max(1.0, np.abs(expected).max()))
    simulator.close()


def test_a_simulator_steps_any_number_of_states_alike(body: StandIn) -> None:
    qpos, qvel, ctrl = standing(body, count=5)
    results = []
    for worlds in (2, 5, 8):
        simulator = Simulator(body, worlds, 1)  # type: ignore[arg-type]
        results.append(np.concatenate(simulator.step(qpos, qvel, ctrl), axis=1))
        assert simulator.steps == 5
        simulator.close()
    assert (results[0] == results[1]).all()
    assert (results[0] == results[2]).all()
    assert not np.allclose(results[0][:, : body.mj_model.nq], qpos)
