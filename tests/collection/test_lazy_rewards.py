"""Rewards and probabilities worked out for a batch at once are those of its steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.env_stand_in import environment
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import check_env_specs
from torchrl.modules import IndependentNormal, ProbabilisticActor

from egopose.collection.collectors import (
    CollectorSettings,
    SlowPolicyWarning,
    build_collector,
    load_simulation_state,
    load_transform_state,
    simulation_state,
    transform_state,
)
from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.envs.forecasting_transforms import RecurrentStates
from egopose.envs.transforms import StateNormalizer
from egopose.models.recurrent import hidden_keys, state_memory

WORLDS, STEPS = 5, 20
SETTINGS = CollectorSettings("sync", num_envs=WORLDS, physics_threads=1, workers=1, threads=1, update_threads=1)


def make_env(number: int = 0) -> TransformedEgoPoseEnv:
    base = environment(WORLDS, seed=3)
    return TransformedEgoPoseEnv(base, StateNormalizer(base.observation_spec["humanoid_state"].shape[-1]))


class Gaussian(nn.Module):
    def __init__(self, states: int, actions: int) -> None:
        super().__init__()
        self.mean = nn.Linear(states, actions)

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        mean = 0.1 * self.mean(state)
        return mean, torch.full_like(mean, 0.3)


def make_actor(env: TransformedEgoPoseEnv) -> TensorDictModuleBase:
    torch.manual_seed(1)
    network = Gaussian(env.observation_spec["humanoid_state"].shape[-1], env.action_spec.shape[-1])
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["humanoid_state"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def test_a_batch_is_what_torchrls_collector_gives_of_an_environment_that_defers_nothing() -> None:
    env = make_env()
    actor = make_actor(env)
    options = {"frames_per_batch": WORLDS * STEPS, "total_frames": -1, "track_traj_ids": False}
    theirs = iter(Collector(env, actor, auto_register_policy_transforms=False, **options))
    torch.manual_seed(2)
    expected = [next(theirs) for _ in range(2)]
    mine = iter(build_collector(SETTINGS, make_env, actor, WORLDS * STEPS))
    torch.manual_seed(2)
    for batch in expected:
        got = next(mine)
        assert batch["next", "done"].any()
        missing = set(batch.keys(True, True)) - set(got.keys(True, True))
        assert {key[0] for key in missing} == {"reward_terms"}  # of the step before: nothing reads them
        assert set(got.keys(True, True)) <= set(batch.keys(True, True))
        for key in got.keys(True, True):
            exact = {"rtol": 0, "atol": 0}
            close = {"rtol": 1e-6, "atol": 1e-6}
            torch.testing.assert_close(got[key], batch[key], **(close if key == "action_log_prob" else exact))


class Steady(nn.Module):
    """Actions that depend on their own world alone, and next to nothing on chance."""

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        mean = 0.3 * state[:, 5:25].sin()
        return mean, torch.full_like(mean, 1e-9)


def test_the_switch_off_gives_the_same_numbers_by_torchrls_own_rollout() -> None:
    """``collector.fast=false`` with TorchRL's stepping, resets and rewards at each step, against the quick path."""
    actor = make_actor(make_env())
    steps = WORLDS * STEPS
    slow = build_collector(replace(SETTINGS, fast=False), make_env, actor, steps)
    assert type(slow) is Collector
    assert not slow.env.fast
    assert "reward_terms" in slow.env.base_env.observation_spec.keys(), "rewards come with each step"  # noqa: SIM118
    batches = []
    for collector in (slow, build_collector(SETTINGS, make_env, actor, steps)):
        torch.manual_seed(2)
        rows = iter(collector)
        batches.append([next(rows) for _ in range(3)])
        collector.shutdown()
    for theirs, ours in zip(*batches, strict=True):
        assert theirs["next", "done"].any()
        for key in set(theirs.keys(True, True)):
            if key[0] == "reward_terms":  # of the step before: nothing reads them
                continue
            want, got = theirs[key], ours[key]
            torch.testing.assert_close(got.double(), want.double(), rtol=1e-6, atol=1e-6, msg=str(key))


