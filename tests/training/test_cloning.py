"""Lessons as a tracker sees them: mirrored, moved by the teacher's gains, with errors; a network learns them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import group
from helpers.humanoid_stand_in import reference_motion, stand_in
from torch import nn

from egopose.envs.imitation import ActionSettings
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.starts import Piece
from egopose.envs.tracking import TrackingEndings, TrackingProblem
from egopose.humanoid.state_layout import StateLayout
from egopose.models.mirror import joint_mirror, state_mirror
from egopose.tasks.target_variants import TargetError, Variants, target_variants
from egopose.training import cloning
from egopose.training.cloning import CloningSettings, LessonReader, clone
from egopose.training.teacher import Lessons

AHEAD = (1, 3)
FRAMES, COUNT = 65, 60
ERROR = TargetError(joints=0.1, tilt=0.03, heading=0.05, height=0.01, place=0.05, quick=0.07, slow=0.4)
SETTINGS = CloningSettings(
    seconds=100.0,
    batch=32,
    learning_rate=3e-3,
    weight_decay=0.0,
    truth=1.0,
    nearby=0.0,
    place=0.03,
    turn=0.04,
    joints=0.06,
    linear=0.2,
    angular=0.4,
    joint_rates=0.6,
    largest_change=0.5,
    largest_action=1.0,
)


@cache
def body() -> Any:
    return stand_in()


@cache
def variants(copies: int, mirror: bool) -> Variants:
    reference, takes = reference_motion(body())
    clips = [part.numpy() for part in reference["qpos"].split(takes.lengths.tolist())]
    pieces = [Piece(0, 0, 40), Piece(1, 0, 25)]
    return target_variants(body(), clips, pieces, (None, ERROR)[:copies], mirror, 0)


@cache
def problem(copies: int, mirror: bool) -> TrackingProblem:
    found = variants(copies, mirror)
    return TrackingProblem(
        body(),
        found.reference,
        found.takes,
        build_reward(group("reward", "tracking")),
        ActionSettings(**group("task", "tracking")["action"]),
        TrackingEndings(True, 0.25, 1.0),
        found.joint_targets,
        found.states,
        found.path,
    )


def lessons(frames: list[int], gain: float = 0.0, seed: int = 0) -> Lessons:
    """Bodies near the motion at these frames; each joint's control follows its own angle by ``gain``."""
    rng, model = np.random.default_rng(seed), body().mj_model
    reference, _ = reference_motion(body())
    qpos, qvel = (reference[key][frames].numpy().copy() for key in ("qpos", "qvel"))
    qpos[:, 7:] += 0.05 * rng.normal(size=(len(frames), model.nu))
    qpos[:, :2] += 0.05 * rng.normal(size=(len(frames), 2))
    qvel += 0.1 * rng.normal(size=qvel.shape)
    gains = np.zeros((len(frames), model.nu, 2 * model.nv), dtype=np.float16)
    gains[:, np.arange(model.nu), 6 + np.arange(model.nu)] = gain
    ctrl = qpos[:, 7:] + 0.1 * rng.normal(size=(len(frames), model.nu))
    parts = (part.astype(np.float32) for part in (qpos, qvel, ctrl))
    return Lessons(np.array(frames), *parts, gains)


def reader(given: Lessons | None, copies: int = 1, mirror: bool = False, seed: int = 0, **changed: Any) -> LessonReader:
    found = variants(copies, mirror)
    return LessonReader(
        given,
        problem(copies, mirror),
        found.states,
        found.path,
        found.takes.last(),
        AHEAD,
        copies,
        mirror,
        replace(SETTINGS, **changed),
        seed,
    )


