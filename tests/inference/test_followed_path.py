"""The path that bodies follow: where it comes from, where it lies in the world, and restarts on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, build_problem, environment, group
from helpers.humanoid_stand_in import reference_motion, stand_in
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from egopose.core.errors import InputError
from egopose.envs.imitation import ImitationProblem
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import Followed, global_frame
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.estimator import Estimate, estimate_takes, restart_path
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.followed_path import FollowedPath
from egopose.models.pose_regression import integrated_path
from egopose.motion import rotations as rot
from egopose.training.survival import base_tracking

DT = 1.0 / 30.0
LENGTHS = (40, 25)


def qpos_at(place: Any, heading: Any, nq: int = 8) -> Tensor:
    """Bodies ``[N, nq]`` that stand and face so."""
    heading = torch.as_tensor(heading, dtype=torch.float64)
    out = torch.zeros(len(heading), nq, dtype=torch.float64)
    out[:, :2], out[:, 2] = torch.as_tensor(place, dtype=torch.float64), 0.9
    out[:, 3], out[:, 6] = torch.cos(heading / 2), torch.sin(heading / 2)
    return out


def problem_of(path: Tensor | None = None) -> ImitationProblem:
    humanoid = stand_in()
    reference, takes = reference_motion(humanoid, LENGTHS)
    task = group("task", "estimation") | {"termination": {"enabled": False, "head_drop": 0.1}}
    states = humanoid_state(reference).float()
    return build_problem(humanoid, reference, takes, task, group("reward", "estimation"), states=states, path=path)


# --- where the path comes from ---------------------------------------------------------------------------------------


def test_states_that_walk_a_circle_give_the_circle() -> None:
    speed, rate, frames = 1.2, 0.8, 91
    layout = StateLayout(3)
    states = np.zeros((frames, layout.size))
    states[:, layout.root_rotation.start] = 1.0
    # Forward differences of a circle: the chord, half a step's turn to the left of where the root faces.
    chord = 2 * speed / rate * math.sin(rate * DT / 2) / DT
    velocity = chord * np.array([math.cos(rate * DT / 2), math.sin(rate * DT / 2)])
    states[:, layout.root_linear_velocity.start : layout.root_linear_velocity.start + 2] = velocity
    states[:, layout.root_angular_velocity.stop - 1] = rate
    path = integrated_path(states, 30.0)
    angle = rate * DT * np.arange(frames)
    circle = speed / rate * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    np.testing.assert_allclose(path[:, :2], circle, atol=1e-9)
    np.testing.assert_allclose(path[:, 2], angle, atol=1e-9)  # beyond half a turn without a jump


def test_a_problem_follows_the_path_of_its_states_take_by_take() -> None:
    problem = problem_of()
    followed = problem.followed()
    assert followed.path is not None
    for offset, length in zip((0, LENGTHS[0]), LENGTHS, strict=True):
        true = problem.reference["qpos"][offset : offset + length].numpy()
        path = followed.path[offset : offset + length].numpy()
        facing = rot.yaw(true[:, 3:7])
        np.testing.assert_allclose(path[:, 2], facing - facing[0], atol=1e-3)
        turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), facing[:1].repeat(length))
        level = np.column_stack([path[:, :2], np.zeros(length)])
        np.testing.assert_allclose(rot.rotate(turn, level)[:, :2], true[:, :2] - true[0, :2], atol=1e-3)


def test_a_path_that_is_given_is_followed_and_one_of_another_length_refused() -> None:
    given_path = torch.randn(sum(LENGTHS), 3, generator=torch.Generator().manual_seed(0))
    followed = problem_of(given_path).followed()
    assert followed.path is not None
    assert torch.equal(followed.path, given_path.double())
    with pytest.raises(ValueError, match=r"path needs x, y and heading \[65, 3\], got \[64, 3\]"):
        problem_of(given_path[1:])


# --- where it lies ---------------------------------------------------------------------------------------------------


@given(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3), st.floats(-9, 9), st.integers(0, 3))
@settings(deadline=None, max_examples=40)
def test_a_path_begins_where_the_body_stands_and_keeps_its_shape(
    x: float, y: float, facing: float, own_facing: float, first: int
) -> None:
    path = torch.tensor([[0.0, 0, own_facing], [1, 0, own_facing], [1, 1, own_facing + 0.5], [2, 5, own_facing - 1]])
    laid = FollowedPath(path, DT)
    with pytest.raises(ValueError, match="not passed"):
        laid.at(torch.tensor([0]))
    laid.advance(torch.tensor([first]), qpos_at([[x, y]], [facing]))
    rows = torch.arange(4)
    place, heading = laid.at(rows, torch.zeros(4, dtype=torch.int64))
    np.testing.assert_allclose(place[first], [x, y], atol=1e-9)
    np.testing.assert_allclose(np.cos(heading[first] - facing), 1.0, atol=1e-12)
    np.testing.assert_allclose(heading.diff(), path[:, 2].double().diff(), atol=1e-9)
    np.testing.assert_allclose(torch.pdist(place), torch.pdist(path[:, :2].double()), atol=1e-9)
    # What lies ahead of the body in the path's world lies ahead of it in its own.
    ahead = path[:, :2].double() - path[first, :2]
    bearing = torch.atan2(ahead[:, 1], ahead[:, 0]) - path[first, 2]
    found = torch.atan2(place[:, 1] - y, place[:, 0] - x) - facing
    kept = torch.arange(4) != first
    np.testing.assert_allclose(np.cos(found - bearing)[kept], 1.0, atol=1e-9)


def test_what_is_followed_comes_nearer_by_the_formula_of_its_time_constants() -> None:
    # The path stands still at the origin; the body is put 2 m and 1 rad away at once, and stays there.
    still, frames = torch.zeros(1, 3), 60
    row = torch.zeros(2, dtype=torch.int64)
    laid = FollowedPath(still, DT, place_time=3.0, heading_time=5.0)
    laid.advance(row, qpos_at([[0, 0], [0, 0]], [0.0, 3.0]))
    away = qpos_at([[2.0, 0], [0, -2.0]], [1.0, -2.8])  # the second turns left across the half turn
    for _ in range(frames):
        laid.advance(row, away)
    place, heading = laid.at(row)
    near, turned = (1 - math.exp(-frames * DT / time) for time in (3.0, 5.0))
    np.testing.assert_allclose(place, near * np.array([[2.0, 0.0], [0.0, -2.0]]), atol=1e-9)
    second = 3.0 + turned * (2 * np.pi - 5.8)
    np.testing.assert_allclose(heading, [turned, second], atol=1e-9)


def test_without_time_constants_a_path_stays_and_a_turn_of_it_leaves_the_place() -> None:
    path = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    row, body = torch.tensor([1]), qpos_at([[1.0, 0.5]], [0.7])
    stays, turns = FollowedPath(path, DT), FollowedPath(path, DT, heading_time=1e-3)
    for laid in (stays, turns):
        laid.advance(torch.tensor([0]), qpos_at([[0.0, 0.0]], [0.0]))
        laid.advance(row, body)
        np.testing.assert_allclose(laid.at(row)[0], [[1.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(stays.at(torch.tensor([2]))[0], [[2.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(turns.at(torch.tensor([2]))[0], [[1 + math.cos(0.7), math.sin(0.7)]], atol=1e-9)


def test_copies_of_bodies_follow_the_path_of_their_body() -> None:
    laid = FollowedPath(torch.zeros(1, 3), DT)
    laid.advance(torch.zeros(2, dtype=torch.int64), qpos_at([[1.0, 0], [2.0, 0]], [0.1, 0.2]))
    place, heading = laid.at(torch.zeros(6, dtype=torch.int64))
    assert place[:, 0].tolist() == [1.0, 2.0] * 3
    np.testing.assert_allclose(heading, [0.1, 0.2] * 3)


# --- restarts --------------------------------------------------------------------------------------------------------


def walking_away(frames: int) -> Tensor:
    """A path that no body keeps up with: 3 m/s along x, turning."""
    time = DT * torch.arange(frames, dtype=torch.float64)
    return torch.stack([3.0 * time, 0 * time, 0.5 * time], dim=-1)


def estimated(restart: str) -> tuple[list[Estimate], Tensor]:
    path = walking_away(sum(LENGTHS))
    base = environment(2, problem=problem_of(path), whole_fragments=True)
    env = TransformedEnv(base, Compose(StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])))
    fails = TensorDictModule(
        lambda step: torch.where(step == 7, 0.0, 10.0), in_keys=["episode_step"], out_keys=["state_value"]
    )
    states = base.problem.states
    assert states is not None
    guard = FailSafe(len(PIECES), FailSafeSettings("value", 0.6, 0.3, restart))
    on_path = restart_path(restart, env, None)
    return estimate_takes(env, base_tracking(env), fails, states, guard, restart=on_path), path


def test_a_body_restarts_on_its_path_or_where_it_is() -> None:
    own, path = estimated("own")
    on_path, _ = estimated("path")
    for one, other in zip(own, on_path, strict=True):
        assert np.flatnonzero(other.resets).tolist() == [8]
        np.testing.assert_array_equal(one.qpos[:8], other.qpos[:8])
        np.testing.assert_allclose(one.qpos[8, :2], one.qpos[7, :2], atol=1e-12)
        way = (path[other.start + 8] - path[other.start]).numpy()
        first = rot.yaw(other.qpos[:1, 3:7])[0] - path[other.start, 2].numpy()
        turned = np.array([math.cos(first) * way[0], math.sin(first) * way[0]])
        np.testing.assert_allclose(other.qpos[8, :2], other.qpos[0, :2] + turned, atol=1e-9)
        apart = rot.yaw(other.qpos[8, 3:7]) - rot.yaw(other.qpos[0, 3:7]) - way[2]
        assert math.cos(apart) == pytest.approx(1.0, abs=1e-9)


def test_a_restart_that_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match=r"restart: must be own or path, not 'home'"):
        FailSafeSettings("value", 0.6, 0.3, "home")
    problem = problem_of()
    base = environment(1, problem=problem, whole_fragments=True)
    env = TransformedEnv(base)
    assert problem.states is not None
    states = problem.states
    problem.followed = lambda starts=None: Followed(states, global_frame)  # type: ignore[method-assign]
    with pytest.raises(InputError, match=r"no path.*failsafe\.restart=own"):
        restart_path("path", env, None)
    assert restart_path("own", env, None) is None
