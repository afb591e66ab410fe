"""The training loop on a toy environment: it learns, stops, resumes to the bit and counts rightly."""

from __future__ import annotations

import csv
import math
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.toy_problem import SETTINGS, make_env, make_run, networks
from tensordict import TensorDict

from egopose.core.errors import InputError
from egopose.training.logging import CsvCurves, ProgressLine, build_loggers, git_state
from egopose.training.loop import Run, batch_metrics, iterate, train
from egopose.training.ppo import PPO, PPOSettings, TrainingDiverged, _between_neighbours


def state_of(run: Run) -> dict[str, torch.Tensor]:
    parts = {"actor": run.ppo.actor, "critic": run.ppo.critic}
    return {f"{name}.{key}": value.clone() for name, part in parts.items() for key, value in part.state_dict().items()}


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


def test_the_toy_is_learned(tmp_path: Path) -> None:
    run = make_run(tmp_path, iterations=25, steps_per_iteration=512)
    batches = iter(run.collector)
    figures = [iterate(run, batches) for _ in range(25)]
    assert figures[-1]["reward"] > figures[0]["reward"] + 0.1
    assert figures[-1]["falls"] < figures[0]["falls"]
    assert all(math.isfinite(value) for row in figures for value in row.values())
    assert {"reward_pose", "reward_root_pose", "kl", "clip_fraction", "explained_variance"} <= set(figures[0])
    assert {"policy_grad_norm", "value_loss", "seconds_collect", "seconds_gae", "seconds_update"} <= set(figures[0])


def test_resumed_equals_uninterrupted_to_the_bit(tmp_path: Path) -> None:
    whole = make_run(tmp_path / "whole")
    train(whole, build_loggers({"kind": "csv"}, _folder(tmp_path, "a"), {}))

    half = make_run(tmp_path / "half", iterations=3)
    outcome = train(half, [])
    assert outcome.reason == "finished"
    resumed = make_run(tmp_path / "half", seed=99)
    resumed.restore(outcome.checkpoint)
    assert resumed.counters.iteration == 3
    train(resumed, [])

    assert_same(state_of(whole), state_of(resumed))
    moments = [run.ppo.policy_optimizer.state_dict()["state"] for run in (whole, resumed)]
    for key in moments[0]:
        assert torch.equal(moments[0][key]["exp_avg_sq"], moments[1][key]["exp_avg_sq"])
    assert vars(whole.counters)["frames"] == vars(resumed.counters)["frames"]
    base = [run.collector.env.base_env for run in (whole, resumed)]
    assert torch.equal(base[0].x, base[1].x)


