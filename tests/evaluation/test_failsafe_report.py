"""The fail-safe judged by what would have come without it; reset_threshold at other discounts; confidence beside the
motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, environment, problem
from helpers.humanoid_stand_in import stand_in
from hypothesis import given
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from egopose.core.errors import InputError
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.transforms import StateNormalizer
from egopose.evaluation.reset_threshold import chosen
from egopose.evaluation.resets import CUT_SHORT, FALSE_ALARM, FORESEEN, LATE, as_dict, as_text, summary, take_triggers
from egopose.inference.counterfactuals import CounterfactualRollouts
from egopose.inference.estimator import Estimate, estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings, paper_threshold
from egopose.motion.io import read_motion, write_motion
from egopose.motion.io.csv_table import write_csv
from egopose.motion.motion import Motion
from egopose.training.survival import base_tracking


def estimate(frames: int, triggered: list[int], resets: list[int], fallen: list[int]) -> Estimate:
    flags = [np.isin(np.arange(frames), at) for at in (triggered, resets, fallen)]
    return Estimate(0, np.zeros((frames, 8)), np.ones(frames), np.linspace(1, 0.5, frames), *flags, diverged=0)


def test_every_kind_of_trigger_and_miss_is_told_apart() -> None:
    # Fell at 12, told at 15; told at 30 of a fall that would have come at 33, at 50 of none, at 95 with 4 frames left.
    # Between 51 and 79 the body fell at 60 and the physics broke at 79; from 80 on it broke untold at 90.
    told, again = [15, 30, 50, 95], [16, 31, 51, 80, 90, 96]
    found = take_triggers(estimate(100, told, again, [12, 13, 14, 15, 60]), {15: 1, 30: 3, 50: None, 95: None}, 10)
    assert [(t.frame, t.kind, t.lead) for t in found.triggers] == [
        (15, LATE, -3),
        (30, FORESEEN, 3),
        (50, FALSE_ALARM, None),
        (95, CUT_SHORT, None),
    ]
    assert found.missed == (60, 90)
    total = summary([found], 30.0)
    assert total["f1"] == pytest.approx(2 * 1 / (2 * 1 + 1 + 1 + 2))
    assert total["lead_frames"] == [-3, 3]
    assert total["triggers_per_minute"] == pytest.approx(4 / (100 / 30 / 60))
    assert total["fallen_share"] == 0.05
    assert "1 foreseen, 1 late, 1 false alarms, 1 cut short; 2 falls missed" in as_text(total)
    said = as_dict(["walk"], [found], 30.0)["takes"][0]
    assert len(said["confidence"]) == 100
    assert said["triggers"][1] == {"frame": 30, "kind": "foreseen", "lead_frames": 3}


def test_what_would_have_come_is_what_comes_without_a_fail_safe() -> None:
    def make_env(num_envs: int) -> TransformedEnv:
        given = problem(termination={"enabled": False, "head_drop": 0.02})
        base = environment(num_envs, problem=given, whole_fragments=True)
        return TransformedEnv(base, Compose(StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])))

    def run(mode: str, counterfactuals: CounterfactualRollouts | None) -> list[Estimate]:
        env = make_env(len(PIECES))
        base = env.base_env
        states = humanoid_state(base.problem.reference_at(torch.arange(base.problem.n_frames))).float()
        critic = TensorDictModule(
            lambda step: torch.where(step == 2, 0.0, 10.0), in_keys=["episode_step"], out_keys=["state_value"]
        )
        guard = FailSafe(len(PIECES), FailSafeSettings(mode, 0.6, 0.3))
        return estimate_takes(env, base_tracking(env), critic, states, guard, counterfactuals=counterfactuals)

    counterfactuals = CounterfactualRollouts()
    guarded = run("value", counterfactuals)
    assert [np.flatnonzero(e.triggered).tolist() for e in guarded] == [[2], [2]]
    assert counterfactuals.places == [(world, e.start + 2) for world, e in enumerate(guarded)]
    falls = [np.flatnonzero(e.fallen) for e in run("off", None)]
    assert any(len(at) and at[0] > 2 for at in falls)
    wanted = [int(at[0]) - 2 if len(at) else None for at in falls]
    two = make_env(2)
    assert counterfactuals.frames_to_fall(make_env, base_tracking(two), window=100) == wanted
    soon = min(frames for frames in wanted if frames)
    assert all(frames is None for frames in counterfactuals.frames_to_fall(make_env, base_tracking(two), soon - 1))


@given(discount=st.floats(0.5, 0.999))
def test_kappa_keeps_its_frames_to_the_end_at_any_discount(discount: float) -> None:
    """By the sums themselves: the value of n more frames over that of very many, n being the paper's."""
    frames = np.log(0.4) / np.log(0.95)
    assert 17 < frames < 18
    ends, goes_on = (sum(discount**k for k in range(int(count))) for count in (frames, 20000))
    longer = ends + discount ** int(frames)
    assert ends / goes_on - 1e-6 <= paper_threshold(discount) <= longer / goes_on + 1e-6
    assert paper_threshold(0.95) == pytest.approx(0.6)


def test_kappa_comes_from_the_command_line_or_the_runs_discount() -> None:
    unset = FailSafeSettings("value", None, 0.3)
    assert unset.for_run({"algo": {"gamma": 0.99}}).reset_threshold == pytest.approx(0.164, abs=5e-4)
    assert FailSafeSettings("value", 0.2, 0.3).for_run({}).reset_threshold == 0.2
    tracked = {"algo": {"gamma": 0.97}, "task": {"reset_threshold": 0.25}}
    assert unset.for_run(tracked).reset_threshold == 0.25
    assert unset.for_run(tracked, planned=0.3).reset_threshold == 0.3
    assert unset.for_run(tracked | {"task": {}}).reset_threshold == paper_threshold(0.97)
    with pytest.raises(ValueError, match="reset_threshold"):
        FailSafe(1, unset)
    with pytest.raises(InputError, match="gamma"):
        paper_threshold(1.0)


def test_the_best_kappa_is_that_of_the_largest_f1() -> None:
    rows = [
        {"reset_threshold": k, "f1": f1} for k, f1 in ((0.1, None), (0.2, 0.9), (0.3, 0.95), (0.4, 0.95), (0.5, 0.4))
    ]
    assert chosen(rows) == 0.3
    with pytest.raises(InputError, match="nothing to choose by"):
        chosen(rows[:1])


def test_confidence_stays_beside_the_motion(tmp_path: Path) -> None:
    skeleton = stand_in().skeleton
    qpos = np.tile(skeleton.rest_qpos(), (9, 1))
    motion = Motion(skeleton, qpos, 30.0, "walk", confidence=np.linspace(1.0, 0.2, 9))
    write_motion(motion, tmp_path / "walk.npz")
    assert motion.confidence is not None
    np.testing.assert_array_equal(read_motion(tmp_path / "walk.npz").confidence, motion.confidence)
    np.testing.assert_array_equal(motion.slice(2, 5).confidence, motion.confidence[2:5])
    np.testing.assert_array_equal(motion.resample(15.0).confidence, motion.confidence[::2])
    write_csv(motion, tmp_path / "walk.csv")
    table = np.genfromtxt(tmp_path / "walk.csv", delimiter=",", names=True, skip_header=4)
    np.testing.assert_allclose(table["confidence"], motion.confidence)
    with pytest.raises(ValueError, match="confidence have 4 frames"):
        Motion(skeleton, qpos, 30.0, confidence=np.ones(4))
