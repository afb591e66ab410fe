"""The root's path from a head signal, and states that lead along a path."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.seen_ground import any_path
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.state_layout import StateLayout
from egopose.models.head_path import camera_height, path_of_signal, quiet, states_on_path
from egopose.models.pose_regression import integrated_path
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.vision.head_signal import HeadSignal, signal_of_motion

FPS, HEIGHT = 30.0, 1.6
LAYOUT = StateLayout(2)


def states_of(count: int, ahead: float = 0.0, seed: int | None = None) -> Array:
    """States of a body that goes ahead at that speed; with a seed it leans, turns and sways as well."""
    out = np.zeros((count, LAYOUT.size))
    out[:, LAYOUT.root_height], out[:, LAYOUT.root_rotation.start] = 0.95, 1.0
    out[:, LAYOUT.root_linear_velocity.start] = ahead
    if seed is not None:
        rng = np.random.default_rng(seed)
        noise = gaussian_filter1d(rng.normal(size=(count, 8)), 5.0, axis=0, mode="nearest")
        lean = np.column_stack([0.6 * noise[:, :2], np.zeros(count)])
        out[:, LAYOUT.root_rotation] = rot.from_rotvec(lean)
        out[:, LAYOUT.root_linear_velocity] += 0.5 * noise[:, 2:5]
        out[:, LAYOUT.root_angular_velocity] = 2.0 * noise[:, 5:8]
    return out


def signal_of(turning: Array, velocity: Array, quality: Array | None = None) -> HeadSignal:
    """A signal of turns about the vertical ``[T]`` and velocities ``[T, 2]``."""
    count = len(turning)
    turns, moves = np.zeros((count, 3)), np.zeros((count, 3))
    turns[:, 2], moves[:, :2] = turning, velocity
    good = np.ones((count, 3)) if quality is None else np.tile(quality[:, None], (1, 3))
    return HeadSignal(turns, moves, np.zeros((count, 2)), good)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_states_lead_along_the_path_of_a_signal(seed: int) -> None:
    signal = signal_of_motion(*any_path(seed, 120, FPS, 0.4), FPS)
    states = states_of(120, 1.0, seed)
    path = path_of_signal(signal, states, HEIGHT, FPS)
    np.testing.assert_allclose(path[0], 0.0, atol=1e-12)
    placed = states_on_path(states, path, FPS)
    led = integrated_path(placed, FPS)
    np.testing.assert_allclose(led[:, :2], path[:, :2], atol=1e-3)
    np.testing.assert_allclose(led[:, 2], path[:, 2], atol=np.deg2rad(0.1))
    velocity = LAYOUT.root_velocity
    np.testing.assert_array_equal(np.delete(placed, np.r_[velocity], 1), np.delete(states, np.r_[velocity], 1))


def test_the_path_is_where_the_camera_went() -> None:
    """States that know nothing of the way: it comes from the signal alone, to a tenth of its length."""
    positions, rotations = any_path(3, 240, FPS, 0.4)
    signal = signal_of_motion(positions, rotations, FPS)
    path = path_of_signal(signal, states_of(240), HEIGHT, FPS)
    length = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1).sum()
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum() == pytest.approx(length, rel=0.1)
    ends = np.linalg.norm(positions[-1, :2] - positions[0, :2])
    assert np.linalg.norm(path[-1, :2]) == pytest.approx(ends, rel=0.1)


def test_a_circle_closes() -> None:
    count, turn, speed = 361, 2 * np.pi / 12.0, 1.0
    signal = signal_of(np.full(count, turn), np.tile([speed / HEIGHT, 0.0], (count, 1)))
    states = states_of(count, speed)
    states[:, LAYOUT.root_angular_velocity.stop - 1] = turn
    path = path_of_signal(signal, states, HEIGHT, FPS)
    assert path[-1, 2] == pytest.approx(2 * np.pi, abs=1e-2)
    np.testing.assert_allclose(path[-1, :2], 0.0, atol=0.1)
    assert np.abs(path[:, :2]).max() == pytest.approx(2 * speed / turn, rel=0.05)


def test_one_who_stands_stays_though_the_signal_is_noisy() -> None:
    rng, count = np.random.default_rng(0), 30 * 60
    signal = signal_of(0.03 * rng.normal(size=count), 0.04 * rng.normal(size=(count, 2)))
    path = path_of_signal(signal, states_of(count), HEIGHT, FPS)
    speed = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) * FPS
    assert speed.mean() < 0.05
    assert np.linalg.norm(path[-1, :2]) < 0.3
    assert np.abs(np.rad2deg(path[:, 2])).max() < 5.0


def test_where_no_ground_is_seen_the_states_lead() -> None:
    count = 360
    quality, velocity = np.ones(count), np.tile([1.0 / HEIGHT, 0.0], (count, 1))
    quality[120:240], velocity[120:240] = 0.0, 0.0
    path = path_of_signal(signal_of(np.zeros(count), velocity, quality), states_of(count, 0.6), HEIGHT, FPS)
    speed = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) * FPS
    np.testing.assert_allclose(speed[30:60], 1.0, atol=0.02)
    np.testing.assert_allclose(speed[175:185], 0.6, atol=0.05)  # a second and a half from either end
    np.testing.assert_allclose(speed[-60:-30], 1.0, atol=0.02)


def test_a_glance_aside_does_not_turn_the_body() -> None:
    """The head turns by 40 degrees and back within 0.7 s; a body that turns and stays turned is followed."""
    times = np.arange(240) / FPS
    glance = np.deg2rad(40.0) * np.exp(-0.5 * ((times - 4.0) / 0.15) ** 2)
    turn = np.deg2rad(90.0) / (1 + np.exp(-(times - 4.0) / 0.3))
    states = states_of(240, 1.0)
    ahead = np.tile([1.0 / HEIGHT, 0.0], (240, 1))
    looked = path_of_signal(signal_of(np.gradient(glance) * FPS, ahead), states, HEIGHT, FPS)
    turned = path_of_signal(signal_of(np.gradient(turn) * FPS, ahead), states, HEIGHT, FPS)
    assert np.abs(looked[:, 2]).max() < np.deg2rad(12.0)
    assert np.rad2deg(turned[-1, 2]) == pytest.approx(90.0, abs=4.0)


def test_what_is_quiet_is_silent_and_what_is_loud_stays() -> None:
    np.testing.assert_array_equal(quiet(np.full(60, 0.02), (0.035, 0.09), FPS), 0.0)
    np.testing.assert_allclose(quiet(np.full(60, -0.5), (0.035, 0.09), FPS), -0.5)


def test_one_state_has_no_path_to_follow() -> None:
    one = states_of(1, 1.0)
    np.testing.assert_array_equal(states_on_path(one, np.zeros((1, 3)), FPS), one)


def test_how_high_cameras_are_worn() -> None:
    heights = {mount: camera_height(default_humanoid(), mount) for mount in ("head", "chest", "held")}
    assert heights["head"] == pytest.approx(1.75, abs=0.01)  # as conf/estimate.yaml says
    assert heights["chest"] == pytest.approx(1.41, abs=0.01)
    assert heights["chest"] < heights["held"] < heights["head"]