def _folder(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    return tmp_path / name


def test_ctrl_c_finishes_the_iteration_saves_and_says_so(tmp_path: Path) -> None:
    run = make_run(tmp_path, evaluate_every=1)

    def interrupt(iteration: int) -> dict[str, float]:
        if iteration == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return {"score": float(iteration)}

    before = signal.getsignal(signal.SIGINT)
    outcome = train(run, [], interrupt)
    assert (outcome.reason, outcome.iteration) == ("interrupted", 2)
    assert (outcome.checkpoint / "manifest.json").is_file()
    assert signal.getsignal(signal.SIGINT) is before


def test_budgets_stop_the_run(tmp_path: Path) -> None:
    assert train(make_run(tmp_path / "a", total_steps=512), []).reason == "total_steps"
    outcome = train(make_run(tmp_path / "b", iterations=10_000, max_seconds=1.0, checkpoint_every=1000), [])
    assert outcome.reason == "max_seconds"
    assert outcome.iteration >= 1


def test_full_batch_and_fixed_step_size(tmp_path: Path) -> None:
    run = make_run(tmp_path, minibatch_size=None, target_kl=None, epochs=2)
    figures = iterate(run, iter(run.collector))
    assert figures["policy_lr"] == SETTINGS["policy_lr"]
    steps = run.ppo.policy_optimizer.state_dict()["state"][0]["step"]
    assert steps == 2


@pytest.mark.parametrize(
    ("kl", "before", "after"),
    [
        (0.05, 3e-3, 3e-3 / 1.5),  # beyond twice the target of 0.02
        (0.04, 3e-3, 3e-3),
        (0.01, 3e-3, 3e-3),
        (0.009, 3e-3, 3e-3 * 1.5),  # below half of it
        (0.0, 3e-3, 3e-3),  # a policy that did not move says nothing of its step size
        (0.05, 1.1e-4, 1e-4),  # the range ends
        (0.009, 9e-3, 1e-2),
        (float("inf"), 3e-3, 3e-3 / 1.5),
        (float("nan"), 3e-3, 3e-3),
    ],
)
def test_the_step_size_follows_the_divergence(
    kl: float, before: float, after: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rudin et al. 2022: divided by 1.5 beyond twice the target, times 1.5 below half of it, within its range."""
    run = make_run(tmp_path, epochs=1)
    monkeypatch.setattr(run.ppo, "divergence", lambda _: kl)
    run.ppo.policy_optimizer.param_groups[0]["lr"] = before
    assert iterate(run, iter(run.collector))["policy_lr"] == pytest.approx(after, rel=1e-12)


def test_the_explained_variance_is_that_of_the_critic_before_the_update(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    rows = run.ppo.advantages(next(iter(run.collector)))
    value = run.ppo.critic(rows.select(*run.ppo.critic.in_keys))["state_value"].detach().numpy()
    target = rows["value_target"].numpy()
    expected = 1 - np.var(target - value) / np.var(target)
    assert run.ppo.update(rows)["explained_variance"] == pytest.approx(expected, abs=1e-5)
    assert "explained_variance" not in run.ppo.loss(rows)


def test_a_fall_bootstraps_nothing_and_the_time_limit_does() -> None:
    actor, critic = networks()
    for parameter in critic.parameters():
        parameter.data.zero_()
    list(critic.parameters())[-1].data.fill_(10.0)  # V = 10 everywhere
    ppo = PPO(actor, critic, PPOSettings.from_config({**SETTINGS, "normalize_advantage": False}))
    env = make_env(num_envs=2)
    batch = env.rollout(4, actor, break_when_any_done=False)
    reward = batch["next", "reward"]
    reward.fill_(1.0)
    for name in ("done", "terminated", "truncated"):
        batch["next", name].zero_()
    batch["next", "done"][:, 2] = True
    batch["next", "terminated"][0, 2] = True
    batch["next", "truncated"][1, 2] = True
    rows = ppo.advantages(batch)
    target = rows["value_target"].reshape(2, 4)
    gamma, lmbda = 0.95, 0.95
    # By hand, V = 10 and r = 1: the last step's target is r, or r + gamma V; before it the lambda return.
    for world, last in ((0, 1.0), (1, 1.0 + gamma * 10)):
        expected = [last]
        for _ in range(2):
            expected.insert(0, 1 + gamma * ((1 - lmbda) * 10 + lmbda * expected[0]))
        assert target[world, :3].tolist() == pytest.approx(expected, rel=1e-5)
    assert target[:, 3].tolist() == pytest.approx([1 + gamma * 10] * 2, rel=1e-5)


def test_a_time_limit_after_which_nothing_comes_bootstraps_nothing() -> None:
    actor, critic = networks()
    for parameter in critic.parameters():
        parameter.data.zero_()
    list(critic.parameters())[-1].data.fill_(10.0)
    settings = {**SETTINGS, "normalize_advantage": False, "truncation_bootstraps": False}
    ppo = PPO(actor, critic, PPOSettings.from_config(settings))
    batch = make_env(num_envs=2).rollout(3, actor, break_when_any_done=False)
    batch["next", "reward"].fill_(1.0)
    for name in ("done", "terminated", "truncated"):
        batch["next", name].zero_()
    batch["next", "done"][:, 1] = True
    batch["next", "terminated"][0, 1] = True
    batch["next", "truncated"][1, 1] = True
    target = ppo.advantages(batch)["value_target"].reshape(2, 3)
    assert target[:, 1].tolist() == pytest.approx([1.0, 1.0])
    assert target[:, 2].tolist() == pytest.approx([1 + 0.95 * 10] * 2), "the batch's end is no episode's"
    assert batch["next", "terminated"][:, 1].flatten().tolist() == [True, False]


def test_divergence_is_the_closed_form() -> None:
    actor, critic = networks()
    ppo = PPO(actor, critic, PPOSettings.from_config(SETTINGS))
    batch = make_env().rollout(5, actor, break_when_any_done=False)
    rows = ppo.advantages(batch)
    assert ppo.divergence(rows) == pytest.approx(0.0, abs=1e-7)
    rows["loc"] = rows["loc"] + 0.3
    # Two Gaussians of equal sigma 0.3, means 0.3 apart in two dimensions: 2 * 0.3^2 / (2 * 0.3^2) = 1.
    assert ppo.divergence(rows) == pytest.approx(1.0, rel=1e-5)


def test_nonfinite_minibatches_are_skipped_then_stop_the_run(tmp_path: Path) -> None:
    run = make_run(tmp_path, minibatch_size=None, epochs=1)
    batch = next(iter(run.collector))
    rows = run.ppo.advantages(batch)
    before = state_of(run)
    rows["advantage"][0] = float("nan")
    assert run.ppo.update(rows)["skipped_minibatches"] == 1
    assert_same(before, state_of(run))

    run = make_run(tmp_path, minibatch_size=None, epochs=4)
    run.collector.env.base_env.x.fill_(float("nan"))
    run.collector._carrier["humanoid_state"].fill_(float("nan"))
    with pytest.raises(TrainingDiverged, match="no checkpoint had been written"):
        train(run, [])


def test_figures_of_a_batch() -> None:
    done = torch.tensor([[0, 1, 0], [0, 0, 1]], dtype=torch.bool)[..., None]
    terminated = torch.tensor([[0, 1, 0], [0, 0, 0]], dtype=torch.bool)[..., None]
    after = TensorDict(
        {
            "reward": torch.arange(6.0).reshape(2, 3, 1),
            "reward_terms": TensorDict({"pose": torch.full((2, 3, 1), 0.5)}, batch_size=[2, 3]),
            "done": done,
            "terminated": terminated,
            "episode_step": torch.tensor([[3, 4, 1], [10, 11, 12]])[..., None],
            "diverged": terminated.clone(),
        },
        batch_size=[2, 3],
    )
    figures = batch_metrics(TensorDict({"next": after}, batch_size=[2, 3]))
    assert figures == {
        "reward": 2.5,
        "reward_pose": 0.5,
        "episodes": 2.0,
        "falls": 0.5,
        "episode_length": 8.0,
        "diverged": 1.0,
    }


def test_curves_drop_what_a_resumed_run_redoes_and_take_new_columns(tmp_path: Path) -> None:
    curves = CsvCurves(tmp_path / "curves.csv")
    for i in (1, 2, 3):
        curves.write(100 * i, {"iteration": float(i), "reward": 0.1 * i})
    again = CsvCurves(tmp_path / "curves.csv", iteration=2)
    again.write(300, {"iteration": 3.0, "reward": 9.0, "evaluation/score": 1.0})
    again.write(400, {"iteration": 4.0, "reward": 8.0})
    with (tmp_path / "curves.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["steps"] for row in rows] == ["100", "200", "300", "400"]
    assert [row["evaluation/score"] for row in rows] == ["", "", "1.0", ""]


def test_time_left_is_bounded_by_the_budget() -> None:
    line = ProgressLine(total=100, done=10, max_seconds=50.0)
    assert line.seconds_left(20, line.begin + 10.0) == pytest.approx(40.0)
    assert ProgressLine(total=100, done=10).seconds_left(20, line.begin + 10.0) == pytest.approx(80.0, abs=0.1)


def test_no_git_is_no_error(tmp_path: Path) -> None:
    assert git_state(tmp_path) == {"commit": None, "dirty": None}


def test_tensorboard_events_are_written(tmp_path: Path) -> None:
    train(make_run(tmp_path, iterations=1), build_loggers({"kind": "tensorboard"}, tmp_path, {}))
    assert list((tmp_path / "tensorboard").glob("events.out.tfevents.*"))


@pytest.mark.parametrize(
    ("key", "value", "field"),
    [
        ("gamma", 1.5, "gamma"),
        ("epochs", 0, "epochs"),
        ("policy_lr", "fast", "policy_lr"),
        ("minibatch_size", 1, "minibatch_size"),
        ("policy_lr_range", [1e-4], "policy_lr_range"),
        ("policy_lr_range", [1e-3, 1e-4], "policy_lr_range"),
        ("target_kl", 0.0, "target_kl"),
    ],
)
def test_wrong_settings_name_their_field(key: str, value: Any, field: str) -> None:
    with pytest.raises(InputError) as caught:
        PPOSettings.from_config({**SETTINGS, key: value})
    assert caught.value.field == field


def test_missing_setting_names_its_field() -> None:
    with pytest.raises(InputError, match="lmbda: is missing"):
        PPOSettings.from_config({k: v for k, v in SETTINGS.items() if k != "lmbda"})


def test_unknown_logger_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="kind"):
        build_loggers({"kind": "paper"}, tmp_path, {})


def test_an_action_is_compared_with_its_neighbours_of_the_same_episode() -> None:
    """By hand: five steps, an episode ends with the third; its last and the next one's first have one neighbour."""
    loc = torch.tensor([[[1.0], [4.0], [2.0], [10.0], [20.0]]])
    done = torch.tensor([[[False], [False], [True], [False], [False]]])
    assert _between_neighbours(loc, done)[0, :, 0].tolist() == [4.0, 1.5, 4.0, 20.0, 10.0]
    alone = torch.ones_like(done)
    assert torch.equal(_between_neighbours(loc, alone), loc)
