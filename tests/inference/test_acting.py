"""The quick way of an estimate beside TorchRL's own: the same bodies, values and restarts to the bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, environment, group, problem
from tensordict.nn import TensorDictModule

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.transforms import StateNormalizer
from egopose.inference import estimator
from egopose.inference.acting import Acting, QuickActing, acting, runs_quickly
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.models.policy import PolicySettings, build_actor, build_critic


def make_env() -> TransformedEgoPoseEnv:
    falls = {"termination": {"enabled": False, "head_drop": 0.1}}
    base = environment(len(PIECES), problem=problem(**falls), whole_fragments=True)
    return TransformedEgoPoseEnv(base, StateNormalizer(base.observation_spec["humanoid_state"].shape[-1]))


def networks() -> tuple[torch.nn.Module, torch.nn.Module]:
    env = make_env()
    torch.manual_seed(0)
    nothing = {**group("model", "fast")["context"], "source": "none"}
    model = {**group("model", "fast"), "hidden": [16], "inputs": [], "feedback": None, "base": None, "context": nothing}
    settings = PolicySettings.from_config(model)
    widths = {"humanoid_state": env.observation_spec["humanoid_state"].shape[-1]}
    actor = build_actor(settings, widths, env.action_spec.shape[-1])
    critic = build_critic(settings, widths)
    env.close()
    return actor, critic


def estimates(actor, critic) -> tuple[list[estimator.Estimate], list[np.ndarray]]:
    env = make_env()
    base = env.base_env
    states = humanoid_state(base.problem.reference_at(torch.arange(base.problem.n_frames))).float()
    # Values of an untrained critic are near zero: bodies that fall are restarted by their height.
    guard = FailSafe(len(PIECES), FailSafeSettings("naive", reset_threshold=0.6, fallen_height=1.4))
    seen: list[np.ndarray] = []
    result = estimator.estimate_takes(env, actor, critic, states, guard, watch=lambda qpos: seen.append(qpos.copy()))
    env.close()
    return result, seen


def test_the_quick_way_is_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    actor, critic = networks()
    quick, seen = estimates(actor, critic)
    monkeypatch.setattr(estimator, "acting", Acting)
    slow, _ = estimates(actor, critic)
    assert sum(one.n_resets for one in slow) > 0
    for one, other in zip(quick, slow, strict=True):
        for name in ("qpos", "value", "triggered", "resets", "fallen"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert len(seen) == max(len(one.qpos) for one in quick)
    for row, one in enumerate(quick):
        np.testing.assert_array_equal(np.stack(seen)[: len(one.qpos), row], one.qpos)


def test_only_plain_parts_run_quickly() -> None:
    env = make_env()
    actor, critic = networks()
    assert isinstance(acting(env, actor, critic), QuickActing)
    assert not runs_quickly(lambda entries: entries, critic)
    nested = TensorDictModule(lambda x: x, in_keys=[("a", "b")], out_keys=["state_value"])
    assert not runs_quickly(actor, nested)
    assert type(acting(env, actor, nested)) is Acting
    env.close()
