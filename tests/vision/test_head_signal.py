"""The head signal of known motions against formulas, and that of flow against that of the motion."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.seen_ground import LEVEL, any_path, flow_of_path, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array
from egopose.vision.ground_motion import GroundMotion, pixel_rays
from egopose.vision.head_signal import (
    USUAL_PITCH,
    HeadSignal,
    down_from_turning,
    down_of,
    pitch_of_film,
    signal_of_flow,
    signal_of_motion,
    tilt_of,
    without_bias,
    zero_crossing,
)

FPS = 30.0
ROWS, COLUMNS, VIEW = 14, 24, 90.0


def test_a_camera_on_a_circle() -> None:
    """At radius r, turning left at w, looking along its way: it goes ahead at w r / h and yaws at w."""
    turn, radius, height, pitch = 0.5, 2.0, 1.6, np.deg2rad(25.0)
    angle = turn * np.arange(90) / FPS
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full_like(angle, height)])
    turned = Rotation.from_euler("ZY", np.column_stack([angle + np.pi / 2, np.full_like(angle, pitch)])).as_matrix()
    signal = signal_of_motion(positions, turned @ LEVEL, FPS)
    np.testing.assert_allclose(signal.turning[1:], [[0.0, 0.0, turn]] * 89, atol=1e-9)
    # A chord is shorter than its arc, and points half a frame's turn aside of where the camera looks by then.
    half = 0.5 * turn / FPS
    chord = 2 * radius * np.sin(half) * FPS / height
    np.testing.assert_allclose(
        signal.velocity[1:], [[chord * np.cos(half), -chord * np.sin(half), 0.0]] * 89, atol=1e-9
    )
    np.testing.assert_allclose(signal.tilt, [[pitch, 0.0]] * 90, atol=1e-9)
    np.testing.assert_array_equal(signal.quality[1:], 1.0)
    np.testing.assert_array_equal(signal.quality[0], 0.0)
    assert signal.numbers().shape == (90, 10)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_mirror_image(seed: int) -> None:
    positions, rotations = any_path(seed, 60, FPS, 0.4)
    own = signal_of_motion(positions, rotations, FPS)
    flip, camera = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, 1.0])
    other = signal_of_motion(positions @ flip, flip @ rotations @ camera, FPS)
    # Axes ahead, left, up: a turn's image is opposite to a vector's.
    np.testing.assert_allclose(other.turning, own.turning * [-1, 1, -1], atol=1e-9)
    np.testing.assert_allclose(other.velocity, own.velocity * [1, -1, 1], atol=1e-9)
    np.testing.assert_allclose(other.tilt, own.tilt * [1, -1], atol=1e-9)


@settings(deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_tilt_and_down_are_each_others_inverse(pitch: float, roll: float) -> None:
    down = down_of(pitch, roll)
    assert np.linalg.norm(down) == pytest.approx(1.0)
    np.testing.assert_allclose(tilt_of(down[None]), [[pitch, roll]], atol=1e-6)


@pytest.mark.parametrize(("pitch", "view"), [(10.0, 60.0), (27.0, 75.0), (38.0, 100.0)])
def test_the_pitch_of_a_walk_is_found_in_its_flow(pitch: float, view: float) -> None:
    positions, rotations = walk(2.0, FPS, 1.3, np.deg2rad(pitch), bob=0.02)
    rays, _ = pixel_rays(ROWS, COLUMNS, view)
    wall = np.random.default_rng(0).uniform(2.0, 10.0, rays.shape[1])
    found = np.rad2deg(pitch_of_film(flow_of_path(positions, rotations, rays, wall), rays, FPS))
    assert found == pytest.approx(pitch, abs=1.0)


def test_a_still_film_has_the_usual_pitch() -> None:
    rays, _ = pixel_rays(ROWS, COLUMNS, VIEW)
    noise = np.random.default_rng(0).normal(scale=2e-4, size=(30, 2, rays.shape[1]))
    assert pitch_of_film(noise, rays, FPS) == USUAL_PITCH
    assert pitch_of_film(np.zeros((1, 2, rays.shape[1])), rays, FPS) == USUAL_PITCH


def test_the_last_fall_through_zero() -> None:
    at = np.arange(5.0)
    assert zero_crossing(at, np.array([1.0, -1.0, 2.0, -2.0, -3.0])) == pytest.approx(2.5)
    assert zero_crossing(at, np.array([-1.0, 1.0, 2.0, 3.0, 4.0])) is None


def test_the_vertical_follows_a_nod_and_comes_back_to_the_mean() -> None:
    times = np.arange(120) / FPS
    nod = 0.05 * np.sin(2 * np.pi * 2.0 * times)
    turn = np.column_stack([np.gradient(nod), np.zeros_like(nod), np.zeros_like(nod)])
    # A turn about the camera's right lifts its gaze.
    pitch = tilt_of(down_from_turning(turn, 0.4, FPS))[:, 0]
    assert np.corrcoef(pitch, -nod)[0, 1] > 0.8
    steady = tilt_of(down_from_turning(turn + np.array([0.02, 0.0, 0.0]), 0.4, FPS))[:, 0]
    assert abs(steady[30:].mean() - 0.4) < 0.01


def seen_turning(turn: Array) -> GroundMotion:
    """What a picture tells of these turns, exactly."""
    count = len(turn)
    none, one = np.zeros((count, 3)), np.ones(count)
    return GroundMotion(turn, none, 0.01 * one, 0.01 * one, one, one, one)


@pytest.mark.parametrize("gravity", [True, False])
def test_a_gyroscopes_constant_error_is_taken_off(gravity: bool) -> None:
    _, rotations = any_path(4, 150, FPS, 0.4)
    true = np.zeros((150, 3))
    true[1:] = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).as_rotvec()
    bias = np.array([0.01, -0.02, 0.015]) / FPS
    kept = without_bias(true + bias, seen_turning(true), -rotations[:, 2] if gravity else None)
    np.testing.assert_allclose(kept[1:], true[1:], atol=0.002 / FPS)


def test_few_frames_tell_no_bias() -> None:
    turn = np.full((10, 3), 0.01)
    np.testing.assert_array_equal(without_bias(turn, seen_turning(0 * turn), None), turn)


def filmed(positions: Array, rotations: Array) -> Array:
    """Flow ``[T, 2, ROWS, COLUMNS]`` in picture widths."""
    rays, focal = pixel_rays(ROWS, COLUMNS, VIEW)
    wall = np.random.default_rng(1).uniform(3.0, 12.0, rays.shape[1])
    return flow_of_path(positions, rotations, rays, wall).reshape(len(positions), 2, ROWS, COLUMNS) * focal


def apart(one: HeadSignal, other: HeadSignal, name: str) -> float:
    return float(np.sqrt(((getattr(one, name) - getattr(other, name))[1:] ** 2).mean(0)).max())


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 10**6))
def test_flow_of_a_path_has_the_paths_signal(seed: int) -> None:
    """To a twentieth of a height a second: the fit is of the moment halfway between two frames."""
    positions, rotations = any_path(seed, 45, FPS, np.deg2rad(30.0))
    true, flow = signal_of_motion(positions, rotations, FPS), filmed(positions, rotations)
    intervals, down = np.full(len(flow), 1 / FPS), -rotations[:, 2]
    by_gravity = signal_of_flow(flow, VIEW, intervals, down)
    assert apart(by_gravity, true, "turning") < 0.02
    assert apart(by_gravity, true, "velocity") < 0.05
    np.testing.assert_allclose(by_gravity.tilt, true.tilt, atol=1e-9)
    turning = np.zeros((len(flow), 3))
    turning[1:] = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).as_rotvec() * FPS
    measured = signal_of_flow(flow, VIEW, intervals, down, turning)
    assert apart(measured, true, "turning") < 0.01
    assert apart(measured, true, "velocity") < 0.05
    assert measured.quality[1:, 0].min() > 0.99


def test_flow_without_an_instrument_still_tells_the_walk() -> None:
    positions, rotations = walk(2.0, FPS, 1.3, np.deg2rad(25.0), turn=0.3)
    true = signal_of_motion(positions, rotations, FPS)
    found = signal_of_flow(filmed(positions, rotations), VIEW, np.full(len(positions), 1 / FPS))
    assert found.velocity[1:, 0].mean() == pytest.approx(true.velocity[1:, 0].mean(), rel=0.05)
    assert found.turning[1:, 2].mean() == pytest.approx(0.3, abs=0.03)
    assert found.quality[1:].min() > 0.5


@pytest.mark.parametrize("said", [0.6 * VIEW, 1.5 * VIEW])
def test_another_lens_is_told_by_the_gyroscope(said: float) -> None:
    """The picture of a lens that is said wrong turns too fast or too slowly."""
    positions, rotations = any_path(3, 90, FPS, np.deg2rad(30.0))
    turning = np.zeros((90, 3))
    turning[1:] = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).as_rotvec() * FPS
    flow, intervals, down = filmed(positions, rotations), np.full(90, 1 / FPS), -rotations[:, 2]
    right, wrong = (signal_of_flow(flow, view, intervals, down, turning).quality[1:, 0] for view in (VIEW, said))
    assert wrong.mean() < 0.8 < 0.95 < right.mean()


def test_a_steadied_picture_leaves_the_turns_to_the_gyroscope() -> None:
    positions, rotations = walk(1.0, FPS, 1.3, np.deg2rad(25.0))
    shaken = 0.5 * np.random.default_rng(0).normal(size=(30, 3))
    found = signal_of_flow(
        filmed(positions, rotations), VIEW, np.full(30, 1 / FPS), -rotations[:, 2], shaken, None, steadied_picture=True
    )
    np.testing.assert_allclose(np.linalg.norm(found.turning, axis=1), np.linalg.norm(shaken, axis=1), rtol=1e-9)
    assert found.velocity[1:, 0].mean() == pytest.approx(1.3 / 1.6, rel=0.05)
