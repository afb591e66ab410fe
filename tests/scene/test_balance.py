"""A lean that puts a body over its feet, and leaves one that is in balance alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.scene.balance import BalanceSettings, lean
from egopose.scene.root import GRAVITY

FPS = 30.0
AWAY = np.array([0.0, 1.0, 0.0])  # from the camera


def standing(frames: int, away: Array) -> tuple[Array, Array, Array, Array]:
    """Feet at the origin, contacts, centre of mass 1 m up and ``away [.., 2]`` m aside, sight."""
    com = np.zeros((frames, 3))
    com[:, 2], com[:, :2] = 1.0, away
    feet = np.zeros((frames, 1, 3))
    return feet, np.ones((frames, 1), dtype=bool), com, np.tile(AWAY, (frames, 1))


def moved(com: Array, turn: Array) -> Array:
    return rot.rotate(rot.from_rotvec(turn), com)


def test_a_body_that_leans_from_the_camera_is_set_up() -> None:
    feet, contacts, com, sight = standing(60, np.array([0.0, 0.3]))
    after = moved(com, lean(feet, contacts, com, sight, FPS))
    assert np.abs(after[:, 1]).max() < 0.12


def test_depth_gives_way_before_the_picture() -> None:
    settings_ = BalanceSettings()
    deep = lean(*standing(60, np.array([0.0, 0.2])), FPS)
    wide = lean(*standing(60, np.array([0.2, 0.0])), FPS)
    assert np.abs(deep).max() > 1.5 * np.abs(wide).max()
    assert settings_.depth > settings_.across


@settings(max_examples=20, deadline=None)
@given(st.floats(0.3, 1.2), st.floats(0.0, 6.0))
def test_a_pendulum_over_its_foot_is_left_alone(speed: float, phase: float) -> None:
    """A body that passes over its foot as gravity has it carries itself: c'' = g / h c."""
    rate = np.sqrt(GRAVITY)
    times = np.arange(13) / FPS - 0.2
    out = speed / rate * np.sinh(rate * times)
    way = np.array([np.cos(phase), np.sin(phase)])
    turn = lean(*standing(13, out[:, None] * way), FPS)
    assert np.abs(turn).max() < 0.05


def test_frames_in_the_air_follow_those_around_them() -> None:
    feet, contacts, com, sight = standing(60, np.array([0.0, 0.2]))
    contacts[25:35] = False
    turn = lean(feet, contacts, com, sight, FPS)
    assert np.abs(np.diff(turn, axis=0)).max() < 0.02
    assert np.abs(turn[30] - turn[20]).max() < 0.03