def test_lanes_that_take_turns_give_what_all_worlds_in_step_give() -> None:
    def steady_env(number: int) -> TransformedEgoPoseEnv:
        base = environment(WORLDS, seed=3)
        return TransformedEgoPoseEnv(
            base, StateNormalizer(base.observation_spec["humanoid_state"].shape[-1], frozen=True)
        )

    actor = ProbabilisticActor(
        TensorDictModule(Steady(), in_keys=["humanoid_state"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    together, in_turn = (
        build_collector(replace(SETTINGS, env_groups=env_groups, physics_threads=2), steady_env, actor, WORLDS * STEPS)
        for env_groups in (1, 2)
    )
    for _, a, b in zip(range(3), together, in_turn, strict=False):
        assert a["next", "done"].any()
        assert set(a.keys(True, True)) == set(b.keys(True, True))
        for key in a.keys(True, True):
            if key != "action_log_prob":  # of a draw that differs in the twelfth digit
                torch.testing.assert_close(a[key], b[key], rtol=1e-5, atol=1e-5)


def test_a_lane_that_is_resumed_goes_on_to_the_bit() -> None:
    build = partial(build_collector, replace(SETTINGS, env_groups=2), make_env, make_actor(make_env()), WORLDS * STEPS)
    first, second = build(), build()
    batches, again = iter(first), iter(second)
    next(batches)
    load_transform_state(second, {key: value.clone() for key, value in transform_state(first).items()})
    load_simulation_state(second, simulation_state(first))
    torch.manual_seed(4)
    expected = [next(batches).clone() for _ in range(2)]
    torch.manual_seed(4)
    for batch in expected:
        assert (batch == next(again)).all()


def test_a_batch_of_lanes_can_be_learned_from() -> None:
    collector = build_collector(replace(SETTINGS, env_groups=2), make_env, make_actor(make_env()), WORLDS * STEPS)
    batch = next(iter(collector))
    weight = torch.ones(batch["humanoid_state"].shape[-1], requires_grad=True)
    (batch["humanoid_state"] @ weight).sum().backward()
    assert weight.grad is not None


def test_a_diverged_world_earns_nothing_when_its_reward_comes_late() -> None:
    env = environment(3)
    env.make_rewards_lazy()
    td = env.reset()
    action = torch.zeros(env.action_spec.shape)
    action[1] = torch.nan
    assert env.step(td.set("action", action))["next", "reward"].isnan().all()
    due = env.rewards_due()
    assert set(due) == {"reward", *env.problem.reward.names}
    for value in due.values():
        assert value.shape == (3, 1, 1)
        assert value[1].item() == 0
        assert (value[[0, 2]] > 0).all()
    with pytest.raises(RuntimeError, match="no step waits"):
        env.rewards_due()


def test_an_environment_defers_only_when_told_and_its_specs_follow() -> None:
    env = make_env()
    check_env_specs(env)
    assert "reward_terms" in env.observation_spec
    env.make_rewards_lazy()
    assert "reward_terms" not in env.observation_spec
    assert "reward_terms" not in env.reset()


def test_a_state_from_before_rewards_were_deferred_goes_on() -> None:
    actor = make_actor(make_env())
    build = partial(build_collector, SETTINGS, make_env, actor, WORLDS * STEPS)
    first, second = build(), build()
    batches = iter(first)
    next(batches)
    simulation, transforms = simulation_state(first), transform_state(first)
    old = {**simulation["carrier"], "reward_terms.pose": torch.zeros(WORLDS, 1)}
    simulation = {"carrier": old, "worlds": simulation["worlds"]}
    again = iter(second)
    load_transform_state(second, {key: value.clone() for key, value in transforms.items()})
    load_simulation_state(second, simulation)

    def go_on(source: object) -> TensorDictBase:
        torch.manual_seed(4)
        return next(source)  # type: ignore[call-overload]

    a, b = go_on(batches), go_on(again)
    assert (a == b).all()


class Custom(TensorDictModule):
    """A module of a user's own that does what its parent does."""


def custom_actor(env: TransformedEgoPoseEnv) -> TensorDictModuleBase:
    (network, *_) = make_actor(env).module
    return ProbabilisticActor(
        Custom(network.module, in_keys=network.in_keys, out_keys=network.out_keys),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def silent_actor(env: TransformedEgoPoseEnv) -> TensorDictModuleBase:
    return make_actor(env).module[0]


@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        (custom_actor, "its part Custom is no plain TensorDictModule"),
        (silent_actor, "it is a TensorDictModule and no ProbabilisticActor"),
    ],
)
def test_a_policy_that_loses_the_quick_way_is_told_of(
    policy: Callable[[TransformedEgoPoseEnv], TensorDictModuleBase], reason: str
) -> None:
    with pytest.warns(SlowPolicyWarning, match=reason) as caught:
        collector = build_collector(SETTINGS, make_env, policy(make_env()), WORLDS * STEPS)
    collector.shutdown()
    assert len(caught) == 1


@pytest.mark.filterwarnings("error")
def test_the_usual_policy_is_called_in_the_quick_way() -> None:
    build_collector(SETTINGS, make_env, make_actor(make_env()), WORLDS * STEPS).shutdown()


@pytest.mark.filterwarnings("error")
def test_a_policy_with_a_memory_is_no_slip() -> None:
    env = make_env()
    modules, out = state_memory("policy", "humanoid_state", env.observation_spec["humanoid_state"].shape[-1], 4)
    head = TensorDictModule(nn.Linear(4, env.action_spec.shape[-1]), in_keys=[out], out_keys=["action"])
    remembering = partial(with_memory, make_env)
    build_collector(SETTINGS, remembering, TensorDictSequential(*modules, head), WORLDS * STEPS).shutdown()


def with_memory(make: Callable[[int], TransformedEgoPoseEnv], number: int) -> TransformedEgoPoseEnv:
    env = make(number)
    env.append_transform(RecurrentStates(dict.fromkeys(hidden_keys("policy"), 4)))
    return env
