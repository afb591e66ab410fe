"""Turning and the vertical at the frames, against motion that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.motion.rotations import (
    Array,
    conjugate,
    from_axis_angle,
    from_rotvec,
    multiply,
    normalize,
    rotate,
    to_rotvec,
)
from egopose.vision.telemetry import Samples, Telemetry, Trajectory, angular_velocity_at, down_at, gyroscope_bias

RATE = 200.0
X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
#: A level camera that looks along the world's y: right is x, ahead y, down minus z.
LEVEL = from_rotvec(np.array([-np.pi / 2, 0.0, 0.0]))


def moved(orientation: Array, acceleration: Array, times: Array, bias: Array, noise: float) -> Telemetry:
    """What sensors with an error measure on a camera's way; orientation is from camera axes to a world with z up."""
    rng = np.random.default_rng(0)
    step = to_rotvec(multiply(conjugate(orientation[:-1]), orientation[1:])) / np.diff(times)[:, None]
    rates = np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
    push = rotate(conjugate(orientation), acceleration + np.array([0.0, 0.0, 9.81]))
    return Telemetry(
        gyroscope=Samples(times, rates + bias + noise * rng.normal(size=rates.shape)),
        accelerometer=Samples(times, push + 10 * noise * rng.normal(size=push.shape)),
    )


def walk(seconds: float) -> tuple[Array, Array, Array]:
    """A walker's head: steps at 1.9 Hz, a nod and a sway with them, starts, and turns of the body."""
    t = np.arange(0, seconds, 1 / RATE)
    steps = 2 * np.pi * 1.9 * t
    heading = 0.8 * np.sin(2 * np.pi * t / 11.0) + 0.1 * np.sin(steps / 2)
    nod = 0.35 + 0.08 * np.sin(steps) + 0.15 * np.sin(2 * np.pi * t / 7.0)
    sway = 0.06 * np.sin(steps / 2 + 1.0)
    camera = multiply(from_axis_angle(np.array([0.0, 0.0, 1.0]), heading), np.broadcast_to(LEVEL, (len(t), 4)))
    camera = multiply(multiply(camera, from_axis_angle(X, -nod)), from_axis_angle(np.array([0.0, 0.0, 1.0]), sway))
    speed = 1.3 * (1 - np.cos(2 * np.pi * np.minimum(t, 1.5) / 3.0)) / 2
    ahead = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(t)], axis=1)
    acceleration = np.gradient(ahead * speed[:, None], t, axis=0)
    acceleration[:, 2] += 4.0 * np.sin(steps) + 1.5 * np.sin(2 * steps)
    acceleration[:, :2] += (1.5 * np.cos(steps / 2))[:, None] * np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    return t, camera, acceleration


def degrees_between(a: Array, b: Array) -> Array:
    return np.rad2deg(np.arccos(np.clip((a * b).sum(axis=1) / np.linalg.norm(a, axis=1), -1, 1)))


def test_down_of_a_walking_camera() -> None:
    times, camera, acceleration = walk(40.0)
    telemetry = moved(camera, acceleration, times, np.array([0.004, -0.006, 0.003]), 0.005)
    frames = np.arange(0, 39.9, 1 / 30)
    true = rotate(conjugate(camera), np.array([0.0, 0.0, -1.0]))
    true = np.stack([np.interp(frames, times, column) for column in true.T], axis=1)
    error = degrees_between(down_at(telemetry, frames), true)
    inside = (frames > 4) & (frames < 36)
    assert error[inside].mean() < 0.7
    assert error[inside].max() < 2.0
    assert error.max() < 4.0  # the start is a real push, and averages there see one side only
    # The accelerometer alone is off by ten times as much.
    samples = telemetry.accelerometer
    assert samples is not None
    raw = -np.stack([np.interp(frames, times, column) for column in samples.values.T], axis=1)
    assert degrees_between(raw, true)[inside].mean() > 7 * error[inside].mean()


def test_a_level_camera_at_rest() -> None:
    times = np.arange(0, 4, 1 / RATE)
    telemetry = moved(np.broadcast_to(LEVEL, (len(times), 4)), np.zeros((len(times), 3)), times, np.zeros(3), 1e-4)
    assert telemetry.accelerometer is not None
    np.testing.assert_allclose(telemetry.accelerometer.values.mean(axis=0), [0, -9.81, 0], atol=1e-3)
    np.testing.assert_allclose(down_at(telemetry, times[::50]), np.tile(Y, (16, 1)), atol=1e-3)


@settings(max_examples=30, deadline=None)
@given(
    rate=st.lists(st.floats(-4, 4), min_size=3, max_size=3),
    interval=st.sampled_from([1 / 24, 1 / 30, 1 / 60]),
    readout=st.floats(0.0, 0.03),
)
def test_a_steady_turn(rate: list[float], interval: float, readout: float) -> None:
    times = np.arange(-0.1, 1.2, 1 / RATE)
    telemetry = Telemetry(gyroscope=Samples(times, np.tile(rate, (len(times), 1))), readout=readout)
    frames = np.arange(0.1, 1.0, interval)
    np.testing.assert_allclose(
        angular_velocity_at(telemetry, frames, interval), np.tile(rate, (len(frames), 1)), atol=1e-9
    )


