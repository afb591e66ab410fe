"""Inverse kinematics in time: noise and gaps against the mocap they were made from, and motions that cost nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.motion.smooth_inverse_kinematics import second_differences, solve_smooth

SKELETON = default_humanoid().skeleton
LIMITS = default_humanoid().joint_range
FPS = 30.0


def every_joint(qpos: Array, noise: float = 0.0) -> Targets:
    """All joints' positions as targets, with noise (m an axis)."""
    positions, _ = forward_kinematics(SKELETON, qpos)
    count = len(SKELETON)
    return Targets(
        np.arange(count),
        np.zeros((count, 3)),
        positions + np.random.default_rng(0).normal(scale=noise, size=positions.shape),
        np.ones(count),
        np.zeros(0, dtype=int),
        np.zeros((len(qpos), 0, 4)),
        np.zeros(0),
    )


def error(qpos: Array, truth: Array) -> Array:
    """``[T]`` mean distance of the joints, m."""
    return np.linalg.norm(forward_kinematics(SKELETON, qpos)[0] - forward_kinematics(SKELETON, truth)[0], axis=-1).mean(
        axis=1
    )


def acceleration(qpos: Array) -> float:
    """Mean size of the hinges' acceleration, rad/s^2."""
    return float(np.abs(np.diff(qpos[:, 7:], n=2, axis=0)).mean() * FPS**2)


def test_noise_goes_and_the_motion_stays() -> None:
    truth = walking().qpos
    targets = every_joint(truth, 0.03)
    single = solve(SKELETON, truth, targets, LIMITS, stay=1e-4)
    smooth = solve_smooth(SKELETON, single, targets, FPS, limits=LIMITS, stay=0.0)
    assert acceleration(single) > 60
    assert acceleration(smooth) < 15
    assert error(smooth, truth).mean() < 0.6 * error(single, truth).mean()


def test_frames_that_see_nothing_are_bridged() -> None:
    truth = walking().qpos
    targets = every_joint(truth)
    weight = np.ones(targets.positions.shape[:2])
    weight[12:18] = 0.0
    blind = replace(targets, position_weight=weight)
    start = truth.copy()
    start[12:18] = truth[12]
    bridged = solve_smooth(SKELETON, start, blind, FPS, limits=LIMITS, stay=0.0)
    held = error(start, truth)[12:18].mean()
    assert held > 0.08
    assert error(bridged, truth)[12:18].mean() < 0.2 * held


def test_a_constant_velocity_costs_nothing() -> None:
    """Its second differences vanish, in the turning root too: the clip's own formula is met exactly."""
    times = np.arange(20) / FPS
    qpos = np.tile(SKELETON.rest_qpos(), (20, 1))
    qpos[:, 0], qpos[:, 2] = 1.3 * times, 1.0
    qpos[:, 3:7] = rot.from_axis_angle(np.array([0.0, 0.6, 0.8]), 1.1 * times)
    qpos[:, 7:] = 0.2 + np.linspace(0.1, 0.4, SKELETON.n_dofs) * times[:, None] * np.sign(LIMITS.mean(axis=1) + 1e-9)
    np.testing.assert_allclose(second_differences(qpos), 0.0, atol=1e-12)
    start = qpos.copy()
    start[:, 7:] += np.random.default_rng(1).normal(scale=0.05, size=start[:, 7:].shape)
    out = solve_smooth(SKELETON, start, every_joint(qpos), FPS, stay=0.0, iterations=30)
    assert error(out, qpos).max() < 1e-3


def test_weights_of_frames_and_points() -> None:
    truth = walking().qpos[:20]
    targets = every_joint(truth, 0.01)
    shared = solve(SKELETON, truth, targets, LIMITS)
    repeated = np.ones(targets.positions.shape[:2])
    np.testing.assert_allclose(solve(SKELETON, truth, replace(targets, position_weight=repeated), LIMITS), shared)
    # A hand that is thrown two metres away in some frames does nothing there once it weighs nothing.
    hand = SKELETON.index("LeftHand")
    thrown, ignored = targets.positions.copy(), repeated.copy()
    thrown[5:9, hand] += 2.0
    ignored[5:9, hand] = 0.0
    worse = solve(SKELETON, truth, replace(targets, positions=thrown), LIMITS)
    better = solve(SKELETON, truth, replace(targets, positions=thrown, position_weight=ignored), LIMITS)
    assert error(worse, truth)[5:9].mean() > 0.1
    assert error(better, truth)[5:9].mean() < 0.02
    np.testing.assert_allclose(better[[0, 15]], shared[[0, 15]])


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan")])
def test_a_rate_must_be_positive(fps: float) -> None:
    truth = walking().qpos[:4]
    with pytest.raises(ValueError, match="fps"):
        solve_smooth(SKELETON, truth, every_joint(truth), fps)


def test_two_frames_have_no_acceleration() -> None:
    truth = walking().qpos[:2]
    np.testing.assert_array_equal(solve_smooth(SKELETON, truth, every_joint(truth), FPS), truth)
