"""Looking ahead on the way along a forecast: the body is judged by the curve it follows, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES
from helpers.forecast_curves import FPS, configuration, curves
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.planner_run import SMALL, settings
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.core.torch_settings import torch_threads
from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.mdp.step_view import StepView
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.envs.target_motion import CurveMotion
from egopose.envs.test_time import prepare_for_test
from egopose.evaluation import forecast_run
from egopose.evaluation import forecast_run as forecast_evaluation
from egopose.evaluation.forecast_run import ForecastSettings, forecast_windows_of
from egopose.humanoid.state_layout import StateLayout
from egopose.inference import planners
from egopose.inference.forecaster import forecast
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings
from egopose.pipeline.agent import Agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset

WINDOWS = [ForecastWindow(0, 0, 5, 12), ForecastWindow(0, 9, 5, 12), ForecastWindow(0, 4, 5, 12)]
TEST = {"whole_fragments": True, "falls_end": False}
FORECAST = ForecastSettings(12, 5, 1, 0.8, 0.0, "regressor", None, 8, 3)


@pytest.fixture(autouse=True)
def _one_thread_and_seed() -> Iterator[None]:
    torch.manual_seed(0)
    with torch_threads(1):
        yield


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Whose forecasts are not what happens: each goes back from where it begins."""
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    made = Dataset(humanoid, reference, takes, PIECES, PIECES, states=humanoid_state(reference).float())
    known = curves(made)
    coefficients = 2 * known.coefficients[:, :1] - known.coefficients
    return replace(made, forecasts=ReferenceForecasts(coefficients, known.starts, known.frames, known.horizon, 3, FPS))


@pytest.fixture(scope="module")
def agent(dataset: Dataset) -> Agent:
    config = configuration()
    make_env = partial(build_env, config, dataset)
    env = make_env(num_envs=2, fragments=PIECES[:1])
    actor, critic = build_networks(config, dataset, env)
    env.close()
    return Agent(actor.eval(), critic.eval(), config, dataset, make_env, Path("nowhere"))


def nows(agent: Agent, windows: list[ForecastWindow]) -> Tensor:
    return torch.tensor([int(agent.dataset.takes.offsets[w.take]) + w.now for w in windows])


def begun(agent: Agent, windows: list[ForecastWindow]) -> tuple[Tensor, Tensor]:
    now, futures = nows(agent, windows), agent.dataset.forecasts
    assert futures is not None
    reference = torch.as_tensor(agent.dataset.reference["qpos"][now])
    return futures.first_state(now, reference, np.asarray(agent.dataset.humanoid.joint_range))


def planner_for(agent: Agent, windows: list[ForecastWindow], **changed: Any) -> Planner:
    chosen = settings(**{**SMALL, **changed})
    assert agent.dataset.forecasts is not None
    env = agent.make_env(num_envs=len(windows) * chosen.samples, fragments=windows, **TEST)
    return Planner(env, agent.actor, agent.critic, chosen, env.base_env.problem.followed(nows(agent, windows)))


def forecast_of(agent: Agent, windows: list[ForecastWindow], samples: int = 1, planner: Any = None) -> Any:
    env = agent.make_env(
        num_envs=len(windows) * samples, fragments=[w for w in windows for _ in range(samples)], **TEST
    )
    made = forecast(env, agent.actor, *begun(agent, windows), samples, 12, 3, 0.0, planner)
    env.close()
    return made


# --- what is followed ------------------------------------------------------------------------------------------------


def test_what_is_followed_is_every_step_of_every_curve(dataset: Dataset) -> None:
    futures = dataset.forecasts
    assert futures is not None
    starts = torch.tensor([17, 3, 8])
    states, row, path = CurveMotion(futures).followed(starts)
    assert path is not None
    assert states.shape == (3 * 13, dataset.states.shape[1])
    start, step = starts.repeat(20), torch.arange(20).repeat_interleave(3)
    rows = row({"episode_start": start[:, None], "episode_step": step[:, None], "frame": torch.zeros(60, 1).long()})
    assert rows.dtype == torch.int64
    assert torch.equal(states[rows], futures.states(start, step))
    assert torch.equal(path[rows], futures.path(start, step))
    assert rows[:3].tolist() == [0, 13, 26]
    assert set(rows[step >= 12].tolist()) == {12, 25, 38}, "behind the horizon the last"
    stray = row({"episode_start": torch.tensor([[4]]), "episode_step": torch.tensor([[12]])})
    assert stray.item() < 0, "no curve begins there, and it is no row of another's"


