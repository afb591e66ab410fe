"""A camera's turn and velocity from flow, against flow that is calculated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from helpers.seen_ground import flow_of_motion, flow_of_path, walk
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.motion.rotations import Array
from egopose.vision.ground_motion import GroundMotion, fit_ground_motion, gravity_axes, pixel_rays
from egopose.vision.head_signal import down_of, velocity_quality

FPS = 30.0


@dataclass(frozen=True)
class Seen:
    """One frame's flow and what is true of it; ``turn`` and ``velocity`` are a frame's."""

    moved: Array
    rays: Array
    down: Array
    turn: Array
    velocity: Array

    def fitted(self, turn: Array | None = None) -> GroundMotion:
        known = None if turn is None else turn[None]
        return fit_ground_motion(self.moved[None], self.rays, self.down[None], FPS, known)


def seen(seed: int, walls: bool = True, pitch: tuple[float, float] = (8.0, 45.0)) -> Seen:
    """A person's random turn and velocity, over a floor and among walls one and a quarter heights away or further."""
    rng = np.random.default_rng(seed)
    rays, _ = pixel_rays(14, 24, rng.uniform(50.0, 105.0))
    down = down_of(np.deg2rad(rng.uniform(*pitch)), np.deg2rad(rng.uniform(-8.0, 8.0)))
    ahead = np.array([rng.uniform(0.0, 1.5), rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)])
    velocity, turn = gravity_axes(down[None])[0].T @ ahead / FPS, rng.uniform(-1.5, 1.5, 3) / FPS
    inverse_depth = rng.uniform(0.0, 0.8, rays.shape[1]) * walls
    moved = flow_of_motion(turn, velocity, down, rays, inverse_depth)
    # The equations hold where a point is halfway.
    return Seen(moved, rays - 0.5 * moved, down, turn, velocity)


def errors(found: GroundMotion, true: Seen) -> tuple[float, float]:
    """Largest error of the turn, rad/s, and of the velocity, heights/s."""
    turn, velocity = found.turn[0] - true.turn, found.velocity[0] - true.velocity
    return float(np.abs(turn).max() * FPS), float(np.abs(velocity).max() * FPS)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_turn_and_velocity_come_back(seed: int, walls: bool) -> None:
    true = seen(seed, walls)
    found = true.fitted()
    turn, velocity = errors(found, true)
    assert turn < (0.02 if walls else 0.001)
    assert velocity < (0.06 if walls else 0.003)
    assert found.rigid[0] > 0.95
    assert velocity_quality(found, FPS)[0] > 0.6


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_a_third_of_wrong_points_does_little(seed: int) -> None:
    true, rng = seen(seed, pitch=(15.0, 45.0)), np.random.default_rng(seed + 1)
    wrong = rng.random(true.rays.shape[1]) < 1 / 3
    true.moved[:, wrong] = rng.uniform(-0.1, 0.1, (2, int(wrong.sum())))
    found = true.fitted()
    turn, velocity = errors(found, true)
    assert turn < 0.04
    assert velocity < 0.1
    assert found.rigid[0] == pytest.approx(1 - wrong.mean(), abs=0.12)


@pytest.mark.parametrize("rate", [-5.0, -1.0, 2.4])
def test_quick_turns_do_not_pass_for_speed(rate: float) -> None:
    """Points that are projected into both frames; the camera turns at up to 290 degrees a second."""
    positions, rotations = walk(0.5, FPS, 1.44, np.deg2rad(30.0), turn=rate)
    rays, _ = pixel_rays(14, 24, 90.0)
    flow = flow_of_path(positions, rotations, rays, np.random.default_rng(1).uniform(3.0, 12.0, rays.shape[1]))
    down = -rotations[:, 2]
    found = fit_ground_motion(flow, rays, down, FPS)
    axes = gravity_axes(down)
    turn = np.einsum("tij,tj->ti", axes, found.turn)[1:] * FPS
    np.testing.assert_allclose(turn, [[0.0, 0.0, rate]] * len(turn), atol=0.02)
    speed = np.linalg.norm(np.einsum("tij,tj->ti", axes, found.velocity)[1:, :2], axis=1) * FPS
    np.testing.assert_allclose(speed, 1.44 / 1.6, atol=0.08)
    assert velocity_quality(found, FPS)[1:].min() > 0.9


