"""Path metrics against walks whose path, heading and step rate are known by a formula."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from egopose.evaluation import path_metrics as pm
from egopose.motion import rotations as rot

Array = NDArray[np.float64]
FPS = 30.0
UP = np.array([0.0, 0.0, 1.0])


def circle(
    seconds: float, speed: float, radius: float, at: Array | None = None, facing: float = 0.0
) -> tuple[Array, Array]:
    """Path and heading of a walk at ``speed`` m/s on a circle that turns left, from ``at`` and along ``facing``."""
    time = np.arange(round(seconds * FPS) + 1) / FPS
    heading = facing + speed / radius * time
    centre = (np.zeros(2) if at is None else at) + radius * np.array([-np.sin(facing), np.cos(facing)])
    return centre + radius * np.column_stack([np.sin(heading), -np.cos(heading)]), heading


def test_a_circle_at_half_speed_is_half_as_quick_and_ends_by_the_chord_formula() -> None:
    radius, speed, seconds = 2.0, 1.2, 6.0
    true, facing = circle(seconds, speed, radius)
    slow, slow_facing = circle(seconds, speed / 2, radius, np.array([5.0, -3.0]), 2.0)
    assert pm.forward_speed(true, facing, FPS) == pytest.approx(speed, rel=1e-3)
    assert pm.forward_speed_ratio(slow, slow_facing, true, facing, FPS) == pytest.approx(0.5, rel=1e-3)
    # End points are apart by the chord of what is missing of the arc.
    arc = speed * seconds / radius
    expected = 100.0 * 2 * radius * np.sin(arc / 4) / (speed * seconds)
    assert pm.net_path_error_percent(slow, slow_facing, true, facing) == pytest.approx(expected, rel=1e-3)
    # A heading that turns at half the rate is off by rate/2 * t; what the first second's mean takes off is known too.
    time = np.arange(len(facing)) / FPS
    off = np.abs(speed / radius / 2 * (time - time[:30].mean())).mean()
    assert pm.heading_error(slow_facing, facing, FPS) == pytest.approx(off, rel=1e-6)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-9, 9), st.floats(0.3, 3), st.floats(0.5, 9), st.booleans())
def test_where_a_walk_begins_and_faces_does_not_matter(
    x: float, y: float, facing: float, speed: float, radius: float, wrapped: bool
) -> None:
    true, heading = circle(3.0, speed, radius)
    moved, turned = circle(3.0, speed, radius, np.array([x, y]), facing)
    turned = rot.wrapped(turned) if wrapped else turned
    assert pm.net_path_error_percent(moved, turned, true, heading) == pytest.approx(0.0, abs=1e-6)
    assert pm.heading_error(turned, heading, FPS) == pytest.approx(0.0, abs=1e-9)
    assert pm.forward_speed_ratio(moved, turned, true, heading, FPS) == pytest.approx(1.0, abs=1e-9)


def test_a_body_that_walks_backwards_or_stays_is_told_so() -> None:
    true, heading = circle(4.0, 1.0, 3.0)
    assert pm.forward_speed_ratio(true[::-1], heading[::-1], true, heading, FPS) == pytest.approx(-1.0, rel=1e-2)
    still = np.zeros_like(true)
    assert pm.forward_speed_ratio(still, heading, true, heading, FPS) == 0.0
    chord = 6.0 * np.sin(4.0 / 6.0)
    assert pm.net_path_error_percent(still, heading, true, heading) == pytest.approx(100 * chord / 4.0, rel=1e-3)
    assert np.isnan(pm.forward_speed_ratio(true, heading, still, heading, FPS))
    assert np.isnan(pm.net_path_error_percent(true, heading, still, heading))


def test_yaw_rates_correlate_as_their_sines_do() -> None:
    time = np.arange(600) / FPS

    def swinging(phase: float) -> Array:
        return -np.cos(2 * np.pi * 0.5 * time + phase)

    for phase in (0.0, 0.7, np.pi / 2, np.pi):
        r = pm.yaw_rate_correlation(3.0 * swinging(phase) + 0.2 * time, swinging(0.0), FPS)
        assert r == pytest.approx(np.cos(phase), abs=5e-3)
    # A full turn and more: jumps from pi to -pi are none.
    spin = 2.0 * time + swinging(0.0)
    assert pm.yaw_rate_correlation(rot.wrapped(spin), spin, FPS) == pytest.approx(1.0)
    assert np.isnan(pm.yaw_rate_correlation(spin, 0.3 * time, FPS))


@given(st.floats(1.15, 3.3), st.floats(0.006, 0.05), st.floats(4.0, 12.0), st.integers(0, 2**31))
def test_steps_are_counted_in_a_bob_with_sway_noise_and_a_ramp(
    rate: float, size: float, seconds: float, seed: int
) -> None:
    time = np.arange(round(seconds * FPS)) / FPS
    noise = np.random.default_rng(seed).normal(0.0, 0.002, len(time))
    height = 0.9 + 0.05 * time + size * np.sin(2 * np.pi * rate * time) + 0.03 * np.sin(2 * np.pi * 0.2 * time) + noise
    assert pm.step_frequency(height, FPS) == pytest.approx(rate, abs=0.15)


def test_who_stands_takes_no_steps() -> None:
    time = np.arange(300) / FPS
    noise = np.random.default_rng(0).normal(0.0, 0.002, len(time))
    assert np.isnan(pm.step_frequency(0.9 + noise, FPS))
    assert np.isnan(pm.step_frequency(0.9 + 0.1 * np.sin(2 * np.pi * 0.3 * time), FPS))  # knees bent now and then
    assert np.isnan(pm.step_frequency(0.02 * np.sin(2 * np.pi * 2.0 * time[:50]), FPS))  # too short to tell


def test_a_root_gives_path_and_heading() -> None:
    path, heading = circle(12.0, 1.0, 1.0, np.array([1.0, 2.0]), 0.4)
    qpos = np.zeros((len(path), 9))
    qpos[:, :2] = path
    lean = rot.from_axis_angle(np.array([0.0, 1.0, 0.0]), np.full(len(path), 0.3))
    qpos[:, 3:7] = rot.multiply(rot.from_axis_angle(UP, heading), lean)
    found, facing = pm.path_of(qpos)
    np.testing.assert_array_equal(found, path)
    np.testing.assert_allclose(facing, heading, atol=1e-12)


def test_what_cannot_be_compared_is_refused() -> None:
    path, heading = circle(1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="differ"):
        pm.yaw_rate_correlation(heading[1:], heading, FPS)
    with pytest.raises(ValueError, match="differ"):
        pm.net_path_error_percent(path[1:], heading[1:], path, heading)
    with pytest.raises(ValueError, match="at least 2"):
        pm.forward_speed(path[:1], heading[:1], FPS)
