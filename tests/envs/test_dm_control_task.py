"""One definition, two environments: dm_control's single world equals the batch to 1e-9."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, build_problem, environment, group, problem
from helpers.forecast_curves import curves
from helpers.humanoid_stand_in import reference_motion, stand_in
from torchrl.envs.libs.dm_control import DMControlWrapper
from torchrl.envs.utils import check_env_specs

from egopose.envs.dm_control_task import load_environment
from egopose.envs.starts import WholeFragments
from egopose.tasks.dataset import Dataset


def pair(**kwargs):
    given = problem(**kwargs)
    starts = WholeFragments(PIECES[:1], given.takes.offsets, given.takes.lengths)
    batch = environment(3, problem=given, fragments=PIECES[:1], whole_fragments=True, threads=2)
    return load_environment(given, starts), batch


@pytest.mark.parametrize("scale", [0.1, 3.0])
def test_both_environments_agree(scale: float) -> None:
    """Observations before the cast, rewards, terms and endings over a whole episode, calm and falling over."""
    one, batch = pair(termination={"enabled": scale > 1, "head_drop": 0.1})
    step, td = one.reset(), batch.reset()
    rng = np.random.default_rng(0)
    ended = False
    for _ in range(39):
        z = batch.problem.observation(batch.body_state())
        np.testing.assert_allclose(step.observation["humanoid_state"], z[1], atol=1e-9, rtol=0)
        assert step.observation["frame"][0] == td["frame"][1].item()
        action = rng.normal(0, scale, batch.action_spec.shape[-1]).astype(np.float32)
        step = one.step(action)
        td = batch.step(td.set("action", torch.from_numpy(action).expand(3, -1)))["next"]
        reward, terms = batch.problem.rewards(
            batch.problem.step_view(batch.body_state(), batch.frame, td["episode_step"].squeeze(-1))
        )
        assert step.reward == pytest.approx(reward[1].item(), abs=1e-9)
        assert one.task.reward_terms == pytest.approx({k: v[1].item() for k, v in terms.items()}, abs=1e-9)
        assert step.last() == td["done"][1].item()
        if step.last():
            assert (step.discount == 0) == td["terminated"][1].item()
            assert (step.discount == 1) == td["truncated"][1].item()
            ended = True
            break
    assert ended
    assert (step.discount == 0) == (scale > 1)


def test_with_forecasts_both_begin_where_the_curve_does() -> None:
    """A forecast begins in its own first state, not in the reference's: in both environments."""
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    forecasts = curves(Dataset(humanoid, reference, takes, PIECES, PIECES))
    forecasts.coefficients[..., 5:] += 0.05
    task = group("task", "forecasting")
    given = build_problem(humanoid, reference, takes, task, group("reward", "forecasting"), forecasts=forecasts)
    starts = WholeFragments(PIECES[:1], takes.offsets, takes.lengths)
    batch = environment(2, problem=given, fragments=PIECES[:1], whole_fragments=True)
    one = load_environment(given, starts)
    step, td = one.reset(), batch.reset()
    plain = given.observation(given.reference_at(batch.frame))
    assert (td["humanoid_state"] - plain).abs().max() > 0.03, "the curve begins elsewhere than the reference"
    rng = np.random.default_rng(1)
    for _ in range(8):
        z = given.observation(batch.body_state())
        np.testing.assert_allclose(step.observation["humanoid_state"], z[1], atol=1e-9, rtol=0)
        action = rng.normal(0, 0.1, batch.action_spec.shape[-1]).astype(np.float32)
        step = one.step(action)
        td = batch.step(td.set("action", torch.from_numpy(action).expand(2, -1)))["next"]


def test_divergence_ends_the_single_world_too(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    one, _ = pair()
    one.reset()
    one.physics.data.qvel[8] = np.nan
    step = one.step(np.zeros(one.action_spec().shape))
    assert step.last()
    assert step.discount == 0
    assert step.reward == 0
    assert one.step(np.zeros(one.action_spec().shape)).first()


def test_it_works_in_torchrls_wrapper() -> None:
    one, _ = pair()
    env = DMControlWrapper(one)
    check_env_specs(env)
    td = env.rollout(5)
    assert torch.isfinite(td["next", "humanoid_state"]).all()
