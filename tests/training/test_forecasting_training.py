"""Forecasting's training: memory through steps, resets and minibatches; nothing of the future seen; decayed reward."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.env_stand_in import PIECES, environment, problem
from helpers.forecast_curves import configuration as following
from helpers.forecast_curves import curves
from helpers.forecasting_run import CONTEXT, HORIZON, configuration, forecasting_dataset
from helpers.humanoid_stand_in import reference_motion, stand_in
from torchrl.modules import set_recurrent_mode

from egopose.core.errors import InputError
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.starts import Piece, after_context
from egopose.models.context import ForwardContext
from egopose.models.recurrent import PastContext, collecting_policy, hidden_keys
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.pipeline.run import build_evaluation, build_run
from egopose.tasks.dataset import Dataset
from egopose.training.loop import train


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return forecasting_dataset()


@pytest.fixture(scope="module")
def run(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return build_run(configuration(), tmp_path_factory.mktemp("run"), dataset)


def test_a_policy_that_follows_forecasts_is_looked_at_where_there_are_some(tmp_path: Path) -> None:
    """Forecasts begin on training frames alone: a look at the policy between iterations must not ask for others."""
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    known = Dataset(humanoid, reference, takes, PIECES[:1], PIECES[1:], states=humanoid_state(reference).float())
    dataset = replace(known, forecasts=curves(known))
    own = configuration(evaluate_every=1, iterations=2)
    config = {**own, **{group: value for group, value in following().items() if group != "algo"}}
    run = build_run(config, tmp_path, dataset)
    train(run, [], build_evaluation(run, dataset))
    assert run.counters.score > 0


def test_sequences_give_what_steps_gave(run: Any) -> None:
    """Batches of 20 steps hold resets and begin amid episodes; whole sequences must repeat every step to 1e-6."""
    batches = iter(run.collector)
    next(batches)
    batch = next(batches)
    assert batch.shape == (4, 20)
    begins = batch["episode_step"].squeeze(-1) == 0
    assert begins[:, 1:].any()
    assert not begins[:, 0].all()
    with torch.no_grad(), set_recurrent_mode(True):
        again = run.ppo.actor.get_dist(batch.select(*run.ppo.actor.in_keys))
        value = run.ppo.critic(batch.select(*run.ppo.critic.in_keys))["state_value"]
    torch.testing.assert_close(again.mean, batch["loc"], atol=1e-6, rtol=0)
    torch.testing.assert_close(again.log_prob(batch["action"]), batch["action_log_prob"], atol=1e-4, rtol=1e-6)

    # By hand: torch's own cell, step by step, begun anew at every reset, continued from the batch before otherwise.
    for owner, network in (("policy", run.ppo.actor), ("value", run.ppo.critic)):
        (lstm,) = (m for m in network.modules() if isinstance(m, torch.nn.LSTM) and m.input_size > 6)
        hidden = [batch[key][:, 0, 0] for key in hidden_keys(owner)]
        outputs = []
        for t in range(20):
            hidden = [h * ~begins[:, t, None] for h in hidden]
            x = batch["humanoid_state"][:, t : t + 1]
            out, state = lstm(x, (hidden[0][None], hidden[1][None]))
            hidden = [part[0] for part in state]
            outputs.append(out)
            if t < 19:
                kept = ~begins[:, t + 1]
                torch.testing.assert_close(
                    hidden[0][kept], batch[hidden_keys(owner)[0]][kept, t + 1, 0], atol=1e-6, rtol=0
                )
        torch.testing.assert_close(torch.cat(outputs, 1), batch[f"{owner}_memory"], atol=1e-6, rtol=0)

    # A single row of the batch, step by step, gives the same values: what PPO bootstraps from.
    with torch.no_grad():
        single = run.ppo.critic(batch.select(*run.ppo.critic.in_keys).reshape(-1))["state_value"]
    torch.testing.assert_close(single.reshape(4, 20, 1), value, atol=1e-6, rtol=0)


def test_states_begin_at_zero_and_end_with_the_episode(run: Any) -> None:
    batch = next(iter(run.collector))
    begins = batch["episode_step"].squeeze(-1) == 0
    for owner in ("policy", "value"):
        for key in hidden_keys(owner):
            assert (batch[key][begins] == 0).all()
            assert (batch[key][~begins] != 0).any()
            goes_on = ~batch["next", "done"].squeeze(-1)[:, :-1]
            assert torch.equal(batch["next", key][:, :-1][goes_on], batch[key][:, 1:][goes_on])


def test_gradient_steps_take_whole_sequences(run: Any) -> None:
    rows = run.ppo.advantages(next(iter(run.collector)))
    assert rows.shape == (4, 20)
    minibatches = run.ppo._minibatches(rows)
    assert [len(index) for index in minibatches] == [2, 2]  # 40 steps of 20 each
    before = {name: p.detach().clone() for name, p in run.ppo.actor.named_parameters()}
    figures = run.ppo.update(rows)
    assert figures["skipped_minibatches"] == 0
    moved = [name for name, p in run.ppo.actor.named_parameters() if not torch.equal(p, before[name])]
    assert len(moved) == len(before)  # both LSTMs as well


def test_bootstrap_values_are_those_of_the_states_that_follow(run: Any) -> None:
    """At a row's end and at the time limit: the memory's step to the next state, by hand."""
    batch = next(iter(run.collector))
    run.ppo.advantages(batch)
    critic = run.ppo.critic
    with torch.no_grad():
        wanted = critic(batch["next"].select(*critic.in_keys).reshape(-1))["state_value"].reshape(4, 20, 1)
    torch.testing.assert_close(batch["next", "state_value"], wanted, atol=1e-6, rtol=0)


def test_resumed_equals_uninterrupted_to_the_bit(dataset: Dataset, tmp_path: Path) -> None:
    whole = build_run(configuration(evaluate_every=1), tmp_path / "whole", dataset)
    train(whole, [], build_evaluation(whole, dataset))
    half = build_run(configuration(evaluate_every=1, iterations=2), tmp_path / "half", dataset)
    outcome = train(half, [], build_evaluation(half, dataset))
    again = build_run({**configuration(evaluate_every=1), "seed": 9}, tmp_path / "half", dataset)
    again.restore(outcome.checkpoint)
    train(again, [], build_evaluation(again, dataset))
    for name in ("policy", "critic"):
        first, second = (r.checkpoint().components[name].state_dict() for r in (whole, again))
        assert all(torch.equal(first[key], second[key]) for key in first), name


def test_episodes_begin_at_the_last_frame_of_a_context(dataset: Dataset) -> None:
    assert after_context([Piece(0, 10, 40), Piece(1, 0, 15), Piece(2, 0, 14)], 10, 6) == [(0, 19, 40), (1, 9, 15)]
    env = build_env(configuration(), dataset, num_envs=64)
    start = env.reset()["episode_start"].squeeze(-1)
    # PIECES: frames 0-39 of the first take (at 0), 5-24 of the second (at 40).
    assert ((start >= CONTEXT - 1) & (start < 40) | (start >= 45 + CONTEXT - 1)).all()


def test_the_context_is_of_the_past_alone_and_stays(dataset: Dataset, run: Any) -> None:
    torch.manual_seed(0)
    network = ForwardContext(6, 4)
    features = dataset.visual_features
    assert features is not None
    bounds = torch.tensor([[0, 40], [40, 65]])
    context = PastContext(features, network, bounds, CONTEXT)
    starts = torch.tensor([[4], [50], [4]])
    wanted = torch.cat([network(features[None, 0:5]), network(features[None, 46:51]), network(features[None, 0:5])])
    torch.testing.assert_close(context(starts), wanted)
    with torch.no_grad():
        torch.testing.assert_close(context(starts), wanted)
        network.lstm.bias_ih_l0 += 0.1
        assert not torch.allclose(context(starts), wanted)  # what was kept is forgotten when a parameter changes
    with pytest.raises(InputError, match="5 frames"):
        context(torch.tensor([[43]]))
    batch = next(iter(run.collector))
    same = batch["episode_start"][:, 1:] == batch["episode_start"][:, :-1]
    change = (batch["visual_context"][:, 1:] - batch["visual_context"][:, :-1]).abs().amax(-1, keepdim=True)
    assert change[same].max() < 1e-6


@pytest.mark.parametrize(
    ("group_name", "key", "value", "field"),
    [
        ("task", "action", {"reference": "regressor", "scale": 1.0}, "task.action.reference"),
        ("model", "inputs", ["tracking_error"], "model.inputs"),
        ("model", "context", {"source": "frozen", "horizon": 5}, "model.context"),
        ("model", "context", {"source": "past", "horizon": 6}, "model.context"),
    ],
)
def test_what_knows_the_future_is_refused(group_name: str, key: str, value: Any, field: str, dataset: Dataset) -> None:
    config = configuration()
    config[group_name] = {**config[group_name], key: value}
    with pytest.raises(InputError) as caught:
        build_env(config, dataset, num_envs=1)
    assert caught.value.field == field


def test_the_reward_decays_with_time() -> None:
    """Equation 7: the same state earns (T - t) / T of what it would at the start."""
    given = problem(reward="forecasting")
    plain = problem()
    frame = torch.arange(10, 19)
    state = given.reference_at(frame)
    decayed, _ = given.rewards(given.step_view(state, frame, torch.tensor([0, 9, 18, 30, 45, 60, 81, 90, 95])))
    assert torch.allclose(
        plain.rewards(plain.step_view(state, frame, torch.zeros(9)))[0], torch.ones(9, dtype=torch.float64)
    )
    wanted = torch.tensor([1, 0.9, 0.8, 2 / 3, 0.5, 1 / 3, 0.1, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(decayed, wanted)


def test_the_time_left_follows_the_decay(dataset: Dataset) -> None:
    env = build_env(configuration(), dataset, num_envs=2, fragments=[Piece(0, 0, 40)], whole_fragments=True)
    policy = collecting_policy(*build_networks(configuration(), dataset, env))
    batch = env.rollout(6, policy, break_when_any_done=False)
    torch.testing.assert_close(batch["time_left"][0, :, 0], 1 - torch.arange(6) / HORIZON)
    assert environment(2).observation_spec.get("time_left", None) is None


def test_actions_may_be_relative_to_the_pose_an_episode_begins_with(dataset: Dataset) -> None:
    config = configuration()
    config["task"] = {**config["task"], "action": {**config["task"]["action"], "reference": "start"}}
    env = build_env(config, dataset, num_envs=3)
    env.reset()
    base = env.base_env
    actions = torch.zeros(env.action_spec.shape)
    for _ in range(12):  # resets on the way
        env.step_and_maybe_reset(env.observation_spec.zero().set("action", actions))
    begun = base.problem.reference_at(base._start)["qpos"][:, 7:]
    torch.testing.assert_close(base.placed, begun)
    action = torch.full((3, begun.shape[1]), 0.05)
    low, high = base.problem._range
    wanted = torch.clamp(begun + 0.05, low, high)
    torch.testing.assert_close(base.problem.target(action, base.frame, base.placed), wanted, atol=1e-7, rtol=0)
    again = build_env(config, dataset, num_envs=3).base_env
    again.load_state_dict(base.state_dict())
    assert torch.equal(again.placed, base.placed)
    with pytest.raises(ValueError, match="placed"):
        base.problem.target(action, base.frame)


@pytest.mark.skipif(sys.platform != "linux", reason="starts processes")
@pytest.mark.slow
def test_two_processes_collect_memories_too(dataset: Dataset, tmp_path: Path) -> None:
    config = configuration(iterations=3)
    config["collector"] = {**config["collector"], "kind": "multi_sync", "workers": 2}
    run = build_run(config, tmp_path, dataset)
    try:
        batches = iter(run.collector)
        next(batches)
        run.ppo.update(run.ppo.advantages(next(batches)))
        run.collector.update_policy_weights_()
        batch = next(batches)
        with torch.no_grad(), set_recurrent_mode(True):
            again = run.ppo.actor.get_dist(batch.select(*run.ppo.actor.in_keys))
    finally:
        run.collector.shutdown()
    # The hidden states a batch begins with come from before the update; all else is the weights sent.
    torch.testing.assert_close(again.mean, batch["loc"], atol=1e-6, rtol=0)
    assert (batch["policy_hidden"][:, 0] != 0).any()