def test_cells_that_show_nothing_count_for_nothing() -> None:
    true, rng = seen(3), np.random.default_rng(3)
    hidden = rng.random(true.rays.shape[1]) < 1 / 3
    true.moved[:, hidden] = np.nan
    kept = Seen(true.moved[:, ~hidden], true.rays[:, ~hidden], true.down, true.turn, true.velocity)
    with_nan, without = true.fitted(), kept.fitted()
    for name in ("turn", "velocity", "deviation", "share", "rigid"):
        np.testing.assert_allclose(getattr(with_nan, name), getattr(without, name), rtol=1e-6, atol=1e-12)


def test_a_known_turn_is_kept_even_where_the_picture_disagrees() -> None:
    true = seen(5)
    found = true.fitted(true.turn)
    np.testing.assert_array_equal(found.turn[0], true.turn)
    assert errors(found, true)[1] < 0.03
    assert found.turn_deviation[0] == 0.0
    other = true.turn + np.array([0.01, -0.02, 0.005])
    np.testing.assert_array_equal(true.fitted(other).turn[0], other)


def test_without_ground_there_is_no_quality_and_no_wild_velocity() -> None:
    rng = np.random.default_rng(7)
    rays, _ = pixel_rays(14, 24, 70.0)
    down = down_of(np.deg2rad(-60.0), 0.0)
    assert (rays[1] * down[1] + down[2]).max() < 0
    turn = np.array([0.01, -0.02, 0.005])
    flow = flow_of_motion(turn, np.array([0.0, 0.0, 0.8]) / FPS, down, rays, rng.uniform(0.0, 0.8, rays.shape[1]))
    found = Seen(flow, rays, down, turn, np.zeros(3)).fitted()
    assert found.ground[0] == 0
    assert velocity_quality(found, FPS)[0] == 0
    assert np.abs(found.velocity[0]).max() * FPS < 3.0
    np.testing.assert_allclose(found.turn[0], turn, atol=0.05 / FPS)


@pytest.mark.parametrize("filled", [0.0, np.nan])
def test_a_picture_that_shows_no_motion_or_nothing_at_all_is_finite(filled: float) -> None:
    rays, _ = pixel_rays(14, 24, 70.0)
    down = down_of(np.deg2rad(25.0), 0.0)
    found = fit_ground_motion(np.full((3, 2, rays.shape[1]), filled), rays, np.tile(down, (3, 1)), FPS)
    for name in ("turn", "velocity", "deviation", "turn_deviation", "share", "rigid"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert np.abs(found.turn).max() * FPS < 1e-3
    if np.isnan(filled):
        assert velocity_quality(found, FPS).max() == 0


def test_frames_are_fitted_apart_from_each_other_and_none_is_none() -> None:
    many = [seen(k) for k in range(40)]
    # One lens for all: rays are shared.
    rays = many[0].rays
    flows = [flow_of_motion(one.turn, one.velocity, one.down, rays, np.zeros(rays.shape[1])) for one in many]
    down = np.stack([one.down for one in many])
    together = fit_ground_motion(np.stack(flows), rays, down, FPS)
    for k in (0, 31, 32, 39):
        alone = fit_ground_motion(flows[k][None], rays, down[k : k + 1], FPS)
        np.testing.assert_allclose(together.velocity[k], alone.velocity[0], atol=1e-9)
    assert len(fit_ground_motion(np.zeros((0, 2, 5)), rays[:, :5], np.zeros((0, 3)), FPS).turn) == 0


def test_axes_that_gravity_aligns() -> None:
    down = down_of(np.deg2rad([0.0, 30.0, 90.0]), np.array([0.0, 0.2, 0.0]))
    axes = gravity_axes(down)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    np.testing.assert_allclose(axes[0], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-9)
    np.testing.assert_allclose(axes[2, 0], [0, -1, 0], atol=1e-9)  # straight down: the picture's upper edge is ahead
