"""The teacher: what it covers, its lessons, what becomes of bodies that are lost, and who leads them astray."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.humanoid_stand_in import reference_motion, stand_in
from hypothesis import given
from hypothesis import strategies as st

from egopose.envs.starts import Piece
from egopose.humanoid.derivatives import Simulator
from egopose.humanoid.inverse_dynamics import ForceSettings
from egopose.humanoid.trajectory import TrackingCost
from egopose.training.teacher import (
    Lessons,
    TeacherSettings,
    TeachersMotion,
    chunks,
    head_heights,
    teach,
    teachers_motion,
)

LENGTHS = (40, 25)
COST = TrackingCost(20.0, 60.0, 60.0, 1.0, 0.5, 2.0, 0.01, 3.0, 3.0)
SETTINGS = TeacherSettings(
    num_envs=3,
    horizon=4,
    every=3,
    velocity=1.0,
    reach=0.6,
    chunk=10,
    noise=0.05,
    astray=0.7,
    start_joints=0.0,
    start_rates=0.0,
    lost=0.25,
    cost=COST,
    forces=ForceSettings(8.0, 0.05, 0.3, 0.05),
)


# --- pieces of motion ------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(2, 200)), min_size=1, max_size=3), st.integers(1, 90))
def test_every_step_of_a_motion_is_in_one_piece(spans: list[tuple[int, int]], length: int) -> None:
    """A piece of frames a..b-1 gives the lessons of the steps from a to b - 1."""
    pieces = [Piece(take, start, start + span) for take, (start, span) in enumerate(spans)]
    offsets = [1000 * take for take in range(len(spans))]
    steps: list[int] = []
    for first, stop, end in chunks(pieces, offsets, length):
        assert first + 1 < stop <= end
        assert stop - first <= max(3, 2 * length + 1)
        steps += range(first, stop - 1)
    expected = [
        offset + frame for offset, p in zip(offsets, pieces, strict=True) for frame in range(p.start, p.stop - 1)
    ]
    assert sorted(steps) == expected


def test_a_piece_of_one_frame_teaches_nothing() -> None:
    assert chunks([Piece(0, 3, 4)], [0], 60) == []


# --- lessons ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Any:
    body: Any = stand_in()
    reference, _ = reference_motion(body, LENGTHS)
    clips = [part.numpy() for part in reference["qpos"].split(LENGTHS)]
    simulator = Simulator(body, 64, 1)
    yield body, teachers_motion(body, clips, SETTINGS.forces), simulator
    simulator.close()


def taught(scene: Any, pieces: list[tuple[int, int, int]], student: Any = None, **changed: Any) -> tuple[Lessons, int]:
    body, motion, simulator = scene
    settings = replace(SETTINGS, **changed)
    return teach(body, motion, pieces, settings, simulator, np.random.default_rng(0), student)


PIECES = [(0, 9, 40), (12, 17, 40), (30, 40, 40), (45, 52, 65)]


def test_lessons_are_of_the_frames_of_their_pieces(scene: Any) -> None:
    """Each step once, but the last frame, which leads nowhere; more pieces than bodies."""
    lessons, lost = taught(scene, PIECES)
    assert lost == 0
    expected = sorted(frame for first, stop, _ in PIECES for frame in range(first, stop - 1))
    assert sorted(lessons.frame.tolist()) == expected
    body, motion, _ = scene
    nv, nu = body.mj_model.nv, body.mj_model.nu
    assert lessons.gains.shape == (len(expected), nu, 2 * nv)
    assert (lessons.qpos.dtype, lessons.gains.dtype) == (np.float32, np.float16)
    away = np.abs(lessons.qpos[:, :3] - motion.qpos[lessons.frame][:, :3]).max(1)
    assert away.max() < 0.1, "bodies are where the frames of their lessons are"


def test_a_piece_begins_at_its_first_frame_with_the_asked_noise(scene: Any) -> None:
    lessons, _ = taught(scene, [PIECES[2]], start_joints=0.2)
    motion = scene[1]
    first = np.flatnonzero(lessons.frame == 30)
    np.testing.assert_allclose(lessons.qpos[first, :7], motion.qpos[[30], :7], atol=1e-6)
    away = lessons.qpos[first, 7:] - motion.qpos[30, 7:]
    assert 0.1 < away.std() < 0.35
    np.testing.assert_allclose(lessons.qvel[first], motion.qvel[[30]], atol=1e-5)


def test_controls_stay_within_reach_of_the_feed_forward(scene: Any) -> None:
    body, motion, _ = scene
    lessons, _ = taught(scene, PIECES, start_joints=0.4, reach=0.05)
    rows = lessons.frame
    after = rows + 1
    mean = 0.5 * (motion.torques[after] + motion.torques[rows])
    ahead = motion.qpos[after, 7:] + body.kd / body.kp * motion.qvel[after, 6:] + mean / body.kp
    assert np.abs(lessons.ctrl - ahead).max() < 0.05 + 1e-5
    assert np.abs(lessons.ctrl - ahead).max() > 0.04


def test_without_noise_the_bodies_obey_the_teacher(scene: Any) -> None:
    """The next lesson's state is where the lesson's control leads."""
    lessons, _ = taught(scene, [PIECES[0]], astray=0.0)
    order = np.argsort(lessons.frame)
    qpos, qvel, ctrl = (part[order].astype(np.float64) for part in (lessons.qpos, lessons.qvel, lessons.ctrl))
    after, _ = scene[2].step(qpos[:-1], qvel[:-1], ctrl[:-1])
    np.testing.assert_allclose(after, qpos[1:], atol=1e-4)


# --- astray ----------------------------------------------------------------------------------------------------------


def test_a_student_is_obeyed_while_the_teacher_keeps_teaching(scene: Any) -> None:
    """A student that throws the body's arms up: it is asked for the frames and states it meets, and is followed."""
    met: list[np.ndarray] = []

    def student(frame: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        met.append(frame.copy())
        return np.full((3, scene[0].mj_model.nu), 0.8)

    plain, _ = taught(scene, [PIECES[0]], astray=0.0)
    led, _ = taught(scene, [PIECES[0]], student=student, astray=1.0, lost=9.0)
    assert [int(frames[0]) for frames in met[:6]] == [0, 1, 2, 3, 4, 5]
    last = [lessons.qpos[lessons.frame == 7][0, 7:] for lessons in (plain, led)]
    assert last[1].mean() > last[0].mean() + 0.2
    taught_controls = led.ctrl[led.frame == 7][0]
    assert np.abs(taught_controls - 0.8).mean() > 0.2, "the lesson is the teacher's control, not the student's"


def test_with_noise_bodies_go_where_the_teacher_would_not(scene: Any) -> None:
    plain, _ = taught(scene, [PIECES[0]], astray=0.0)
    noisy, _ = taught(scene, [PIECES[0]], astray=1.0, noise=0.3)
    away = np.abs(plain.qpos[np.argsort(plain.frame)] - noisy.qpos[np.argsort(noisy.frame)])
    assert away[0].max() == 0.0
    assert away[3:].max() > 0.02


# --- lost ------------------------------------------------------------------------------------------------------------


def test_lost_bodies_are_counted_and_take_the_next_piece(scene: Any) -> None:
    """Heads that the motion has a metre higher: all bodies are lost at their first plan, and every piece is begun."""
    body, motion, simulator = scene
    high = TeachersMotion(motion.qpos, motion.qvel, motion.torques, motion.heads + 1.0)
    lessons, lost = taught((body, high, simulator), PIECES)
    assert lost == len(PIECES)
    begun = [first + step for first, _, _ in PIECES for step in range(SETTINGS.every)]
    assert sorted(lessons.frame.tolist()) == sorted(begun)


def test_a_body_that_broke_is_lost_and_the_others_go_on(scene: Any) -> None:
    """A student that returns what is no number for one body: physics puts it aside, the others' lessons stay whole."""

    def student(frame: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        ctrl = qpos[:, 7:].copy()
        ctrl[frame >= 45] = np.nan
        return ctrl

    lessons, _ = taught(scene, [PIECES[0], PIECES[3]], student=student, astray=1.0, lost=9.0)
    for part in (lessons.qpos, lessons.qvel, lessons.ctrl, lessons.gains):
        assert np.isfinite(part).all()
    assert set(range(8)) <= set(lessons.frame.tolist())


# --- the motion ------------------------------------------------------------------------------------------------------


def test_the_motion_has_velocities_torques_and_heads(scene: Any) -> None:
    body, motion, _ = scene
    reference, _ = reference_motion(body, LENGTHS)
    np.testing.assert_allclose(motion.qvel, reference["qvel"], atol=1e-9)
    np.testing.assert_allclose(motion.heads, reference["xpos"][:, body.head, 2], atol=1e-9)
    np.testing.assert_allclose(head_heights(body, motion.qpos[:3]), motion.heads[:3])
    assert motion.torques.shape == (65, body.mj_model.nu)
    assert np.abs(motion.torques).max() > 1.0


def test_a_clip_of_two_frames_has_no_torques(scene: Any) -> None:
    body, motion, _ = scene
    short = teachers_motion(body, [motion.qpos[:2]], SETTINGS.forces)
    assert (short.torques == 0.0).all()


def test_lessons_are_joined_in_order(scene: Any) -> None:
    lessons, _ = taught(scene, PIECES[1:2])
    both = Lessons.joined([lessons, lessons])
    assert len(both) == 2 * len(lessons) == 8
    np.testing.assert_array_equal(both.gains[4:], lessons.gains)