# --- in a simulation -------------------------------------------------------------------------------------------------


def test_the_body_that_is_followed_is_the_curves_at_that_step(agent: Agent) -> None:
    """At each step of the plans made at 0, 4 and 8, for all copies; at the window's end the clock stops."""
    futures, now = agent.dataset.forecasts, nows(agent, WINDOWS)
    assert futures is not None
    planner = planner_for(agent, WINDOWS, every=4)
    reward, seen = planner._reward, list[tuple[SimpleNamespace, Tensor]]()

    def spied(view: StepView) -> Any:
        """Of all steps of a round at once, one after the other."""
        told = view.step.split(len(WINDOWS) * planner.settings.samples)
        parts = {name: rows.split(len(told[0])) for name, rows in vars(view.reference).items()}
        seen.extend((SimpleNamespace(**{name: parts[name][at] for name in parts}), told[at]) for at in range(len(told)))
        return reward(view)

    planner._reward = spied
    forecast_of(agent, WINDOWS, planner=planner)
    planner.close()
    steps = [min(at + ahead, 12) for at in (0, 4, 8) for ahead in range(1, 9)]
    assert len(seen) == len(steps)
    # Copies of a body lie as many apart as there are bodies.
    start = now.repeat(planner.settings.samples)
    for (followed, told), step in zip(seen, steps, strict=True):
        assert (told == step).all()
        states = futures.states(start, torch.full_like(start, step))
        close = partial(torch.testing.assert_close, atol=1e-4, rtol=1e-4, check_dtype=False)
        close(followed.root_height, states[:, 0])
        layout = StateLayout.of_size(states.shape[1])
        rotation = states[:, layout.root_rotation]
        told_facing, facing = followed.root_rotation, rotation / rotation.norm(dim=-1, keepdim=True)
        close((told_facing * facing).sum(-1).abs(), torch.ones(len(start)))
        close(followed.root_linear_velocity, states[:, layout.root_linear_velocity])
        close(followed.root_angular_velocity.norm(dim=-1), states[:, layout.root_angular_velocity].norm(dim=-1))


def test_the_head_that_is_followed_is_as_high_as_the_curves(agent: Agent) -> None:
    """The heads of bodies placed by hand where the curve has them."""
    futures = agent.dataset.forecasts
    assert futures is not None
    planner = planner_for(agent, WINDOWS)
    now = nows(agent, WINDOWS)
    env = agent.make_env(num_envs=3, fragments=WINDOWS, **TEST)
    env.reset()
    base, head = env.base_env, agent.dataset.humanoid.head
    base.place(torch.arange(3), *begun(agent, WINDOWS))
    rows = planner._row({"episode_start": now[:, None], "episode_step": torch.zeros(3, 1).long()})
    torch.testing.assert_close(planner._head_height[rows], base.body_state()["xpos"][:, head, 2], atol=1e-4, rtol=0)
    env.close()
    planner.close()


def test_looking_ahead_changes_a_forecast_and_the_policy_alone_is_what_it_was(agent: Agent) -> None:
    alone, planner = forecast_of(agent, WINDOWS), planner_for(agent, WINDOWS, every=4, margin=0.0)
    ahead = forecast_of(agent, WINDOWS, planner=planner)
    planner.close()
    assert np.abs(ahead.qpos - alone.qpos).max(axis=(1, 2, 3)).min() > 1e-3
    assert np.isfinite(ahead.qpos).all()
    np.testing.assert_array_equal(by_hand(agent, WINDOWS, 0.0), alone.qpos[:, 0])


@torch.no_grad()
def by_hand(agent: Agent, windows: list[ForecastWindow], perturbation: float) -> np.ndarray:
    """``[W, 12, nq]``: the mean action and an addition to it, step by step."""
    env = agent.make_env(num_envs=len(windows), fragments=windows, **TEST)
    prepare_for_test(env, agent.actor)
    observation = env.reset()
    base = env.base_env
    base.place(torch.arange(len(windows)), *begun(agent, windows))
    observation.update(env.transform(base.observe()))
    rows = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(12):
            observation = agent.actor(observation)
            observation["action"] = observation["action"] + perturbation
            observation = env.step(observation)["next"].exclude("reward", "action")
            rows.append(base.body_state()["qpos"].clone())
    env.close()
    return torch.stack(rows, dim=1).numpy()


