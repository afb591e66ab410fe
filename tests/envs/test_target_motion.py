"""What is followed: forecasts against the same motion as a table, and a window by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import build_problem, environment, group
from helpers.forecast_curves import FPS, curves
from helpers.humanoid_stand_in import reference_motion, stand_in
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egopose.envs import target_window as module
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.reference_forecasts import ForecastTargets, ReferenceForecasts
from egopose.envs.starts import Piece
from egopose.envs.target_motion import CurveMotion, TableMotion
from egopose.envs.target_window import TargetWindow
from egopose.humanoid.state_layout import StateLayout
from egopose.models.pose_regression import integrated_path
from egopose.tasks.dataset import Dataset

HORIZON, AHEAD = 12, np.array([1, 2, 4])


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    made = Dataset(humanoid, reference, takes, (), (), states=humanoid_state(reference).float())
    return replace(made, forecasts=curves(made))


def clock(start: int, steps: list[int]) -> TensorDict:
    step = torch.tensor(steps)[:, None]
    began = torch.full_like(step, start)
    return TensorDict({"frame": step, "episode_start": began, "episode_step": step}, batch_size=[len(steps)])


@pytest.mark.parametrize("start", [0, 3, 20])
def test_a_forecast_is_followed_as_the_same_motion_in_a_store(dataset: Dataset, start: int) -> None:
    """Behind its horizon its last state stands still, as the last frame of a take."""
    forecasts = dataset.forecasts
    assert forecasts is not None
    steps = torch.arange(HORIZON + 1)
    states = forecasts.states(torch.full_like(steps, start), steps)
    path = torch.from_numpy(integrated_path(states.double().numpy(), FPS))
    table = TableMotion(states, path, torch.full_like(steps, HORIZON))
    entries = clock(start, [0, 5, 9, HORIZON])
    curve = CurveMotion(forecasts)
    np.testing.assert_array_equal(curve.states(entries, AHEAD), table.states(entries, AHEAD))
    np.testing.assert_allclose(curve.path(entries, AHEAD), table.path(entries, AHEAD), atol=1e-12)
    late = curve.states(clock(start, [HORIZON + 30]), AHEAD)
    np.testing.assert_array_equal(late, curve.states(clock(start, [HORIZON]), AHEAD))
    assert curve.size == table.size == states.shape[1]


def test_new_curves_have_new_paths_and_the_others_keep_theirs(dataset: Dataset) -> None:
    forecasts = curves(dataset)
    motion = CurveMotion(forecasts)
    before = [motion.path(clock(start, [6]), AHEAD) for start in (3, 4)]
    still = forecasts.coefficients[:1].clone()
    still[..., StateLayout.of_pose_size(still.shape[-1]).root_linear_velocity] = 0.0
    forecasts.put(still, torch.tensor([3]))
    after = [motion.path(clock(start, [6]), AHEAD) for start in (3, 4)]
    np.testing.assert_allclose(after[0][..., :2], 0.0, atol=1e-12)
    assert np.abs(before[0][..., :2]).max() > 1e-3
    np.testing.assert_array_equal(after[1], before[1])
    table = motion.followed(torch.tensor([4, 3]))
    assert table.path is not None
    np.testing.assert_allclose(table.path[HORIZON + 1 :, :2].numpy(), 0.0, atol=1e-12)
    np.testing.assert_array_equal(table.path[[7, 8, 10]].numpy(), after[1][0])


def forward(dataset: Dataset, speed: float, turn: float) -> ReferenceForecasts:
    """Curves of a body that keeps its first pose, goes ahead and turns."""
    known = curves(dataset)
    layout = StateLayout.of_pose_size(known.coefficients.shape[-1])
    still = known.coefficients[:, :1].expand(-1, known.coefficients.shape[1], -1).clone()
    still[..., layout.root_rotation] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    still[..., layout.root_linear_velocity] = torch.tensor([speed, 0.0, 0.0])
    still[..., layout.root_angular_velocity] = torch.tensor([0.0, 0.0, turn])
    return ReferenceForecasts(still, known.starts, known.frames, HORIZON, 3, FPS)


def followed(dataset: Dataset, forecasts: ReferenceForecasts, lag: float = 0.0) -> TransformedEnv:
    task = group("task", "tracked_forecasting")
    tables = {"forecasts": forecasts, "states": dataset.states, "shows_path": True}
    problem = build_problem(
        dataset.humanoid, dataset.reference, dataset.takes, task, group("reward", "forecasting"), **tables
    )
    base = environment(2, problem=problem, fragments=(Piece(0, 4, 20), Piece(0, 9, 25)), whole_fragments=True)
    rest = torch.as_tensor(dataset.humanoid.rest_action)
    parts = (
        TargetWindow(problem.motion_seen, (1, 2, 4)),  # type: ignore[arg-type]
        ForecastTargets(forecasts, rest, torch.full_like(rest, lag)),
    )
    return TransformedEnv(base, Compose(*parts))


def test_a_forecasts_window_is_that_by_hand(dataset: Dataset) -> None:
    """A curve of 0.6 m/s straight ahead, from wherever the body was placed: 0.02 m a frame."""
    env = followed(dataset, forward(dataset, 0.6, 0.0))
    env.reset()
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    state = base.body_state()
    qpos = state["qpos"].clone()
    qpos[:, :2] = torch.tensor([[3.0, -2.0], [5.0, 1.0]])
    base.place(torch.arange(2), qpos, state["qvel"])
    window = env.transform(base.observe())["target_window"]
    frames = window[:, : 3 * (6 + base.action_spec.shape[-1])].unflatten(-1, (3, -1))
    ahead = torch.tensor([1.0, 2.0, 4.0]) * 0.02 / module.PLACE
    torch.testing.assert_close(frames[..., 1], ahead.expand(2, -1), atol=1e-4, rtol=0)
    torch.testing.assert_close(frames[..., 2:4], torch.zeros(2, 3, 2), atol=1e-4, rtol=0)
    torch.testing.assert_close(frames[..., 6:], torch.zeros_like(frames[..., 6:]), atol=1e-3, rtol=0)


def test_a_turning_forecast_turns_its_path(dataset: Dataset) -> None:
    """0.6 m/s while turning by 1.5 rad/s: after k frames the heading is k * 0.05 rad."""
    motion = CurveMotion(forward(dataset, 0.6, 1.5))
    path = motion.path(clock(3, [2]), AHEAD)[0]
    turned = 0.05 * np.arange(7)
    steps = 0.02 * np.stack([np.cos(turned), np.sin(turned)], axis=-1)
    np.testing.assert_allclose(path[:, 2], turned[[3, 4, 6]], atol=1e-5)
    np.testing.assert_allclose(path[:, :2], [steps[:k].sum(axis=0) for k in (3, 4, 6)], atol=1e-5)


def test_targets_are_the_forecasts_next_joints_and_their_lag(dataset: Dataset) -> None:
    forecasts = curves(dataset)
    env = followed(dataset, forecasts, lag=0.1)
    env.reset()
    base = env.base_env
    observation = env.transform(base.observe())
    layout = StateLayout.of_size(forecasts.size)
    following = forecasts.states(torch.tensor([4, 9]), torch.ones(2, dtype=torch.int64))
    expected = following[:, layout.joint_angles] + 0.1 * following[:, layout.joint_velocities]
    expected -= torch.as_tensor(dataset.humanoid.rest_action).float()
    torch.testing.assert_close(observation["followed_targets"], expected)
    # The sum of a tracker's training: what is followed, plus the action.
    action = 0.05 * torch.ones_like(expected)
    target = base.problem.target(observation["followed_targets"] + action, base.frame)
    rest, low, high = (
        torch.as_tensor(part) for part in (dataset.humanoid.rest_action, *dataset.humanoid.joint_range.T)
    )
    torch.testing.assert_close(target, (expected.double() + rest + 0.05).clamp(low, high), atol=1e-6, rtol=0)


def test_specs_hold(dataset: Dataset) -> None:
    check_env_specs(followed(dataset, curves(dataset)))
