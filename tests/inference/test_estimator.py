"""Whole takes in one pass: timing, restarts by the fail-safe, takes of different length, and survival figures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, environment, problem
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.foot_geometry import out_of_floor, sole_edges
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.estimator import Estimate, estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.motion.motion import Motion
from egopose.training.survival import action_towards, base_tracking, frames_survived, reference_tracking

NEVER_FALL = {"termination": {"enabled": False, "head_drop": 0.1}}


def make_env(whole: bool = True, n: int = 2, **task) -> TransformedEnv:
    base = environment(n, problem=problem(**task), whole_fragments=whole)
    return TransformedEnv(base, Compose(StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])))


def critic_of(rule) -> TensorDictModule:
    return TensorDictModule(rule, in_keys=["episode_step"], out_keys=["state_value"])


def steady(step: torch.Tensor) -> torch.Tensor:
    return torch.full(step.shape, 10.0)


def run(
    env: TransformedEnv, actor, critic, mode: str = "value", offset: float = 0.0
) -> tuple[list[Estimate], torch.Tensor]:
    base = env.base_env
    states = humanoid_state(base.problem.reference_at(torch.arange(base.problem.n_frames))).float() + offset
    guard = FailSafe(len(PIECES), FailSafeSettings(mode, reset_threshold=0.6, fallen_height=0.3))
    return estimate_takes(env, actor, critic, states, guard), states


def test_takes_run_side_by_side_to_their_own_ends() -> None:
    env = make_env(**NEVER_FALL)
    estimates, _ = run(env, reference_tracking(env), critic_of(steady))
    assert [len(e.qpos) for e in estimates] == [40, 20]
    assert [e.start for e in estimates] == [0, 45]
    for estimate in estimates:
        assert len(estimate.value) == len(estimate.confidence) == len(estimate.resets) == len(estimate.qpos)
        assert np.isfinite(estimate.qpos).all()
        assert np.isfinite(estimate.confidence).all()
        assert estimate.n_resets == 0
    # Tracking the reference's own joints stays near them.
    reference = env.base_env.problem.reference_at(torch.arange(40))["qpos"].numpy()
    assert np.abs(estimates[0].qpos[:, 7:] - reference[:, 7:]).max() < 0.3


def test_the_first_state_is_the_regressors_at_the_references_place() -> None:
    env = make_env(**NEVER_FALL)
    estimates, states = run(env, base_tracking(env), critic_of(steady), offset=0.01)
    reference = env.base_env.problem.reference_at(torch.tensor([0, 45]))["qpos"].numpy()
    for row, estimate in enumerate(estimates):
        start = estimate.qpos[0]
        np.testing.assert_allclose(start[:2], reference[row, :2], atol=1e-12)
        regressed = np.concatenate([start[:2], states[estimate.start, :1].numpy(), start[3:]])
        assert start[2] == pytest.approx(out_of_floor(env.base_env.problem.humanoid, regressed[None])[0, 2], abs=1e-6)
        assert start[2] != pytest.approx(reference[row, 2], abs=1e-3)


def test_a_state_that_is_regressed_into_the_floor_is_raised() -> None:
    env = make_env(**NEVER_FALL)
    estimates, _ = run(env, base_tracking(env), critic_of(steady), offset=-0.05)
    humanoid = env.base_env.problem.humanoid
    for estimate in estimates:
        corners = sole_edges(humanoid, Motion(humanoid.skeleton, estimate.qpos[:1], 30.0))
        assert corners[..., 2].min() == pytest.approx(0.0, abs=1e-9)


def test_a_trigger_restarts_from_the_next_frames_regressed_state_where_the_body_was() -> None:
    env = make_env(**NEVER_FALL)
    drop = critic_of(lambda step: torch.where(step == 7, 0.0, 10.0))
    estimates, states = run(env, base_tracking(env), drop)
    for estimate in estimates:
        assert np.flatnonzero(estimate.resets).tolist() == [8]
        before, after = estimate.qpos[7], estimate.qpos[8]
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-12)
        angles = states[estimate.start + 8, StateLayout(len(after) - 7).joint_angles]
        np.testing.assert_allclose(after[7:], angles.numpy(), atol=1e-6)
        assert estimate.confidence[7] == 0.0
    quiet, _ = run(make_env(**NEVER_FALL), base_tracking(env), drop, mode="off")
    assert [e.n_resets for e in quiet] == [0, 0]


def test_a_trigger_on_the_last_frame_changes_nothing() -> None:
    env = make_env(**NEVER_FALL)
    late = critic_of(lambda step: torch.where(step == 19, 0.0, 10.0))
    estimates, _ = run(env, base_tracking(env), late)
    assert [e.n_resets for e in estimates] == [1, 0]  # frame 19 is the second take's last


def test_physics_that_breaks_is_restarted_too() -> None:
    env = make_env(**NEVER_FALL)
    tracking = base_tracking(env)

    def broken(observation):
        observation = tracking(observation)
        if int(observation["episode_step"][0]) == 3:
            observation["action"][0] = float("nan")
        return observation

    estimates, _ = run(env, broken, critic_of(steady))
    assert estimates[0].diverged == 1
    assert np.flatnonzero(estimates[0].resets).tolist() == [4]
    assert estimates[1].n_resets == 0


def test_the_pass_repeats_to_the_bit_and_leaves_the_normaliser_alone() -> None:
    env = make_env(**NEVER_FALL)
    normaliser = env.transform[0]
    first, _ = run(env, base_tracking(env), critic_of(steady))
    second, _ = run(env, base_tracking(env), critic_of(steady))
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.qpos, two.qpos)
    assert normaliser.frozen
    assert int(normaliser.count) == 0


def test_survival_counts_frames_before_the_fall_from_the_same_starts() -> None:
    env = make_env(whole=False, n=6)
    tracked = frames_survived(env, reference_tracking(env), seed=3)
    again = frames_survived(env, reference_tracking(env), seed=3)
    assert torch.equal(tracked.frames, again.frames)
    assert (tracked.frames <= 14).all()  # a horizon of 15 frames, the first included
    assert (tracked.frames[~tracked.fell] >= 7).all()

    size = env.action_spec.shape

    def collapse(observation):
        return observation.set("action", torch.full(size, 3.0))

    # A body thrown together falls sooner, and the fall's own frame does not count.
    assert frames_survived(env, collapse, seed=3).mean < tracked.mean


def test_the_action_towards_the_reference_hits_it() -> None:
    given = problem()
    frame = torch.arange(5)
    target = given.target(action_towards(given, frame), frame)
    np.testing.assert_allclose(target.numpy(), given.reference_at(frame)["qpos"][:, 7:].numpy(), atol=1e-6)