def test_additions_are_to_the_mean_action_and_drawn_futures_know_none(agent: Agent) -> None:
    asked: list[int] = []

    def perturbation(base: Any) -> Tensor:
        asked.append(len(base.physics.qpos))
        return torch.full((asked[-1], agent.dataset.humanoid.mj_model.nu), 0.05)

    stub = SimpleNamespace(perturbation=perturbation)
    pushed = forecast_of(agent, WINDOWS, planner=stub)
    assert asked == [3] * 12
    np.testing.assert_array_equal(pushed.qpos[:, 0], by_hand(agent, WINDOWS, 0.05))
    assert np.abs(pushed.qpos - forecast_of(agent, WINDOWS).qpos).max() > 1e-3
    drawn, planned = (forecast_of(agent, WINDOWS, samples=2, planner=one) for one in (None, stub))
    np.testing.assert_array_equal(drawn.qpos, planned.qpos)
    assert np.abs(drawn.qpos[:, 0] - drawn.qpos[:, 1]).max() > 1e-3


# --- of windows ------------------------------------------------------------------------------------------------------


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The planners there have been: what they were made of, and whether they were closed."""
    there: list[Any] = []

    class Counted(Planner):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            self.given, self.closed = given, False
            there.append(self)

        def close(self) -> None:
            super().close()
            self.closed = True

    monkeypatch.setattr(planners, "Planner", Counted)
    return there


def windows_by(agent: Agent, planner: PlannerSettings | None, num_envs: int = 8, samples: int = 1) -> Any:
    chosen = replace(FORECAST, num_envs=num_envs)
    return forecast_windows_of(agent, WINDOWS, begun(agent, WINDOWS), samples, chosen, 1, planner)


def test_each_lot_of_windows_has_a_planner_that_follows_its_curves(agent: Agent, made: list[Any]) -> None:
    chosen, futures = settings(**SMALL), agent.dataset.forecasts
    assert futures is not None
    told = windows_by(agent, chosen, num_envs=2)
    assert [one.closed for one in made] == [True, True]
    now = nows(agent, WINDOWS)
    for one, part in zip(made, (now[:2], now[2:]), strict=True):
        env, actor, critic, used, (states, row, path) = one.given
        assert path is not None
        assert (actor, critic, used) == (agent.actor, agent.critic, chosen)
        assert env.batch_size == torch.Size([12 * len(part)])
        steps = torch.arange(13).repeat(len(part))
        assert torch.equal(states, futures.states(part.repeat_interleave(13), steps))
        entries = {"episode_start": part[:, None], "episode_step": torch.full((len(part), 1), 4)}
        assert torch.equal(states[row(entries)], futures.states(part, torch.full_like(part, 4)))
        assert one.value.shape == part.shape
    assert told.qpos.shape[:3] == (3, 1, 12)
    planner = planner_for(agent, WINDOWS[:2])
    np.testing.assert_array_equal(told.qpos[:2], forecast_of(agent, WINDOWS[:2], planner=planner).qpos)
    planner.close()
    assert np.abs(told.qpos - windows_by(agent, None, num_envs=2).qpos).max() > 1e-3
    assert len(made) == 2


def test_a_lot_has_no_more_copies_than_memory_allows(
    agent: Agent, made: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast_run, "_PLANNED_TOGETHER", 2 * SMALL["samples"])
    windows_by(agent, settings(**SMALL))
    assert [len(one.value) for one in made] == [2, 1]


def test_without_settings_there_is_no_planner_and_lots_change_nothing(agent: Agent, made: list[Any]) -> None:
    alone = windows_by(agent, None)
    np.testing.assert_array_equal(alone.qpos, forecast_of(agent, WINDOWS).qpos)
    np.testing.assert_allclose(windows_by(agent, None, num_envs=1).qpos, alone.qpos, atol=1e-6)
    drawn = windows_by(agent, None, samples=2)
    np.testing.assert_array_equal(drawn.qpos, forecast_of(agent, WINDOWS, samples=2).qpos)
    assert not made


def test_an_agent_that_follows_no_forecast_does_not_look_ahead(
    agent: Agent, made: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def told(env: Any, actor: Any, qpos: Tensor, qvel: Tensor, *rest: Any) -> Any:
        asked.append(rest[-1])
        return SimpleNamespace(qpos=qpos.numpy(), fallen=qpos.numpy(), diverged=qpos.numpy())

    monkeypatch.setattr(forecast_evaluation, "forecast", told)
    blind = replace(agent, dataset=replace(agent.dataset, forecasts=None))
    states = begun(agent, WINDOWS)
    for one, count in ((blind, 0), (agent, 1)):
        forecast_windows_of(one, WINDOWS, states, 1, FORECAST, 1, settings(**SMALL))
        assert len(made) == count
    assert asked == [None, made[0]]
