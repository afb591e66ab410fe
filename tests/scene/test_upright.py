"""Up, and the camera's turns, against cameras of known pitch and roll."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.filmed_walk import FPS, SIZE, filmed_walk
from helpers.mocap import default_humanoid
from helpers.walking import walking
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.humanoid.foot_geometry import sole_positions
from egopose.motion.contacts import contact_labels
from egopose.scene.camera import CameraTrack
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.upright import first_to_world, focal_length, orientation, view_turns


def still(frames: int) -> CameraTrack:
    return CameraTrack(np.tile(np.eye(3), (frames, 1, 1)), np.zeros(frames, bool), np.ones(frames), "similarity")


def touching() -> np.ndarray:
    soles = sole_positions(default_humanoid(), walking())
    return contact_labels(soles, FPS, height=0.03, speed=0.5).reshape(len(soles), 2, 2).any(axis=2)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.25), (0.4, -0.3)])
def test_a_walk_tells_how_the_camera_hangs(pitch: float, roll: float) -> None:
    track, world = filmed_walk(pitch, roll)
    assert track.positions is not None
    hips = track.pixels[:, BODY_25.index("mid_hip")]
    turns = view_turns(hips, still(len(track)), "fixed", SIZE, focal_length(SIZE, None))
    found = orientation(track.positions, touching(), BODY_25, turns, None, None)
    # One step to either side is all that the clip holds: its balance is not quite even.
    assert np.rad2deg([found.pitch - pitch, found.roll - roll]) == pytest.approx([0.0, 0.0], abs=4.0)
    given = orientation(track.positions, touching(), BODY_25, turns, pitch, roll)
    placed = np.einsum("tij,tkj->tki", given.to_world, track.positions)
    np.testing.assert_allclose(placed, world - world[:, [BODY_25.index("mid_hip")]], atol=1e-6)


@settings(deadline=None, max_examples=30)
@given(pitch=st.floats(-1.2, 1.2), roll=st.floats(-1.2, 1.2))
def test_pitch_and_roll_are_what_they_say(pitch: float, roll: float) -> None:
    axes = first_to_world(pitch, roll)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    ahead, right = axes @ [0, 0, 1], axes @ [1, 0, 0]
    assert ahead[2] == pytest.approx(-np.sin(pitch))  # below the horizon
    assert right[2] * np.sin(roll) <= 0  # its right side hangs


def test_nobody_in_balance_means_a_level_camera() -> None:
    track, _ = filmed_walk()
    assert track.positions is not None
    lying = track.positions[..., [1, 0, 2]]
    turns = np.tile(np.eye(3), (len(track), 1, 1))
    found = orientation(lying, touching(), BODY_25, turns, None, None)
    assert (found.pitch, found.roll, found.upright) == (0.0, 0.0, 0.0)


def test_a_camera_that_pans_has_turned_and_one_that_travels_has_not() -> None:
    frames = 5
    shift = np.linspace(0.0, 300.0, frames)
    camera = still(frames)
    camera.to_first[:, 0, 2] = shift
    middle = np.tile(0.5 * np.array(SIZE), (frames, 1))
    focal = focal_length(SIZE, None)
    ahead = view_turns(middle, camera, "pan", SIZE, focal) @ [0, 0, 1]
    np.testing.assert_allclose(np.arctan2(ahead[:, 0], ahead[:, 2]), shift / focal, atol=1e-9)
    np.testing.assert_allclose(view_turns(middle, camera, "track", SIZE, focal), np.tile(np.eye(3), (frames, 1, 1)))
