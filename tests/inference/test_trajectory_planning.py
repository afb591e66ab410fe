"""Looking ahead by iterative LQR: bodies stay up longer, plans are dropped with their bodies, settings are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import two_takes
from helpers.two_takes import critic, passive

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.problem import Followed, global_frame
from egopose.inference.estimator import Estimate, estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.planners import TrajectoryPlanner, TrajectoryPlannerSettings, build_planner, read_planner

FRAMES = 40


def settings(**changed: Any) -> TrajectoryPlannerSettings:
    values = compose_config("evaluate", ["checkpoint=none", "planner=trajectory"])["planner"]
    made = read_planner({**values, "horizon": 8, "every": 4, **changed})
    assert isinstance(made, TrajectoryPlannerSettings)
    return made


def planner_for(num_envs: int, **changed: Any) -> TrajectoryPlanner:
    reference, _ = two_takes.true_motion(FRAMES)
    states = humanoid_state(reference).float()
    followed = Followed(states, global_frame, root_on_floor(reference["qpos"]))
    planner = build_planner(two_takes.make_env(num_envs, FRAMES), passive(), critic(), settings(**changed), followed)
    assert isinstance(planner, TrajectoryPlanner)
    return planner


def run(planner: TrajectoryPlanner | None) -> list[Estimate]:
    guard = FailSafe(2, FailSafeSettings("off", reset_threshold=0.6, fallen_height=0.3))
    states = humanoid_state(two_takes.true_motion(FRAMES)[0]).float()
    return estimate_takes(two_takes.make_env(2, FRAMES), passive(), critic(), states, guard, planner=planner)


def test_a_body_stays_nearer_to_what_it_follows() -> None:
    """Where the pose weighs more than the controls; without a plan both bodies fall earlier."""
    cost = compose_config("evaluate", ["checkpoint=none", "planner=trajectory"])["planner"]["cost"]
    alone, ahead = run(None), run(planner_for(2, cost={**cost, "control": 1.0, "joints": 5.0}))
    reference = two_takes.true_motion(FRAMES)[0]["qpos"].reshape(2, FRAMES, -1).numpy()
    for one, other, true in zip(alone, ahead, reference, strict=True):
        np.testing.assert_array_equal(one.qpos[0], other.qpos[0])
        away = [np.abs(motion.qpos[:, 2:] - true[:, 2:]).mean() for motion in (one, other)]
        assert away[1] < 0.85 * away[0]
        assert one.fallen.any()
        # Whether a body is just above or just below the line in the last frame differs from processor to processor.
        assert other.fallen.sum() < one.fallen.sum()


def test_between_plans_gains_answer_what_differs_from_the_plan() -> None:
    planner, env = planner_for(2), two_takes.make_env(2, FRAMES)
    env.reset()
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    planner.perturbation(base)
    saved = base.state_dict()
    body = base.body_state()
    planned = planner.perturbation(base)
    planner._age -= 1
    base.place(torch.arange(2), body["qpos"], body["qvel"] + 0.1)
    pushed = planner.perturbation(base)
    assert (planned - pushed).abs().max() > 1e-3
    base.load_state_dict(saved)
    planner._age -= 1
    torch.testing.assert_close(planner.perturbation(base), planned)


def test_a_body_put_elsewhere_is_planned_for_anew() -> None:
    planner, env = planner_for(2, every=8), two_takes.make_env(2, FRAMES)
    env.reset()
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    planner.perturbation(base)
    before = planner._simulator.steps
    planner.perturbation(base)
    assert planner._simulator.steps == before, "a plan lasts"
    planner.forget(torch.tensor([1]))
    planner.perturbation(base)
    assert planner._simulator.steps > before


def test_nothing_of_the_planned_bodies_is_touched() -> None:
    planner, env = planner_for(2), two_takes.make_env(2, FRAMES)
    env.reset()
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    before = {key: value.clone() for key, value in base.state_dict().items()}
    planner.perturbation(base)
    for key, value in base.state_dict().items():
        assert torch.equal(value, before[key]), key


@pytest.mark.parametrize(("name", "value"), [("every", 9), ("every", 0), ("reach", 0.0), ("lost", -1.0)])
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError) as caught:
        settings(**{name: value})
    assert caught.value.field == name


def test_a_target_motion_without_a_path_is_refused() -> None:
    states = humanoid_state(two_takes.true_motion(FRAMES)[0]).float()
    with pytest.raises(InputError, match="planner=ahead"):
        build_planner(two_takes.make_env(1, FRAMES), passive(), critic(), settings(), Followed(states, global_frame))
