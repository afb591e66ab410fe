"""Contacts and ground on made-up feet with known answers, and on a real walk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egopose.motion.contacts import contact_labels, point_speeds
from egopose.motion.ground import ground_height, on_ground
from egopose.motion.io import read_motion


def stepping_foot(fps: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """One point: a second on the ground, a second in the air moving 1 m, a second on the ground."""
    n = int(fps)
    swing = np.linspace(0, 1, n + 2)[1:-1]
    x = np.concatenate([np.zeros(n), swing, np.ones(n)])
    z = np.concatenate([np.zeros(n), 0.2 * np.sin(np.pi * swing), np.zeros(n)])
    truth = np.concatenate([np.ones(n, bool), np.zeros(n, bool), np.ones(n, bool)])
    return np.stack([x, 0 * x, z], axis=-1)[:, None], truth


def test_stance_and_swing() -> None:
    points, truth = stepping_foot()
    labels = contact_labels(points, 30.0, height=0.05, speed=0.3)[:, 0]
    # The frame beside a step already moves in a central difference.
    assert (labels != truth).sum() <= 2
    assert labels[:29].all()
    assert not labels[31:59].any()


def test_both_height_and_speed_count() -> None:
    fps, t = 30.0, np.arange(30) / 30.0
    sliding = np.stack([t, 0 * t, 0 * t], axis=-1)
    hanging = np.stack([0 * t, 0 * t, 0 * t + 0.5], axis=-1)
    labels = contact_labels(np.stack([sliding, hanging], axis=1), fps, height=0.05, speed=0.3)
    assert not labels.any()
    assert contact_labels(np.stack([hanging], axis=1), fps, height=np.array([0.6]), speed=0.3).all()


def test_short_gaps_and_contacts_are_noise() -> None:
    z = np.zeros(20)
    z[10] = 0.1
    points = np.stack([0 * z, 0 * z, z], axis=-1)[:, None]
    assert contact_labels(points, 1.0, height=0.05, speed=9.0).all()
    assert not contact_labels(points * 0 + [0, 0, 1] - points, 1.0, height=0.95, speed=9.0).any()
    assert contact_labels(points, 1.0, height=0.05, speed=9.0, min_frames=1).sum() == 19


def test_speed_of_uniform_motion() -> None:
    points = np.arange(5)[:, None, None] * np.array([3.0, 4.0, 0.0])
    np.testing.assert_allclose(point_speeds(points, 2.0), 10.0)
    np.testing.assert_array_equal(point_speeds(points[:1], 2.0), 0.0)


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.full((2, 1, 3), np.nan), np.zeros((2, 1, 2))])
def test_wrong_points_are_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="points"):
        contact_labels(points, 30.0, height=0.1, speed=1.0)
    with pytest.raises(ValueError, match="points"):
        ground_height(points, percentile=5)


@given(st.floats(-3, 3), st.floats(0, 100))
def test_ground_follows_the_body(offset: float, percentile: float) -> None:
    points, _ = stepping_foot()
    lifted = points + np.array([0, 0, offset])
    height = ground_height(points, percentile=percentile)
    assert ground_height(lifted, percentile=percentile) == pytest.approx(height + offset, abs=1e-9)


def test_a_real_walk_is_put_on_the_ground(shared: Path) -> None:
    motion = read_motion(shared / "data" / "cmu_bvh60" / "subjects" / "007" / "007_05.bvh")
    feet = [i for i, n in enumerate(motion.skeleton.names) if n.endswith(("ToeBase", "Foot"))]
    positions, _ = motion.forward_kinematics()
    assert positions[:, feet, 2].min() < -0.5  # this export has its origin at the hips
    grounded = on_ground(motion, positions[:, feet], percentile=5)
    positions, _ = grounded.forward_kinematics()
    assert ground_height(positions[:, feet], percentile=5) == pytest.approx(0.0, abs=1e-9)
    assert grounded.meta["ground_offset"] > 0.5
    toes = [i for i, n in enumerate(motion.skeleton.names) if n.endswith("ToeBase")]
    labels = contact_labels(positions[:, toes], motion.fps, height=0.06, speed=0.5)
    # Walking: the toes of each foot rest for a third to two thirds of the time, seldom neither's.
    assert ((labels.mean(axis=0) > 0.33) & (labels.mean(axis=0) < 0.67)).all()
    assert labels.any(axis=1).mean() > 0.7