def test_the_gyroscope_is_integrated_over_the_frame() -> None:
    """A shake at 27 Hz, seen 30 times a second: samples at the frames would make it a slow turn."""
    times = np.arange(0, 3, 1 / 1000)
    angle = lambda t: 0.02 * np.sin(2 * np.pi * 27 * t)  # noqa: E731
    speed = 0.02 * 2 * np.pi * 27 * np.cos(2 * np.pi * 27 * times)
    telemetry = Telemetry(gyroscope=Samples(times, speed[:, None] * X), readout=0.016)
    frames = np.arange(0.1, 2.9, 1 / 30)
    true = (angle(frames + 0.008) - angle(frames + 0.008 - 1 / 30)) * 30
    found = angular_velocity_at(telemetry, frames, 1 / 30)[:, 0]
    np.testing.assert_allclose(found, true, atol=0.01)
    assert np.abs(np.interp(frames, times, speed) - true).max() > 1.0


def test_turns_about_changing_axes_are_composed() -> None:
    times, camera, acceleration = walk(5.0)
    telemetry = moved(camera, acceleration, times, np.zeros(3), 0.0)
    frames = times[20:-20:10]
    true = to_rotvec(multiply(conjugate(camera[10:-30:10]), camera[20:-20:10])) * RATE / 10
    np.testing.assert_allclose(angular_velocity_at(telemetry, frames, 10 / RATE), true, atol=0.01)


def test_orientations_serve_where_there_is_no_gyroscope() -> None:
    times, camera, _ = walk(3.0)
    frames = times[20::10]
    true = to_rotvec(multiply(conjugate(camera[10:-10:10]), camera[20::10])) * RATE / 10
    placed = Telemetry(trajectory=Trajectory(times, None, camera))
    np.testing.assert_allclose(angular_velocity_at(placed, frames, 10 / RATE), true, atol=1e-6)
    np.testing.assert_allclose(
        down_at(placed, frames), rotate(conjugate(camera[20::10]), np.array([0, 0, -1.0])), atol=1e-9
    )
    own = Telemetry(camera_orientation=Samples(times, camera), readout=0.02)
    np.testing.assert_allclose(angular_velocity_at(own, frames, 10 / RATE), true, atol=1e-6)


def test_the_error_of_a_gyroscope_shows_at_rest() -> None:
    times = np.arange(0, 10, 1 / RATE)
    angle = np.where(times > 5, 0.4 * np.sin(3 * (times - 5)), 0.0)
    camera = multiply(np.broadcast_to(LEVEL, (len(times), 4)), from_axis_angle(X, angle))
    bias = np.array([0.007, -0.012, 0.02])
    telemetry = moved(camera, np.zeros((len(times), 3)), times, bias, 0.003)
    np.testing.assert_allclose(gyroscope_bias(telemetry), bias, atol=1e-3)
    frames = np.arange(1, 4, 1 / 30)
    assert np.abs(angular_velocity_at(telemetry, frames, 1 / 30).mean(axis=0)).max() < 1e-3


def test_a_camera_that_never_rests_keeps_its_error() -> None:
    times, camera, acceleration = walk(10.0)
    telemetry = moved(camera, acceleration, times, np.array([0.02, 0.0, 0.0]), 0.003)
    np.testing.assert_array_equal(gyroscope_bias(telemetry), np.zeros(3))
    # Nor is a steady pan taken for an error.
    pan = multiply(from_axis_angle(np.array([0.0, 0.0, 1.0]), 0.2 * times), np.broadcast_to(LEVEL, (len(times), 4)))
    panned = moved(pan, np.zeros((len(times), 3)), times, np.zeros(3), 0.001)
    np.testing.assert_array_equal(gyroscope_bias(panned), np.zeros(3))


def test_frames_beyond_the_samples_are_refused() -> None:
    times = np.arange(0, 3, 1 / RATE)
    telemetry = moved(normalize(np.ones((len(times), 4))), np.zeros((len(times), 3)), times, np.zeros(3), 0.001)
    with pytest.raises(InputError, match=r"ends 1\.972 s before"):
        angular_velocity_at(telemetry, np.array([1.0, 5.0]), 1 / 30)
    with pytest.raises(InputError, match=r"begins 3\.000 s after"):
        down_at(
            replace(telemetry, gyroscope=None, gravity=Samples(times + 3.5, np.tile(Y, (len(times), 1)))),
            np.array([0.5]),
        )
    with pytest.raises(InputError, match="nothing tells how the camera turned"):
        angular_velocity_at(Telemetry(), np.array([1.0]), 1 / 30)
    with pytest.raises(InputError, match="nothing tells where down is"):
        down_at(Telemetry(), np.array([1.0]))
