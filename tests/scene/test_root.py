"""The kinematic root against a projectile's formula, a step of known height, and mocap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.data.reference import reference_states
from egopose.humanoid.foot_geometry import sole_positions
from egopose.motion.contacts import contact_labels
from egopose.motion.rotations import Array
from egopose.scene.root import GRAVITY, RootSettings, SeenPlaces, kinematic_root

FPS = 30.0


def feet_of(pelvis: Array, soles: Array) -> Array:
    """``[T, F, 1, 3]`` relative to the pelvis from world soles ``[T, F, 3]``."""
    return (soles - pelvis[:, None])[:, :, None]


def jump(forward: float, up: float, stand: int = 12) -> tuple[Array, Array, np.ndarray]:
    """Pelvis ``[T, 3]``, world soles and contacts of a body that stands, leaps like a stone and lands as high."""
    gather = np.arange(5) / FPS
    flight = round(2 * up / GRAVITY * FPS)
    up = flight / FPS * GRAVITY / 2
    times = np.arange(1, flight + 1) / FPS
    # The push-off and the landing have the flight's speed at its ends, over feet that stay.
    before = np.stack([forward * (gather - gather[-1]), 0 * gather, up * (gather - gather[-1])], axis=1)
    air = np.stack([forward * times, 0 * times, up * times - 0.5 * GRAVITY * times**2], axis=1)
    after = air[-1] + np.stack([forward * gather[1:], 0 * gather[1:], -up * gather[1:]], axis=1)
    pelvis = np.concatenate([np.repeat(before[:1], stand, 0), before, air, after, np.repeat(after[-1:], stand, 0)])
    pelvis[:, 2] += 1.0
    landed = stand + len(before) + flight - 1
    soles = np.zeros((len(pelvis), 2, 3))
    soles[:, :, 1] = [-0.1, 0.1]
    soles[landed:, :, 0] = forward * times[-1]
    flown = np.zeros(len(pelvis), dtype=bool)
    flown[stand + len(before) : landed] = True
    soles[flown, :, 0] = pelvis[flown, None, 0]
    soles[flown, :, 2] = pelvis[flown, None, 2] - 1.0
    return pelvis, soles, np.repeat(~flown[:, None], 2, axis=1)


@pytest.mark.parametrize(("forward", "up"), [(0.0, 2.0), (2.5, 2.0), (1.5, 3.0)])
def test_a_leap_is_a_projectiles(forward: float, up: float) -> None:
    pelvis, soles, contacts = jump(forward, up)
    root = kinematic_root(feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS)
    assert root.flight.sum() >= 0.8 * (~contacts.any(axis=1)).sum()
    truth = pelvis - [pelvis[0, 0], pelvis[0, 1], 0.0]
    assert np.abs(root.positions - truth).max() < 0.06
    apex = root.positions[:, 2].max() - 1.0
    assert apex == pytest.approx(up**2 / (2 * GRAVITY), abs=0.05)
    assert {support.height for support in root.supports} == {0.0}


def test_a_step_up_is_as_high_as_the_joints_say() -> None:
    """The left foot steps on a box while the right one stands; then the right one follows, and the left steps on."""
    heights = [0.0, 0.22, 0.22, 0.44]
    frames = 24
    times = np.arange(frames * 4)
    pelvis = np.stack([0.3 * times / frames, 0 * times, 1.0 + 0.4 * times / len(times)], axis=1)
    soles, contacts = np.zeros((len(times), 2, 3)), np.ones((len(times), 2), dtype=bool)
    for step in range(4):
        now = slice(step * frames, (step + 1) * frames)
        moving = step % 2
        soles[now.start :, moving] = [0.3 * step, 0.1, heights[step]]
        lift = slice(now.start, now.start + 6)
        contacts[lift, moving] = step == 0
        soles[lift, moving, 2] += 0.1 if step else 0.0
    root = kinematic_root(feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS)
    assert not root.flight.any()
    np.testing.assert_allclose(sorted({round(s.height, 3) for s in root.supports}), [0.0, 0.22, 0.44], atol=0.005)
    assert np.abs(root.positions - pelvis).max() < 0.02


def test_a_walk_goes_as_far_as_its_mocap() -> None:
    motion, humanoid = walking(), default_humanoid()
    pelvis = motion.qpos[:, :3]
    soles = sole_positions(humanoid, motion)
    contacts = contact_labels(soles, FPS, height=0.03, speed=0.5).reshape(len(pelvis), 2, 2).any(axis=2)
    feet = (soles - pelvis[:, None]).reshape(len(pelvis), 2, 2, 3)
    com = reference_states(humanoid, motion)["com"].numpy() - pelvis
    root = kinematic_root(feet, contacts, com, FPS)
    path = np.linalg.norm(np.diff(pelvis[:, :2], axis=0), axis=1).sum()
    error = np.linalg.norm(root.positions - (pelvis - [*pelvis[0, :2], 0.0]), axis=1)
    assert path > 0.8
    assert error.mean() < 0.06 * path
    # The answer does not depend on where the camera's frame of reference stands: a turned body walks a turned way.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = kinematic_root(feet @ turn.T, contacts, com @ turn.T, FPS)
    np.testing.assert_allclose(turned.positions, root.positions @ turn.T, atol=1e-6)


def test_a_step_whose_contact_was_missed_is_no_flight() -> None:
    """A walking body sinks before its missed contact and rises after it; a stone does the opposite."""
    times = np.arange(40) / FPS
    pelvis = np.stack([1.2 * times, 0 * times, 1.0 + 0.02 * np.cos(2 * np.pi * 2 * times)], axis=1)
    soles = np.zeros((40, 2, 3))
    soles[:, :, 1] = [-0.1, 0.1]
    contacts = np.ones((40, 2), dtype=bool)
    contacts[6:10] = False  # around the lowest point of the pelvis, at 0.25 s
    root = kinematic_root(feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS)
    assert not root.flight.any()
    assert np.abs(root.positions - pelvis).max() < 0.02


def seen_from_afar(pelvis: Array, error: float) -> SeenPlaces:
    """By a camera that looks along y from 6 m, with errors (m)."""
    camera = np.array([1.0, -6.0, 1.0])
    axes = np.tile(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), (len(pelvis), 1, 1))
    noise = np.random.default_rng(0).normal(scale=error, size=pelvis.shape)
    return SeenPlaces(pelvis - camera + noise, axes, pelvis[:, 1] + 6.0)


def test_pictures_tell_how_far_a_body_falls() -> None:
    """A step off a roof, whose take-off and landing show no speed: only pixels tell of the fall."""
    stand, flight = 12, 19
    times = np.clip(np.arange(2 * stand + flight) - stand + 1, 0, flight) / FPS
    pelvis = np.stack([times, 0 * times, 1.0 - 0.5 * GRAVITY * times**2], axis=1)
    soles = pelvis[:, None] + [[0.0, -0.1, -1.0], [0.0, 0.1, -1.0]]
    contacts = np.ones((len(pelvis), 2), dtype=bool)
    contacts[stand : stand + flight - 1] = False
    drop = 0.5 * GRAVITY * (flight / FPS) ** 2
    seen = seen_from_afar(pelvis, 0.02)
    blind = kinematic_root(feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS)
    told = kinematic_root(feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS, seen=seen)
    last = [support.height for support in told.supports][-1]
    assert last == pytest.approx(-drop, abs=0.15)
    assert [support.height for support in blind.supports][-1] > -0.5 * drop
    with pytest.raises(ValueError, match="seen"):
        kinematic_root(
            feet_of(pelvis, soles), contacts, np.zeros_like(pelvis), FPS, seen=replace(seen, axes=seen.axes[1:])
        )


def test_pictures_hold_a_body_to_its_way_where_feet_mislead() -> None:
    """Feet that seem to take strides half as long again: pictures know better, once poses are trusted little."""
    times = np.arange(90) / FPS
    pelvis = np.stack([1.2 * times, 0 * times, 1.0 + 0 * times], axis=1)
    contacts = np.ones((90, 1), dtype=bool)
    feet = (np.zeros((90, 1, 3)) - 1.5 * pelvis[:, None] * [1.0, 0.0, 0.0] - [0.0, 0.0, 1.0])[:, :, None]
    settings = RootSettings(slip=0.5)
    blind = kinematic_root(feet, contacts, np.zeros_like(pelvis), FPS, settings)
    told = kinematic_root(feet, contacts, np.zeros_like(pelvis), FPS, settings, seen_from_afar(pelvis, 0.02))
    end = pelvis[-1, 0] - pelvis[0, 0]
    assert blind.positions[-1, 0] == pytest.approx(1.5 * end, rel=0.05)
    assert told.positions[-1, 0] == pytest.approx(end, rel=0.05)


@pytest.mark.parametrize("fault", ["contacts", "com", "nan", "nothing"])
def test_what_cannot_be_is_refused(fault: str) -> None:
    feet, contacts, com = np.zeros((5, 2, 1, 3)), np.ones((5, 2), dtype=bool), np.zeros((5, 3))
    words = {"contacts": "contacts", "com": "center_of_mass", "nan": "finite", "nothing": "stand on"}
    if fault == "contacts":
        contacts = contacts[:4]
    elif fault == "com":
        com = com[:4]
    elif fault == "nan":
        feet[2, 0, 0, 1] = np.nan
    else:
        contacts[:] = False
    with pytest.raises(ValueError, match=words[fault]):
        kinematic_root(feet, contacts, com, FPS)