def mirrored_window(window: np.ndarray) -> np.ndarray:
    """The window that a mirror shows: left is right, turns go the other way, joints are exchanged."""
    joints, signs = joint_mirror(body().skeleton)
    width = 6 + len(joints)
    out = window.copy()
    for start in range(0, width * len(AHEAD), width):
        out[:, start : start + 6] *= [1.0, 1.0, -1.0, -1.0, -1.0, 1.0]
        out[:, start + 6 : start + width] = signs * window[:, start + 6 : start + width][:, joints]
    rates = width * len(AHEAD)
    out[:, rates : rates + 6] *= [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
    out[:, rates + 6 :] = signs * window[:, rates + 6 :][:, joints]
    return out


# --- what a lesson is ------------------------------------------------------------------------------------------------


def test_a_lesson_as_it_is() -> None:
    """State of the body, window of the true motion, and the action that gives the teacher's control."""
    given = lessons([7])
    state, window, action = reader(given).draw(3)
    qpos, qvel = given.qpos.astype(np.float64), given.qvel.astype(np.float64)
    np.testing.assert_allclose(state, np.repeat(humanoid_state_rows(qpos, qvel), 3, axis=0), atol=1e-6)
    seen = reader(None).seen(np.array([7]), qpos, qvel)[1]
    np.testing.assert_allclose(window, np.repeat(seen, 3, axis=0), atol=1e-5)
    target = problem(1, False).target(torch.from_numpy(action), torch.tensor([8] * 3))
    np.testing.assert_allclose(target, np.repeat(given.ctrl, 3, axis=0), atol=1e-6)


def test_actions_are_bounded() -> None:
    given = lessons([7])
    given.ctrl[:] = 1.4
    _, _, action = reader(given, largest_action=0.3).draw(4)
    assert np.abs(action).max() == pytest.approx(0.3)


def test_at_a_takes_end_the_last_frame_is_the_next() -> None:
    assert reader(None, 2, True).next(np.array([38, 39, 64, 65 + 39])).tolist() == [39, 39, 64, 65 + 39]


# --- mirrored --------------------------------------------------------------------------------------------------------


def test_a_mirrored_lesson_is_the_lessons_mirror_image() -> None:
    """State, window and action: one lesson, drawn on both sides."""
    state, window, action = reader(lessons([12]), mirror=True).draw(COUNT)
    distinct = np.abs(state - state[0]).max(1) > 1e-9
    assert 0.2 < distinct.mean() < 0.8
    one, other = np.flatnonzero(~distinct)[0], np.flatnonzero(distinct)[0]
    image = state_mirror(body().skeleton).state(torch.from_numpy(state[[one]]))
    np.testing.assert_allclose(image, state[[other]], atol=1e-6)
    np.testing.assert_allclose(mirrored_window(window[[one]]), window[[other]], atol=1e-4)
    joints, signs = joint_mirror(body().skeleton)
    np.testing.assert_allclose(signs * action[one][joints], action[other], atol=1e-6)


def test_without_mirroring_there_is_one_side() -> None:
    state, _, _ = reader(lessons([12])).draw(COUNT)
    assert np.abs(state - state[0]).max() == 0.0


# --- moved -----------------------------------------------------------------------------------------------------------


def joint_angles(state: np.ndarray) -> np.ndarray:
    return state[:, StateLayout.of_size(state.shape[1]).joint_angles]


def test_a_moved_lessons_control_follows_the_gains() -> None:
    """Gains of -2 on each joint's own angle: the control changes by that much of what the state shows."""
    given = lessons([12], gain=-2.0)
    state, _, action = reader(given, nearby=1.0, largest_change=9.0, largest_action=9.0).draw(COUNT)
    move = joint_angles(state) - given.qpos[0, 7:]
    assert 0.01 < move.std() < 0.06
    base = problem(1, False).target(torch.zeros(COUNT, move.shape[1]), torch.full((COUNT,), 13)).numpy()
    np.testing.assert_allclose(action + base, given.ctrl[0] - 2.0 * move, atol=1e-3)


def test_a_moves_change_is_bounded() -> None:
    given = lessons([12], gain=-2.0)
    _, _, action = reader(given, nearby=1.0, joints=1.0, largest_change=0.1, largest_action=9.0).draw(COUNT)
    base = problem(1, False).target(torch.zeros(1, action.shape[1]), torch.tensor([13])).numpy()
    assert np.abs(action + base - given.ctrl[0]).max() == pytest.approx(0.1, abs=1e-6)


def test_the_share_of_moved_lessons_is_the_one_asked_for() -> None:
    given = lessons([12])
    state, _, _ = reader(given, nearby=0.7).draw(600)
    moved = np.abs(joint_angles(state) - given.qpos[0, 7:]).max(1) > 1e-6
    assert moved.mean() == pytest.approx(0.7, abs=0.07)


# --- with errors -----------------------------------------------------------------------------------------------------


def test_the_share_of_true_targets_is_the_one_asked_for() -> None:
    """Half of what is not forced to the truth is the truth too, of two copies. The body's state is the same in all."""
    given = lessons([12])
    state, window, _ = reader(given, 2, truth=0.4).draw(600)
    assert np.abs(state - state[0]).max() < 1e-9
    plain = reader(None, 2).seen(np.array([12]), given.qpos.astype(np.float64), given.qvel.astype(np.float64))[1]
    true = np.abs(window - plain).max(1) < 1e-4
    assert true.mean() == pytest.approx(0.4 + 0.6 * 0.5, abs=0.07)


def test_an_error_in_the_target_changes_the_action_but_not_the_control() -> None:
    given = lessons([12])
    rows = reader(given, 2, truth=0.0)
    _, window, action = rows.draw(COUNT)
    wrong = np.abs(window - window[0]).max(1) > 1e-4
    assert wrong.any()
    first, other = 0, np.flatnonzero(wrong)[0]
    tables = [
        problem(2, False).target(torch.zeros(1, action.shape[1]), torch.tensor([at])).numpy()[0]
        for at in (13, 13 + FRAMES)
    ]
    found = sorted(tuple(np.round(action[row], 4)) for row in (first, other))
    expected = sorted(tuple(np.round(given.ctrl[0] - table, 4)) for table in tables)
    np.testing.assert_allclose(found, expected, atol=2e-4)


# --- learning --------------------------------------------------------------------------------------------------------


class Two(nn.Module):
    """A linear map of state and window."""

    def __init__(self, sizes: tuple[int, int], actions: int) -> None:
        super().__init__()
        self.map = nn.Linear(sum(sizes), actions)
        nn.init.zeros_(self.map.weight)

    def forward(self, state: torch.Tensor, window: torch.Tensor) -> torch.Tensor:
        return self.map(torch.cat([state, window], dim=-1))


def learned(monkeypatch: pytest.MonkeyPatch, steps: int) -> tuple[float, list[tuple[int, float, float]]]:
    """Of a clock that ticks once a look: learning takes as many steps as seconds."""
    torch.manual_seed(0)
    clock = itertools.count()
    monkeypatch.setattr(cloning, "time", SimpleNamespace(monotonic=lambda: float(next(clock))))
    monkeypatch.setattr(cloning, "_WARM_UP", 10)
    monkeypatch.setattr(cloning, "_TOLD_EVERY", 50)
    given = reader(lessons(list(range(0, 60, 3)), gain=-1.0), 2, True, truth=0.5, nearby=0.5, seconds=float(steps))
    state, window, action = given.draw(2)
    told: list[tuple[int, float, float]] = []
    network = Two((state.shape[1], window.shape[1]), action.shape[1])
    settings = replace(SETTINGS, seconds=float(steps))
    return clone(network, lambda values: values, given, settings, lambda *row: told.append(row)), told


def test_the_error_of_a_small_network_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    error, told = learned(monkeypatch, 400)
    assert len(told) > 4
    assert told[-1][1] < 0.85 * told[0][1]
    assert error < 0.7 * told[0][1] ** 2


def test_a_short_learning_tells_its_error_too(monkeypatch: pytest.MonkeyPatch) -> None:
    error, told = learned(monkeypatch, 5)
    assert told == []
    assert 0.0 < error < 1.0
