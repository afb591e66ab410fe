"""Looking ahead by Gauss-Newton: bodies come nearer to their target, few worlds do as many, settings are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import two_takes
from helpers.two_takes import critic, humanoid, passive
from scipy.spatial.transform import Rotation

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.problem import Followed, global_frame
from egopose.inference.estimator import Estimate, estimate_takes
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.gauss_newton_planner import GaussNewtonPlanner, GaussNewtonSettings
from egopose.inference.planners import build_planner, read_planner

FRAMES = 24
HINGES = humanoid().mj_model.nu
SMALL = {"samples": 1 + HINGES, "horizon": 8, "changed": 3, "every": 3, "recovery_rounds": 0}


def leaning() -> EgoPoseEnv:
    """Two bodies some frames after their start, not where the reference has them."""
    env = two_takes.make_env(2, FRAMES)
    env.reset()
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    for _ in range(3):
        base.try_step(0.2 * torch.randn(2, HINGES, generator=torch.Generator().manual_seed(1)))
    return base


def settings(**changed: Any) -> GaussNewtonSettings:
    values = compose_config("evaluate", ["checkpoint=none", "planner=gauss_newton"])["planner"]
    made = read_planner({**values, **SMALL, **changed})
    assert isinstance(made, GaussNewtonSettings)
    return made


def planner_for(num_envs: int, **changed: Any) -> GaussNewtonPlanner:
    reference, chosen = two_takes.true_motion(FRAMES)[0], settings(**changed)
    followed = Followed(humanoid_state(reference).float(), global_frame, root_on_floor(reference["qpos"]))
    planner = build_planner(
        two_takes.make_env(num_envs * chosen.samples, FRAMES), passive(), critic(), chosen, followed
    )
    assert isinstance(planner, GaussNewtonPlanner)
    return planner


def run(planner: GaussNewtonPlanner | None) -> list[Estimate]:
    guard = FailSafe(2, FailSafeSettings("off", reset_threshold=0.6, fallen_height=0.3))
    states = humanoid_state(two_takes.true_motion(FRAMES)[0]).float()
    return estimate_takes(two_takes.make_env(2, FRAMES), passive(), critic(), states, guard, planner=planner)


def test_a_body_comes_nearer_to_what_it_follows() -> None:
    alone, ahead = run(None), run(planner_for(2))
    reference = two_takes.true_motion(FRAMES)[0]["qpos"].reshape(2, FRAMES, -1).numpy()
    for one, other, true in zip(alone, ahead, reference, strict=True):
        np.testing.assert_array_equal(one.qpos[0], other.qpos[0])
        away = [np.abs(motion.qpos[:, 2:] - true[:, 2:]).mean() for motion in (one, other)]
        assert away[1] < 0.8 * away[0]


def test_the_target_itself_costs_offsets_alone_wherever_its_path_is_laid() -> None:
    """Poses are compared where the path lies: here a quarter turned, and beside the reference."""
    weights = compose_config("evaluate", ["checkpoint=none", "planner=gauss_newton"])["planner"]["weights"]
    poses = dict.fromkeys(weights, 0.0) | {"bodies": 100.0, "turn": 1.0, "joints": 1.0, "last": 1.0}
    planner, offset = planner_for(2, weights=poses), planner_for(2, weights={**poses, "offsets": 2.0})
    base, steps = leaning(), planner.settings.horizon
    assert planner.path is not None
    turned = base.body_state()["qpos"].clone()
    turned[:, 3:7] = torch.tensor([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], dtype=torch.float64)
    planner.path.advance(base.frame, turned)
    offset.path = planner.path
    futures = planner._simulated(base.state_dict(), torch.zeros(1, 2, steps, HINGES))
    assert futures is not None
    wanted = two_takes.true_motion(FRAMES)[0]["qpos"].numpy()[futures.row.numpy()]
    place, heading = (part.numpy() for part in planner.path.at(futures.row))
    turns = heading - root_on_floor(torch.from_numpy(wanted))[:, 2].numpy()
    upright = Rotation.from_rotvec(np.outer(turns, [0.0, 0.0, 1.0]))
    wanted[:, :2] = place
    wanted[:, 3:7] = (upright * Rotation.from_quat(wanted[:, 3:7], scalar_first=True)).as_quat(scalar_first=True)
    added = torch.full((1, 2, steps, HINGES), 0.1)
    assert (planner._residuals(futures, added) ** 2).sum(-1).min() > 0.1, "the body is not there by itself"
    futures.qpos[:] = wanted.reshape(futures.qpos.shape)
    np.testing.assert_allclose(planner._residuals(futures, added), 0.0, atol=1e-3)
    cost = (offset._residuals(futures, added) ** 2).sum(-1)
    np.testing.assert_allclose(cost, 2.0 * steps * HINGES * 0.1**2, rtol=1e-4)


def test_some_worlds_do_what_they_do_among_all() -> None:
    base, planner = leaning(), planner_for(2)
    candidates = planner._perturbations(planner.settings.samples)
    whole, part = (planner._simulated(base.state_dict(), some) for some in (candidates, candidates[:3]))
    assert whole is not None
    assert part is not None
    np.testing.assert_array_equal(part.qpos, whole.qpos[:, : 3 * 2])
    np.testing.assert_array_equal(part.qvel, whole.qvel[:, : 3 * 2])
    assert torch.equal(part.value, whole.value[: 3 * 2])


def test_the_step_taken_costs_no_more_than_the_plan_so_far_and_than_none() -> None:
    base, planner = leaning(), planner_for(2)
    planner.perturbation(base)  # lays the path
    planner._plan += 0.05
    tried = planner._searched(base.state_dict())
    assert tried is not None
    assert len(tried.candidates) == 2 + len(planner.settings.dampings)
    assert not tried.candidates[0].any()
    assert torch.equal(tried.candidates[1], planner._plan[:, : planner.settings.horizon])
    assert (tried.score.amax(0) > tried.score[:2].amax(0)).all()
    before = planner._plan.clone()
    planner._choose(tried)
    assert not torch.equal(planner._plan, before)


def test_nothing_of_the_planned_bodies_is_touched() -> None:
    base, planner = leaning(), planner_for(2)
    before = {key: value.clone() for key, value in base.state_dict().items()}
    planner.perturbation(base)
    for key, value in base.state_dict().items():
        assert torch.equal(value, before[key]), key


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("changed", 9),
        ("changed", 0),
        ("iterations", 0),
        ("difference", 0.0),
        ("reach", 0.0),
        ("dampings", []),
        ("every", 9),
    ],
)
def test_settings_out_of_range_are_refused(name: str, value: object) -> None:
    with pytest.raises(InputError) as caught:
        settings(**{name: value})
    assert caught.value.field == name


def test_samples_that_are_not_one_for_each_knot_are_refused() -> None:
    with pytest.raises(InputError, match=f"must be 1 .* = {1 + HINGES}"):
        planner_for(1, samples=2 + HINGES)


def test_a_target_motion_without_a_path_is_refused() -> None:
    states, chosen = humanoid_state(two_takes.true_motion(FRAMES)[0]).float(), settings()
    with pytest.raises(InputError, match="planner=ahead"):
        build_planner(
            two_takes.make_env(chosen.samples, FRAMES), passive(), critic(), chosen, Followed(states, global_frame)
        )
