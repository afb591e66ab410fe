"""Tuples of an episode are chosen by equation 13 of Yu, Park & Lee 2021."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.toy_problem import SETTINGS, make_run, networks
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.training.adaptive_sampling import first_frame_probability, sampled_tuples
from egopose.training.loop import iterate
from egopose.training.ppo import PPO, PPOSettings


def test_the_formula() -> None:
    """1 / (n + 1) over their sum: of 1, 1/2 and 1/4 the sum is 7/4."""
    probability = first_frame_probability(torch.tensor([0, 1, 3]))
    torch.testing.assert_close(probability, torch.tensor([4 / 7, 2 / 7, 1 / 7], dtype=torch.float64))


@settings(max_examples=60, deadline=None)
@given(
    length=st.integers(1, 5),
    flags=st.lists(st.lists(st.booleans(), min_size=9, max_size=9), min_size=1, max_size=3),
    seed=st.integers(0, 99),
)
def test_each_episode_gives_consecutive_tuples_of_its_own(length: int, flags: list[list[bool]], seed: int) -> None:
    torch.manual_seed(seed)
    done = torch.tensor(flags)
    worlds, steps = done.shape
    frame = torch.zeros(worlds, steps, dtype=torch.int64)
    episode, number = torch.zeros_like(frame), 0
    for world in range(worlds):
        for step in range(steps):
            begins = step == 0 or bool(done[world, step - 1])
            number += begins
            episode[world, step] = number
            frame[world, step] = (3 * world + step) % 4 if begins else frame[world, step - 1] + 1
    rows = sampled_tuples(frame, done, length)
    assert len(rows) == len(rows.unique())
    for one in episode.unique():
        own = (episode.flatten() == one).nonzero().squeeze(-1)
        taken = [row for row in rows.tolist() if row in set(own.tolist())]
        assert len(taken) == min(length, len(own))
        assert taken == list(range(taken[0], taken[0] + len(taken)))


def test_frames_of_which_few_were_taken_are_taken_next() -> None:
    """Two tuples of each of many episodes over the same twelve frames: every frame comes about equally often.

    Uniform first frames would take the two outer frames half as often as the others.
    """
    torch.manual_seed(0)
    frame = torch.arange(12).expand(600, 12)
    done = torch.zeros(600, 12, dtype=torch.bool)
    done[:, -1] = True
    counts = torch.bincount(frame.flatten()[sampled_tuples(frame, done, 2)], minlength=12).double()
    torch.manual_seed(0)
    uniform = torch.randint(11, (600,))
    plain = torch.bincount(torch.cat([uniform, uniform + 1]), minlength=12).double()
    assert counts[[0, -1]].mean() / counts[1:-1].mean() > plain[[0, -1]].mean() / plain[1:-1].mean() + 0.1
    assert int(counts.sum()) == 1200


def test_the_first_episode_draws_uniformly_and_the_next_away_from_it() -> None:
    """The choice of the second episode, worked out by hand: the first took frames 0 and 1 of three."""
    frame, done = torch.tensor([[0, 1, 0, 1, 2]]), torch.tensor([[False, True, False, False, True]])
    draws = []
    for seed in range(1000):
        torch.manual_seed(seed)
        draws.append(int(sampled_tuples(frame, done, 2)[2]) - 2)
    # First frames 0 and 1 have one tuple each, so both are as likely.
    assert 0.46 < sum(draws) / len(draws) < 0.54
    frame, done = torch.tensor([[0, 1, 2, 0, 1, 2]]), torch.tensor([[False, False, True, False, False, True]])
    seconds = []
    for seed in range(1500):
        torch.manual_seed(seed)
        rows = sampled_tuples(frame, done, 1).tolist()
        if rows[0] == 0:
            seconds.append(rows[1] - 3)
    shares = [seconds.count(frame) / len(seconds) for frame in range(3)]
    assert shares == pytest.approx([0.2, 0.4, 0.4], abs=0.04)  # 1/2, 1, 1 over 5/2


def test_a_run_learns_from_them_and_a_memory_refuses(tmp_path: Path) -> None:
    run = make_run(tmp_path, adaptive_sampling=4, minibatch_size=8)
    batches = iter(run.collector)
    batch = next(batches)
    batch["frame"] = batch["episode_step"]
    rows = run.ppo.advantages(batch)
    ends = int(batch["next", "done"][:, :-1].sum()) + len(batch)
    assert len(rows) <= 4 * ends
    assert len(rows) < batch.numel()
    assert run.ppo.update(rows)["skipped_minibatches"] == 0
    actor, critic = networks()
    with pytest.raises(InputError, match="adaptive_sampling"):
        PPOSettings.from_config({**SETTINGS, "adaptive_sampling": 0})
    with pytest.raises(InputError, match="optimizer"):
        PPOSettings.from_config({**SETTINGS, "optimizer": "sgd"})
    learner = PPO(actor, critic, PPOSettings.from_config({**SETTINGS, "optimizer": "nesterov", "momentum": 0.8}))
    assert isinstance(learner.policy_optimizer, torch.optim.SGD)
    group = learner.value_optimizer.param_groups[0]
    assert (group["momentum"], group["nesterov"]) == (0.8, True)


def test_nesterov_learns(tmp_path: Path) -> None:
    run = make_run(tmp_path, optimizer="nesterov", target_kl=None, policy_lr=1e-2, value_lr=1e-3)
    batches = iter(run.collector)
    figures = [iterate(run, batches) for _ in range(12)]
    assert figures[-1]["reward"] > figures[0]["reward"]
