"""A tracker's policy on forecasts: it is taken over as it is; settings that forbid it are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.env_stand_in import PIECES, group
from helpers.forecast_curves import SMALL, curves
from helpers.tracking_run import configuration, tracking_dataset, weights_of

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.mdp.observations import humanoid_state
from egopose.pipeline import forecaster
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.pipeline.run import build_run, start_from
from egopose.tasks.dataset import Dataset
from egopose.tasks.forecasting import TASK
from egopose.training.loop import train


def followed(**changes: Any) -> dict[str, Any]:
    """The small run of :mod:`helpers.tracking_run`, following forecasts."""
    tracker = configuration(total_steps=0)
    task = {**group("task", "tracked_forecasting"), "context": 5, "horizon": 13, "minimum": 4}
    model = {**group("model", "tracked_forecasting"), "hidden": [8]}
    model["critic"] = {**model["critic"], "hidden": [8]}
    values = {"task": task, "model": model, "reward": group("reward", "forecasting")}
    return {**tracker, **values, "forecaster": {**group("forecaster", "fast"), **SMALL}, **changes}


def forecast_dataset() -> Dataset:
    """Two takes, forecast from every frame of the first."""
    known = tracking_dataset()
    rows = slice(0, 65)
    takes = replace(
        known.takes,
        offsets=known.takes.offsets[:2],
        lengths=known.takes.lengths[:2],
        lowest_head_height=known.takes.lowest_head_height[:2],
    )
    made = Dataset(known.humanoid, known.reference[rows], takes, PIECES[:1], PIECES[:1])
    made = replace(made, states=humanoid_state(made.reference).float())
    return replace(made, forecasts=curves(made))


def test_a_trackers_policy_follows_a_forecast(tmp_path: Path) -> None:
    torch.manual_seed(1)
    tracker = build_run(configuration(), tmp_path / "tracker", tracking_dataset())
    with torch.no_grad():  # or the start policy would do nothing
        for weights in tracker.ppo.actor.parameters():
            weights.add_(0.05 * torch.randn(weights.shape))
    tracker.save()
    run = build_run(followed(), tmp_path / "run", forecast_dataset())
    start_from(run, str(tmp_path / "tracker"))
    theirs, ours = weights_of(tracker), weights_of(run)
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert train(run, [], lambda iteration: {}).frames == 0
    for one in (run, tracker):
        one.collector.shutdown()


def test_the_actors_own_mean_is_added_to_the_forecast() -> None:
    dataset, config = forecast_dataset(), followed()
    env = build_env(config, dataset, "test", num_envs=2, whole_fragments=True, fragments=PIECES[:1] * 2)
    run_actor, _ = build_networks(config, dataset, env)
    observation = run_actor(env.reset())
    head = next(part for part in run_actor.modules() if type(part).__name__ == "GaussianHead")
    mean, _ = head(observation["humanoid_state"], observation["target_window"])
    torch.testing.assert_close(observation["loc"], mean + observation["followed_targets"])
    assert observation["followed_targets"].abs().max() > 0.01


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"model": group("model", "tracking")}, r"model\.base.*followed_targets"),
        ({"model": group("model", "paper")}, "forecaster.*tracked_forecasting"),
        ({"forecaster": None}, r"model\.inputs.*target_window knows the frames"),
        ({"task": {**group("task", "tracked_forecasting"), "follow": None}}, r"task\.follow.*is missing"),
        ({"task": group("task", "tracked_estimation")}, "forecaster.*tracked_forecasting"),
    ],
)
def test_settings_under_which_it_cannot_follow_are_named(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        TASK.check(followed(**changes))


def test_frames_ahead_are_needed() -> None:
    config = followed()
    del config["task"]["ahead"]
    with pytest.raises(InputError, match=r"task\.ahead"):
        build_env(config, forecast_dataset(), num_envs=1)


def test_the_experiment_takes_a_tracker_over_as_it_is() -> None:
    config = compose_config("train", ["experiment=tracked_forecasting"])
    TASK.check(config)
    assert config["training"]["total_steps"] == 0
    tracker = compose_config("train", ["experiment=tracking"])
    assert {**config["model"], "base": None} == {**tracker["model"], "base": None}
    assert config["task"]["ahead"] == tracker["task"]["ahead"]
    assert config["task"]["follow"]["velocity_feedforward"] == tracker["task"]["action"]["velocity_feedforward"]


def test_forecasts_that_know_the_future_train_nobody(tmp_path: Path) -> None:
    config = compose_config("train", ["experiment=tracked_forecasting", "training.total_steps=1000"])
    with pytest.raises(InputError, match=r"cross_fit.*total_steps=0"):
        forecaster.with_forecasts(config, replace(forecast_dataset(), forecasts=None), tmp_path)


def test_curves_are_grounded_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """And fitted to what stands on its feet."""
    dataset = forecast_dataset()
    size = dataset.states.shape[1] - dataset.humanoid.mj_model.nu  # type: ignore[union-attr]
    kept = torch.randn(2, 7, size)
    monkeypatch.setattr(forecaster, "_curve", lambda members, contexts: kept)
    monkeypatch.setattr(forecaster, "grounded", lambda poses, humanoid, ahead: poses + ahead)
    settings = forecaster._settings(followed())[0]
    contexts, members = torch.zeros(2, 5, size), forecaster.Members([])
    plain = forecaster._curves(members, contexts, settings, dataset.humanoid)
    moved = forecaster._curves(members, contexts, replace(settings, mass_ahead=0.25), dataset.humanoid)
    assert torch.equal(plain, kept)
    torch.testing.assert_close(moved, kept + 0.25, atol=1e-4, rtol=0)
