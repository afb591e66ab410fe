"""Following motion: endings by the frame of the reference, and the laid path in both environments and on resuming."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.env_stand_in import PIECES, environment
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.tracking import tracking_problem
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from egopose.envs.dm_control_task import load_environment
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.starts import WholeFragments
from egopose.envs.tracking import TrackingProblem

FRAMES = torch.tensor([3, 20, 50])
TAKES = torch.tensor([0, 0, 1])


def moved_by(problem: TrackingProblem, change: tuple[float, float, float], frames: torch.Tensor = FRAMES) -> TensorDict:
    """Bodies of the reference that stand so many metres elsewhere."""
    state = problem.reference_at(frames)
    shift = torch.tensor(change, dtype=torch.float64)
    state["qpos"][:, :3] += shift
    state["xpos"] += shift
    return state


def ended(problem: TrackingProblem, state: TensorDict, frames: torch.Tensor = FRAMES) -> dict[str, list[bool]]:
    view = problem.step_view(state, frames, torch.ones(len(frames)))
    return {name: flag.tolist() for name, flag in problem.ended(view, TAKES).items()}


@pytest.mark.parametrize(
    ("change", "fallen", "strayed"),
    [
        ((0.0, 0.0, 0.0), False, False),
        ((0.6, 0.6, -0.2), False, False),
        ((1.1, 0.0, 0.0), False, True),
        ((-0.8, -0.8, 0.0), False, True),
        ((0.0, 0.0, -0.3), True, False),
        ((0.0, 1.1, -0.3), True, True),
        ((0.0, 0.0, 2.0), False, False),
    ],
)
def test_each_fault_is_its_own_ending(change: tuple[float, float, float], fallen: bool, strayed: bool) -> None:
    problem = tracking_problem()
    assert ended(problem, moved_by(problem, change)) == {"fallen": [fallen] * 3, "strayed": [strayed] * 3}


def test_a_fall_is_told_from_the_frames_own_head() -> None:
    """A head at one height is a fall where the reference stands, and none where it crouches."""
    humanoid = stand_in()
    reference, _ = reference_motion(humanoid)
    reference["qpos"][20, 2] -= 0.5
    reference["xpos"][20, :, 2] -= 0.5
    problem = tracking_problem(humanoid=humanoid, reference=reference)
    state = problem.reference_at(FRAMES)
    state["xpos"][:, humanoid.head, 2] = reference["xpos"][20, humanoid.head, 2]
    assert ended(problem, state)["fallen"] == [True, False, True]


@pytest.mark.parametrize("enabled", [True, False])
def test_endings_end_an_episode_only_where_they_are_enabled(enabled: bool) -> None:
    env = environment(3, problem=tracking_problem(enabled=enabled))
    env.reset()
    qpos, qvel = env.body_state()["qpos"].clone(), env.body_state()["qvel"].clone()
    qpos[1, 0] += 1.3
    env.place(torch.arange(3), qpos, qvel)
    after = env.step(env.observe().set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert after["strayed"].flatten().tolist() == [False, True, False]
    assert not after["fallen"].any()
    assert after["terminated"].flatten().tolist() == [False, enabled, False]


def test_specs_hold() -> None:
    check_env_specs(environment(3, problem=tracking_problem(0.1)))


def test_a_path_is_laid_where_a_body_is_placed() -> None:
    """At a reset the root is on the path's row, whatever its error; afterwards it moves as the body does."""
    problem = tracking_problem(0.2)
    env = environment(4, problem=problem, seed=3)
    observation = env.reset()
    row = problem.path[env.frame].float()
    torch.testing.assert_close(observation["root_on_path"][:, :2], row[:, :2], atol=1e-5, rtol=0)
    start = root_on_floor(env.body_state()["qpos"])
    after = env.step(observation.set("action", torch.zeros(env.action_spec.shape)))["next"]
    moved = root_on_floor(env.body_state()["qpos"]) - start
    seen = after["root_on_path"] - observation["root_on_path"]
    torch.testing.assert_close(seen[:, :2].norm(dim=-1), moved[:, :2].norm(dim=-1).float(), atol=1e-5, rtol=0)
    torch.testing.assert_close(seen[:, 2], moved[:, 2].float(), atol=1e-5, rtol=0)


def test_only_worlds_that_begin_anew_lay_their_path() -> None:
    env = environment(4, problem=tracking_problem(0.2), seed=3)
    observation = env.reset()
    laid = env.laid.clone()
    for _ in range(3):
        observation = env.step(observation.set("action", torch.zeros(env.action_spec.shape)))["next"].exclude("reward")
    mask = torch.tensor([[True], [False], [True], [False]])
    env.reset(TensorDict({"_reset": mask}, batch_size=[4]))
    assert torch.equal(env.laid[1::2], laid[1::2])
    torch.testing.assert_close(
        env.observe()["root_on_path"][::2, :2], env.problem.path[env.frame][::2, :2].float(), atol=1e-5, rtol=0
    )


def test_dm_controls_world_sees_the_same() -> None:
    problem = tracking_problem(0.1)
    batch = environment(3, problem=problem, fragments=PIECES[:1], whole_fragments=True)
    one = load_environment(problem, WholeFragments(PIECES[:1], problem.takes.offsets, problem.takes.lengths))
    step, td, rng = one.reset(), batch.reset(), np.random.default_rng(0)
    for _ in range(12):
        np.testing.assert_allclose(step.observation["root_on_path"], td["root_on_path"][1], atol=1e-5)
        action = rng.normal(0, 0.1, batch.action_spec.shape[-1]).astype(np.float32)
        step = one.step(action)
        td = batch.step(td.set("action", torch.from_numpy(action).expand(3, -1)))["next"].exclude("reward")
    assert step.reward == pytest.approx(
        batch.problem.rewards(batch.problem.step_view(batch.body_state(), batch.frame, td["episode_step"].squeeze(-1)))[
            0
        ][1].item(),
        abs=1e-9,
    )


def test_resumed_equals_uninterrupted_to_the_bit() -> None:
    """The laid path is part of the state: without it a body would look for its path elsewhere."""

    def steps(env, observation, count: int, seed: int):
        generator = torch.Generator().manual_seed(seed)
        rows = []
        for _ in range(count):
            action = 0.2 * torch.randn(env.action_spec.shape, generator=generator)
            _, observation = env.step_and_maybe_reset(observation.set("action", action))
            rows.append(observation["root_on_path"])
        return observation, torch.stack(rows)

    whole = environment(4, problem=tracking_problem(0.1), seed=1)
    middle, _ = steps(whole, whole.reset(), 9, 1)
    saved = {key: value.clone() for key, value in whole.state_dict().items()}
    assert "laid" in saved
    _, expected = steps(whole, middle.clone(), 12, 2)
    other = environment(4, problem=tracking_problem(0.1), seed=77)
    other.reset()
    other.load_state_dict(saved)
    _, found = steps(other, other.observe(), 12, 2)
    assert torch.equal(found, expected)
