"""The reconstruction's environment: what is seen, what ends an episode, which boxes are drawn, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.clip_folder import clip_folder, scene_of_a_step
from tensordict import TensorDict

from egopose.core.config import compose_config
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.rotations import yaw
from egopose.envs.problem import Scene
from egopose.envs.reconstruction import ENDINGS, ReconstructionProblem
from egopose.envs.starts import UniformStarts
from egopose.tasks.reconstruction import TASK, ClipDataset

WORDS = ["experiment=reconstruction", "reward=reconstruction"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clip_folder(tmp_path_factory.mktemp("clip") / "step", scene_of_a_step())


def dataset_of(folder: Path, *words: str) -> tuple[dict[str, Any], ClipDataset]:
    config = compose_config("train", [*WORDS, f"task.clip={folder}", *words])
    return config, TASK.dataset(config, None)  # type: ignore[arg-type]


def environment(folder: Path, *words: str, num_envs: int = 4) -> EgoPoseEnv:
    config, dataset = dataset_of(folder, *words)
    problem = TASK.problem(config, dataset, None)
    takes = problem.takes
    return EgoPoseEnv(problem, num_envs, UniformStarts(dataset.train, takes.offsets, takes.lengths, 24, 8), seed=3)


def problem_of(env: EgoPoseEnv) -> ReconstructionProblem:
    problem = env.problem
    assert isinstance(problem, ReconstructionProblem)
    return problem


def act(env: EgoPoseEnv, size: float = 0.0, seed: int = 0) -> TensorDict:
    action = size * torch.randn(env.action_spec.shape, generator=torch.Generator().manual_seed(seed))
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def test_drawn_boxes_are_within_their_ranges_and_seen(folder: Path) -> None:
    env = environment(folder, num_envs=64)
    seen = env.reset()
    ranges, tops = problem_of(env).ranges, torch.from_numpy(env.physics.box_tops.copy())
    change = ranges.change(tops, yaw(torch.from_numpy(env.physics.box_quaternions.copy())))
    assert ((change >= ranges.low - 1e-9) & (change <= ranges.high + 1e-9)).all()
    assert change[:, 0, 2].max() - change[:, 0, 2].min() > 0.25
    torch.testing.assert_close(seen["scene_parameters"], ranges.parameters(change).float(), rtol=1e-5, atol=1e-6)
    assert seen["scene_parameters"].shape == (64, 2)
    torch.testing.assert_close(act(env)["scene_parameters"], seen["scene_parameters"])
    env.close()


def test_boxes_stand_still_where_the_setting_says_so(folder: Path) -> None:
    env = environment(folder, "task.scene.vary=false")
    env.reset()
    np.testing.assert_allclose(env.physics.box_tops, np.tile([[[0.8, 0.0, 0.2]]], (4, 1, 1)), atol=1e-12)
    env.close()


def test_a_body_that_a_box_carries_begins_where_the_box_is(folder: Path) -> None:
    env = environment(folder)
    problem = problem_of(env)
    frame = torch.tensor([0, 23])  # on the floor, on the step
    top = torch.tensor([[[0.9, 0.1, 0.35]]] * 2, dtype=torch.float64)
    moved, _ = problem.first_state(frame, Scene(top, torch.zeros(2, 1).double(), torch.ones(2, 1, dtype=torch.bool)))
    plain, _ = problem.first_state(frame)
    torch.testing.assert_close(moved[0], plain[0])
    torch.testing.assert_close(moved[1, :3] - plain[1, :3], torch.tensor([0.1, 0.1, 0.15], dtype=torch.float64))
    torch.testing.assert_close(moved[1, 7:], plain[1, 7:])
    env.close()


def test_a_body_does_not_begin_in_a_box(folder: Path) -> None:
    """On its way to a step that is raised by 0.2 m under its foot."""
    env = environment(folder)
    problem = problem_of(env)
    place = problem.start.qpos[6, :2]
    boxes = len(problem.ranges.headings)
    top = torch.cat([place, torch.tensor([0.12], dtype=torch.float64)]).expand(1, boxes, 3)
    scene = Scene(top, torch.zeros(1, boxes).double(), torch.ones(1, boxes, dtype=torch.bool))
    moved, _ = problem.first_state(torch.tensor([6]), scene)
    plain, _ = problem.first_state(torch.tensor([6]))
    assert 0.05 < float(moved[0, 2] - plain[0, 2]) < 0.15
    torch.testing.assert_close(moved[0, :2], plain[0, :2])
    env.close()


def test_nothing_of_the_clips_root_reaches_policy_or_reward(folder: Path, tmp_path: Path) -> None:
    """The same poses elsewhere, turned about the vertical: the same state sees and earns the same."""
    from egopose.motion import rotations as rot
    from egopose.motion.io.native import read_native, write_native

    clip_folder(tmp_path / "other", scene_of_a_step())
    body = read_native(tmp_path / "other" / "body.npz")
    qpos = body.qpos.copy()
    turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.7))
    qpos[:, :3] = rot.rotate(turn, qpos[:, :3]) + np.array([2.0, -1.0, 0.4])
    qpos[:, 3:7] = rot.multiply(turn, qpos[:, 3:7])
    write_native(replace(body, qpos=qpos), tmp_path / "other" / "body.npz")
    here, there = environment(folder, "task.scene.vary=false"), environment(tmp_path / "other", "task.scene.vary=false")
    here.reset()
    there.reset()
    everyone = torch.arange(4)
    state = problem_of(here).first_state(here.frame)
    there.place(everyone, *state)
    here.place(everyone, *state)
    for name, value in here.observe().items():
        if name in ("humanoid_state", "scene_parameters"):
            torch.testing.assert_close(value, there.observe()[name])
    one, other = act(here, 0.3), act(there, 0.3)
    for name in problem_of(here).reward.names:
        torch.testing.assert_close(one["reward_terms", name], other["reward_terms", name], rtol=1e-5, atol=1e-6)
    for env in (here, there):
        env.close()


def test_the_observation_does_not_change_where_body_and_boxes_move_together(folder: Path) -> None:
    env = environment(folder, "task.scene.vary=false", "task.scene.seen=false")
    problem = problem_of(env)
    assert problem.observation_sizes["humanoid_state"] == 1 + 15 * 21 - 9
    env.reset()
    before = env.observe()["humanoid_state"]
    qpos = torch.from_numpy(env.physics.qpos.copy())
    qpos[:, :3] += torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    env.place(torch.arange(4), qpos, torch.from_numpy(env.physics.qvel.copy()))
    torch.testing.assert_close(env.observe()["humanoid_state"], before, rtol=1e-4, atol=1e-5)
    phase = env.frame.double() / 23
    torch.testing.assert_close(before[:, 0], phase.float())
    env.close()


def test_each_ending_has_its_cause(folder: Path) -> None:
    env = environment(folder, "task.scene.vary=false", num_envs=2)
    env.reset()
    frames = env.frame
    qpos, qvel = problem_of(env).first_state(frames)
    assert not any(bool(act(env)[name].any()) for name in ENDINGS), "the clip's own states end nothing at once"
    env.reset()
    lying = qpos.clone()
    lying[:, 2] = 0.3
    lying[:, 3:7] = torch.tensor([0.7071, 0.0, 0.7071, 0.0], dtype=torch.float64)  # on its face
    env.place(torch.arange(2), lying, 0 * qvel)
    after = act(env)
    assert bool(after["centre_of_mass_low"].all())
    assert bool(after["up_hint_off"].all())
    assert bool(after["terminated"].all())
    env.close()


def test_what_goes_on_too_long_ends_an_episode_and_a_break_starts_the_count_anew(folder: Path) -> None:
    words = ["task.termination.centre_of_mass_low=null", "task.termination.up_hint_off=null"]
    env = environment(folder, "task.scene.vary=false", *words, "task.termination.contact_mismatch=0.1", num_envs=1)
    problem = problem_of(env)
    assert problem.ends_episode == {"contact_mismatch", "forbidden_contact"}
    wrong, right = torch.ones(1, 4, dtype=torch.bool), torch.zeros(1, 4, dtype=torch.bool)
    memory = torch.zeros(1, 5, dtype=torch.float64)
    flags = []
    for now in (wrong, wrong, wrong, right, wrong, wrong, wrong, wrong):
        view = told(problem, now)
        memory = problem.remembered(view, memory)
        flags.append(bool(problem.ended(replace(view, memory=memory), torch.tensor([0]))["contact_mismatch"]))
    # 0.1 s are three frames: the fourth in a row is too long.
    assert flags == [False] * 7 + [True]
    env.close()


def told(problem: ReconstructionProblem, wrong: torch.Tensor) -> Any:
    """A view of the clip's first frame in which these end effectors' contacts are not as they should be."""
    from egopose.envs.mdp.step_view import Contacts

    state = {name: value[:1] for name, value in problem.reference_at(torch.tensor([0])).items()}
    floor = torch.zeros(1, 21, dtype=torch.bool)
    floor[:, problem.touching.bodies] = problem.hints.touches[:1].any(-1) ^ wrong
    contacts = Contacts(floor, torch.zeros(1, 21, 1, dtype=torch.bool))
    return problem.step_view(state, torch.tensor([0]), torch.tensor([1]), contacts=contacts)


def test_anything_but_feet_and_hands_is_forbidden_to_touch(folder: Path) -> None:
    env = environment(folder, "task.scene.vary=false", "task.termination.forbidden_contact=0.05", num_envs=1)
    problem = problem_of(env)
    view = told(problem, torch.zeros(1, 4, dtype=torch.bool))
    memory = problem.remembered(view, torch.zeros(1, 5, dtype=torch.float64))
    assert memory.tolist() == [[0.0] * 5]
    assert view.contacts is not None
    view.contacts.boxes[0, problem.humanoid.skeleton.index("RightLeg"), 0] = True
    for expected in (1.0, 2.0):
        memory = problem.remembered(view, memory)
        assert memory.tolist() == [[0.0, 0.0, 0.0, 0.0, expected]]
    assert bool(problem.ended(replace(view, memory=memory), torch.tensor([0]))["forbidden_contact"])
    env.close()


def test_an_environment_goes_on_to_the_bit(folder: Path) -> None:
    """What it remembers of an episode is part of its state."""
    first, second = environment(folder), environment(folder)
    first.reset()
    for step in range(3):
        act(first, 0.5, step)
    assert float(first.memory.max()) > 0
    second.reset()
    second.load_state_dict(first.state_dict())
    assert torch.equal(first.memory, second.memory)
    for step in range(4):
        one, other = act(first, 0.5, step), act(second, 0.5, step)
        for name in ("humanoid_state", "scene_parameters", "reward", *ENDINGS):
            assert torch.equal(one[name], other[name]), name
    for env in (first, second):
        env.close()


def test_a_scene_without_boxes(tmp_path: Path) -> None:
    env = environment(clip_folder(tmp_path / "bare"))
    seen = env.reset()
    assert seen["scene_parameters"].shape == (4, 0)
    after = act(env)
    assert bool(torch.isfinite(after["reward"]).all())
    assert float(after["reward_terms", "target_zone"].abs().max()) == 0.0
    env.close()
