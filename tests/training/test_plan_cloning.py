"""A simulated motion as a teacher: its gains keep bodies near it, and a policy learns them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.clip_folder import clip_folder, scene_of_a_step, standing_plan

from egopose.core.config import compose_config, from_mapping
from egopose.humanoid.derivatives import Simulator
from egopose.humanoid.trajectory import TrackingCost
from egopose.tasks.reconstruction import TASK, ClipDataset
from egopose.training.plan_cloning import PlanCloningSettings, PlanSchool
from egopose.training.plan_feedback import FeedbackSettings, PlanTeacher

FRAMES = 14


@pytest.fixture(scope="module")
def school(tmp_path_factory: pytest.TempPathFactory) -> tuple[PlanSchool, PlanTeacher, PlanCloningSettings]:
    folder = clip_folder(tmp_path_factory.mktemp("clip"), scene_of_a_step())
    standing_plan(folder, FRAMES).save(folder / "plan.npz")
    words = [f"task.clip={folder}", f"task.start_from={folder / 'plan.npz'}", "task.targets=plan"]
    config = compose_config("train", ["experiment=reconstruction", *words])
    dataset: ClipDataset = TASK.dataset(config, None)  # type: ignore[arg-type]
    values = dict(config["task"]["cloning"])
    feedback = dict(values.pop("feedback"))
    cost = from_mapping(TrackingCost, feedback["cost"], "test")
    settings = from_mapping(FeedbackSettings, {**feedback, "cost": cost}, "test")
    assert dataset.plan is not None
    teacher = PlanTeacher(Simulator(dataset.humanoid, 64, 1), dataset.humanoid, dataset.plan, settings)
    cloning = from_mapping(PlanCloningSettings, values, "test")
    return PlanSchool(TASK.problem(config, dataset, None), teacher), teacher, cloning


def test_on_the_motion_the_teacher_takes_its_own_controls(school: tuple) -> None:
    _, teacher, _ = school
    plan, frames = teacher.plan, np.arange(FRAMES - 1)
    np.testing.assert_allclose(teacher.control(frames, plan.qpos[:-1], plan.qvel[:-1]), plan.ctrl, atol=1e-9)


def test_feedback_keeps_bodies_nearer_than_the_controls_alone(school: tuple) -> None:
    _, teacher, _ = school
    plan, rng = teacher.plan, np.random.default_rng(0)
    frame = np.zeros(16, dtype=np.int64)
    qpos, qvel = teacher._near(frame, rng)
    # The same pushes for both.
    away = []
    for led in (teacher.control, lambda f, q, w: plan.ctrl[f]):
        q, w, f = qpos, qvel, frame
        for _ in range(FRAMES - 1):
            q, w = teacher._simulator.step(q, w, np.ascontiguousarray(led(f, q, w)))
            f = f + 1
        away.append(np.linalg.norm(q[:, :3] - plan.qpos[-1, :3], axis=1).mean())
    assert away[0] < 0.8 * away[1]


def test_replays_meet_states_of_every_frame_but_the_last(school: tuple) -> None:
    _, teacher, _ = school
    frame, qpos, qvel = teacher.replays(48, np.random.default_rng(1))
    assert set(frame.tolist()) == set(range(FRAMES - 1))
    assert len(frame) == len(qpos) == len(qvel)
    again = teacher.replays(48, np.random.default_rng(1))
    assert np.array_equal(again[1], qpos)


def test_lessons_are_actions_that_give_the_teachers_control(school: tuple) -> None:
    lessons_of, teacher, cloning = school
    frame, qpos, qvel = (part[:20] for part in teacher.replays(8, np.random.default_rng(2)))
    from dataclasses import replace

    lessons = lessons_of.lessons(frame, qpos, qvel, replace(cloning, nearby=0), np.random.default_rng(0))
    low, high = lessons_of._problem.humanoid.joint_range.T
    wanted = np.clip(teacher.control(frame, qpos, qvel), low, high)
    np.testing.assert_allclose(lessons_of.target(lessons.action, frame), wanted, atol=1e-6)
    assert lessons.scene.shape == (20, 2)
    assert (lessons.scene - lessons.scene[0]).abs().max() == 0
    more = lessons_of.lessons(frame, qpos, qvel, cloning, np.random.default_rng(0))
    assert more.scene[20:].abs().max() > 0.5, "boxes that vary are seen elsewhere"
    assert more.scene.abs().max() <= 1.0
    assert len(more.state) == 20 * (1 + cloning.nearby)
    torch.testing.assert_close(more.state[:20], lessons.state)
