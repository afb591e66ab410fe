"""Kinematic forecasts: the splines, what the networks learn from, what a policy follows, and nothing of the future."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, group
from helpers.forecast_curves import (
    FPS,
    configuration,
    contexts_of,
    curves,
    settings,
    unmirrored,
    wave,
)
from helpers.humanoid_stand_in import reference_motion, stand_in
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from torch import nn

from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, metadata_of
from egopose.checkpoint.package import _copy_components
from egopose.checkpoint.run_folder import FOLDER
from egopose.core.errors import InputError
from egopose.data.spans import Span, cross_fit_blocks, group_blocks
from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.evaluation import metrics
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.forecast_start import begin_forecasts
from egopose.models.motion_forecast import spline_basis
from egopose.motion import rotations as rot
from egopose.pipeline.agent import Agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.forecaster import with_forecasts
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.training.fitting import FitSettings, fit
from egopose.training.motion_forecast import ForecastLearner, build_forecaster, cross_fit_starts


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    states = humanoid_state(reference).float()
    return Dataset(humanoid, reference, takes, PIECES, PIECES, states=states)


def test_splines_hold_cubics_and_their_slopes() -> None:
    basis, slope = spline_basis(91, 8, FPS)
    torch.testing.assert_close(basis.sum(dim=1), torch.ones(91))
    t = torch.arange(91) / FPS
    cubic = 0.3 - 0.5 * t + 0.2 * t**2 - 0.1 * t**3
    weights = torch.linalg.lstsq(basis.double(), cubic.double()[:, None]).solution.float()
    torch.testing.assert_close((basis @ weights)[:, 0], cubic, atol=1e-4, rtol=0)
    torch.testing.assert_close((slope @ weights)[:, 0], -0.5 + 0.4 * t - 0.3 * t**2, atol=1e-3, rtol=0)


def test_curves_are_looked_up_as_splines_are_evaluated(dataset: Dataset) -> None:
    futures = curves(dataset)
    basis, slope = spline_basis(13, 3, FPS)
    start, step = torch.tensor([3, 0, 7, 7]), torch.tensor([0, 5, 12, 40])
    whole = basis[step.clamp(max=12)][:, None] @ futures.coefficients[start]
    torch.testing.assert_close(futures.poses(start, step), whole[:, 0])
    layout = StateLayout.of_pose_size(whole.shape[-1])
    rates = (slope[step.clamp(max=12)][:, None] @ futures.coefficients[start])[:, 0, layout.joint_angles]
    torch.testing.assert_close(futures.states(start, step), torch.cat([whole[:, 0], rates], dim=-1))
    with pytest.raises(ValueError, match="no forecast begins at frame"):
        futures.poses(torch.tensor([len(dataset.reference) - 1]), torch.tensor([0]))

    other = torch.zeros_like(futures.coefficients[:2])
    before = futures.poses(torch.tensor([5]), torch.tensor([2]))
    futures.put(other, torch.tensor([7, len(dataset.reference) - 1]))
    assert not futures.poses(torch.tensor([7, len(dataset.reference) - 1]), torch.tensor([4, 0])).any()
    torch.testing.assert_close(futures.poses(torch.tensor([5]), torch.tensor([2])), before)


def test_bodies_begin_where_the_curve_does_and_the_reference_stands(dataset: Dataset) -> None:
    futures, frame = curves(dataset), torch.tensor([2, 6])
    reference = torch.as_tensor(dataset.reference["qpos"][frame + 1]).double()
    qpos, qvel = futures.first_state(frame, reference, np.asarray(dataset.humanoid.joint_range))
    torch.testing.assert_close(qpos[:, :2], reference[:, :2])
    facing = [rot.heading(part[:, 3:7].numpy()) for part in (qpos, reference)]
    np.testing.assert_allclose(np.abs((facing[0] * facing[1]).sum(-1)), 1.0, atol=1e-9)
    state = humanoid_state({"qpos": qpos, "qvel": qvel}).float()
    torch.testing.assert_close(state, futures.states(frame, torch.zeros(2, dtype=torch.int64)), atol=2e-3, rtol=0)


@hypothesis_settings(deadline=None)
@given(
    lengths=st.lists(st.integers(3, 80), min_size=5, max_size=8),
    folds=st.integers(2, 5),
    context=st.integers(1, 12),
    whole=st.booleans(),
)
def test_no_network_has_seen_what_it_forecasts_for_training(
    lengths: list[int], folds: int, context: int, whole: bool
) -> None:
    ends = np.cumsum([0, *lengths])
    spans = [Span(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    made = settings(context=context, cross_fit=folds)
    dealt: list[int] = []
    blocks = group_blocks(spans, range(len(spans)), folds) if whole else cross_fit_blocks(spans, folds)
    for others, starts in cross_fit_starts(spans, blocks, made):
        learned = {frame for span in others for frame in range(span.start, span.stop)}
        for start in starts.tolist():
            span = next(s for s in spans if s.start <= start < s.stop)
            about = range(max(span.start, start - context + 1), min(span.stop, start + made.horizon + 1))
            assert learned.isdisjoint(about)
        dealt += starts.tolist()
    assert sorted(dealt) == [f for s in spans for f in range(s.start + context - 1, s.stop)]


def learner(contexts: torch.Tensor, poses: torch.Tensor, **changes: Any) -> ForecastLearner:
    made = settings(input_noise=0.0, **changes)
    seen, span = contexts_of(contexts, made.context), Span(0, len(poses))
    return ForecastLearner(seen, poses, [span], unmirrored(poses), [1], made, FPS, 8, 0.2, seed=0)


def test_it_forecasts_what_can_be_known_and_the_mean_of_what_cannot() -> None:
    optimiser = FitSettings.from_config({**group("forecaster", "fast")["optimiser"], "batch": 8})
    poses = wave(200)
    known = learner(poses, poses, dropout=0.0)
    untrained = known.held_out()
    fit(known, optimiser, seed=0, total_frames=20_000)
    assert known.held_out() < 0.6 * untrained

    blind = learner(0.5 * torch.randn(poses.shape, generator=torch.Generator().manual_seed(0)), poses)
    fit(blind, optimiser, seed=0, total_frames=20_000)
    swing = float(poses[:, [5, 7, 8]].square().sum(1).mean().sqrt())
    assert blind.held_out() == pytest.approx(swing, rel=0.1)


def test_its_error_is_the_papers() -> None:
    """Joint angles, hands left out; a small lean as roll and pitch; not height or velocities."""
    poses = wave(60)
    made = learner(poses, poses)
    truth, seen = np.zeros((2, 11)), np.zeros((2, 11))
    truth[:, 3], truth[:, 2], seen[:, 2] = 1.0, 1.0, 1.4
    seen[:, 3:7] = rot.from_rotvec(np.array([0.02, -0.03, 0.0]))
    seen[:, 7:] = [0.3, 9.0, -0.2, 0.1]
    wanted = metrics.pose_error(seen, truth, [1])[0]
    difference, layout = torch.zeros(15), StateLayout(4)
    difference[0], difference[layout.joint_angles], difference[-1] = 0.4, torch.tensor([0.3, 9.0, -0.2, 0.1]), 3.0
    difference[layout.root_rotation] = torch.as_tensor(seen[0, 3:7] - truth[0, 3:7])
    found = (difference / made.model.std * made.judged).norm()
    assert float(found) == pytest.approx(wanted, rel=1e-3)


def test_the_start_policy_asks_for_the_curves_next_pose(dataset: Dataset) -> None:
    followed, config = replace(dataset, forecasts=curves(dataset)), configuration()
    config["task"] = {**config["task"], "follow": {**config["task"]["follow"], "velocity_feedforward": 0.0}}
    env = build_env(config, followed, num_envs=3, fragments=PIECES[:1])
    config["model"] = {**config["model"], "final_gain": 0.0}
    actor, critic = build_networks(config, followed, env)
    observation = critic(actor(env.reset()))
    start = observation["episode_start"].squeeze(-1)
    assert followed.forecasts is not None
    following = followed.forecasts.poses(start, torch.ones_like(start))
    following = following[:, StateLayout.of_pose_size(following.shape[1]).joint_angles]
    rest = torch.as_tensor(dataset.humanoid.rest_action).float()
    torch.testing.assert_close(observation["loc"] + rest, following, atol=1e-6, rtol=0)
    # Episodes begin on the curve: nothing to correct.
    size = observation["tracking_error"].shape[-1] // 2
    assert observation["tracking_error"][:, :size].abs().max() < 0.1
    assert observation["state_value"].isfinite().all()
    env.close()


def test_what_knows_the_future_is_refused(dataset: Dataset) -> None:
    followed, config = replace(dataset, forecasts=curves(dataset)), configuration()
    task = {**config["task"], "action": {**config["task"]["action"], "reference": "regressor"}}
    with pytest.raises(InputError, match="forecaster"):
        build_env({**config, "task": task}, followed, num_envs=1)
    with pytest.raises(InputError, match="follow"):
        build_env({**config, "task": {**config["task"], "follow": None}}, followed, num_envs=1)
    env = build_env(config, followed, num_envs=1, fragments=PIECES[:1])
    with pytest.raises(InputError, match="base"):
        build_networks({**config, "model": {**config["model"], "base": "time_left"}}, followed, env)


def test_a_forecast_follows_what_its_context_shows_and_nothing_else(dataset: Dataset, tmp_path: Path) -> None:
    followed, config = replace(dataset, forecasts=curves(dataset)), configuration()
    assert followed.forecasts is not None
    size, made = followed.forecasts.coefficients.shape[-1], settings()
    members = nn.ModuleList(
        [build_forecaster(made, torch.zeros(size), torch.ones(size), FPS, seed) for seed in range(made.members)]
    )
    kept = ComponentState(lambda: {"starts": torch.zeros(1)}, lambda _: None)
    RunCheckpoint({"members": members, "futures": kept}).save(
        tmp_path / FOLDER, metadata=metadata_of("motion forecaster", size, 0, 0, 0.0)
    )
    path = tmp_path / "checkpoints" / "checkpoint-1"
    path.mkdir(parents=True)
    actor, critic = nn.Identity(), nn.Identity()
    agent = Agent(actor, critic, config, followed, partial(build_env, config, followed), path)  # type: ignore[arg-type]
    states = dataset.states
    assert states is not None
    windows = [ForecastWindow(0, 0, 5, 12), ForecastWindow(0, 9, 5, 12)]
    pasts = torch.stack([states[w.start : w.start + 5] for w in windows]).double()
    qpos, qvel = begin_forecasts(agent, windows, pasts)
    with torch.no_grad():
        wanted = torch.stack([member(pasts[..., :size].float()) for member in members]).mean(0)
    now = torch.tensor([w.now for w in windows])
    first = followed.forecasts.poses(now, torch.zeros(2, dtype=torch.int64))
    torch.testing.assert_close(first, wanted[:, 0])
    torch.testing.assert_close(qpos[:, 7:].float(), first[:, StateLayout.of_pose_size(size).joint_angles])
    assert qvel.isfinite().all()


def test_shipped_forecasters_bring_no_curves_of_training_and_forecast_the_same(
    dataset: Dataset, tmp_path: Path
) -> None:
    config, known = configuration(), curves(dataset)
    size, made = known.coefficients.shape[-1], settings()
    members = nn.ModuleList(
        [build_forecaster(made, torch.zeros(size), torch.ones(size), FPS, seed) for seed in range(made.members)]
    )
    table = {"coefficients": known.coefficients, "starts": known.starts}
    RunCheckpoint({"members": members, "futures": ComponentState(lambda: table, lambda _: None)}).save(
        tmp_path / "run" / FOLDER, metadata=metadata_of("motion forecaster", size, 0, 0, 0.0)
    )
    _copy_components(tmp_path / "run" / FOLDER, tmp_path / "shipped" / FOLDER, ("members",))
    assert dataset.states is not None
    windows = [ForecastWindow(0, 9, 5, 12)]
    pasts = dataset.states[9:14][None].double()
    found = []
    for run in ("run", "shipped"):
        followed = with_forecasts(config, dataset, tmp_path / run)
        assert followed.forecasts is not None
        assert len(followed.forecasts.starts) == (0 if run == "shipped" else len(known.starts))
        path = tmp_path / run / "checkpoints" / "checkpoint-1"
        path.mkdir(parents=True)
        make_env, network = partial(build_env, config, followed), nn.Identity()
        agent = Agent(network, network, config, followed, make_env, path)  # type: ignore[arg-type]
        qpos, qvel = begin_forecasts(agent, windows, pasts)
        now = torch.tensor([windows[0].now])
        found.append((qpos, qvel, *(followed.forecasts.poses(now, now * 0 + step) for step in range(12))))
        make_env(num_envs=1).close()
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_bad_settings_are_named() -> None:
    with pytest.raises(InputError, match="cross_fit"):
        settings(cross_fit=0)
    with pytest.raises(InputError, match="context"):
        settings(context=13)
    with pytest.raises(InputError, match="fragments"):
        learner(wave(6), wave(6))
