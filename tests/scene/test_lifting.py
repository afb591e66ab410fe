"""Lifting 2D keypoints: the packaged network on projected mocap that it has not seen, and what must not matter."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from helpers.mocap import default_humanoid
from helpers.walking import walking
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.checkpoint.lifting import load_lifting_network
from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.scene.lifting import (
    INPUTS,
    JOINTS,
    KEYPOINTS,
    POINTS,
    SEEN,
    LiftingNetwork,
    camera_axes,
    lift,
    lifted_track,
    mirrored_points,
    mirrored_windows,
)
from egopose.scene.poses.keypoints import BODY_25, COCO_18, HUMANOID_JOINTS
from egopose.scene.poses.sides import facing
from egopose.scene.poses.track import PoseTrack

LIMBS = [POINTS.index(name) for name in HUMANOID_JOINTS.values()]


@lru_cache
def seen(azimuth: float = 0.6, aside: float = 0.0, distance: float = 5.0) -> tuple[PoseTrack, Array]:
    """A walk of DeepMimic's through a level camera, and its true points ``[T, 28, 3]`` m in the camera's axes.

    Args:
        azimuth: rad, of the camera around the walker.
        aside: rad, by which the camera looks past them.
        distance: m.
    """
    motion = walking()
    positions, quats = motion.forward_kinematics()
    skeleton = motion.skeleton
    beside = {
        **{"nose": ("Head", (0.11, 0.0, 0.07)), "left_ear": ("Head", (0.0, 0.08, 0.07))},
        **{"right_ear": ("Head", (0.0, -0.08, 0.07))},
        **{f"{s.lower()}_big_toe": (f"{s}Foot", (0.17, 0.0, -0.05)) for s in ("Left", "Right")},
        **{f"{s.lower()}_heel": (f"{s}Foot", (-0.05, 0.0, -0.05)) for s in ("Left", "Right")},
    }
    world = np.empty((len(motion), len(POINTS), 3))
    for k, name in enumerate(POINTS):
        joint, place = beside.get(name, (name, (0.0, 0.0, 0.0)))
        row = skeleton.index(joint)
        world[:, k] = positions[:, row] + rot.rotate(quats[:, row], np.array(place)[None])
    hips = world[:, [POINTS.index(f"{side}UpLeg") for side in ("Left", "Right")]].mean(axis=1, keepdims=True)
    look = azimuth + aside
    axes = np.array([[-np.sin(look), np.cos(look), 0.0], [0.0, 0.0, -1.0], [-np.cos(look), -np.sin(look), 0.0]])
    camera = distance * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    relative = (world - hips) @ axes.T
    spread = relative - axes @ camera
    pixels = np.full((len(motion), len(BODY_25), 2), np.nan)
    rows = [BODY_25.index(name) for name in KEYPOINTS]
    pixels[:, rows] = (960.0 * spread[..., :2] / spread[..., 2:] + [640.0, 360.0])[:, list(SEEN)]
    confidence = 0.9 * np.isfinite(pixels).all(axis=-1)
    return PoseTrack(BODY_25, pixels, confidence, motion.fps, (1280, 720)), relative


def error(points: Array, truth: Array) -> float:
    """Mean distance of the limbs' joints, m, sizes and middles of the hips aligned."""
    known = np.isfinite(points).all(axis=(1, 2))
    a, b = points[known][:, LIMBS], truth[known][:, LIMBS]
    return float(np.linalg.norm(a * (a * b).sum() / (a**2).sum() - b, axis=-1).mean())


@pytest.mark.parametrize("azimuth", [0.0, 1.0, 2.5, 4.0])
def test_the_network_is_far_nearer_than_the_mean_pose(azimuth: float) -> None:
    track, truth = seen(azimuth)
    points = lift(track, load_lifting_network())
    assert points.shape == (len(track), len(POINTS), 3)
    # The mean pose is even told which way the walker faces.
    still = np.broadcast_to(truth.mean(axis=0), truth.shape)
    off = error(points, truth)
    assert off < 0.09
    assert off < 0.8 * error(still, truth)
    # Depth alone, which no picture shows.
    a, b = points[:, LIMBS, 2].ravel(), truth[:, LIMBS, 2].ravel()
    assert np.corrcoef(a, b)[0, 1] > 0.7
    assert (facing(lifted_track(track, load_lifting_network())) > 0).mean() > 0.9


@given(st.floats(-2000, 2000), st.floats(-2000, 2000), st.floats(0.05, 20.0), st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_place_and_size_in_the_picture_do_not_matter(x: float, y: float, scale: float, seed: int) -> None:
    """Whatever the network says: so for any of its weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LiftingNetwork(16, 1).eval()
        torch.nn.init.normal_(network.last.weight, std=0.1)
    track, _ = seen()
    moved = replace(track, pixels=scale * track.pixels + [x, y])
    np.testing.assert_allclose(lift(moved, network), lift(track, network), atol=1e-3)


def test_the_mirror_image_gives_the_mirrored_pose() -> None:
    track, _ = seen()
    network = load_lifting_network()
    mirrored = replace(track, pixels=(track.pixels * [-1.0, 1.0])[:, BODY_25.mirror])
    there = mirrored_points(torch.from_numpy(lift(mirrored, network))).numpy()
    np.testing.assert_allclose(there, lift(track, network), atol=1e-5)
    windows = torch.randn(3, INPUTS)
    assert torch.equal(mirrored_windows(mirrored_windows(windows)), windows)


def test_a_short_gap_is_bridged_and_a_long_one_left_open() -> None:
    track, truth = seen()
    network = load_lifting_network()
    for length, bridged in ((3, True), (15, False)):
        pixels, confidence = track.pixels.copy(), track.confidence.copy()
        pixels[8 : 8 + length], confidence[8 : 8 + length] = np.nan, 0.0
        points = lift(replace(track, pixels=pixels, confidence=confidence), network)
        gap = points[8 : 8 + length]
        assert np.isfinite(gap).all() if bridged else np.isnan(gap).all()
        around = np.delete(points, np.s_[8 : 8 + length], axis=0)
        assert np.isfinite(around).all()
        if bridged:
            assert error(gap, truth[8 : 8 + length]) < 0.12


def test_dropped_keypoints_and_a_layout_without_feet_are_survived() -> None:
    track, truth = seen()
    network = load_lifting_network()
    whole = error(lift(track, network), truth)
    gone = np.random.default_rng(0).random(track.confidence.shape) < 0.2
    pixels = np.where(gone[..., None], np.nan, track.pixels)
    dropped = lift(replace(track, pixels=pixels, confidence=np.where(gone, 0.0, track.confidence)), network)
    assert error(dropped, truth) < whole + 0.03
    rows = [BODY_25.index(name) for name in COCO_18.names]
    coco = PoseTrack(COCO_18, track.pixels[:, rows], track.confidence[:, rows], track.fps, track.image_size)
    assert error(lift(coco, network), truth) < whole + 0.03


def test_landmarks_count_by_their_share_and_give_the_size() -> None:
    track, truth = seen()
    network = load_lifting_network()
    landmarks = np.full((len(track), len(BODY_25), 3), np.nan)
    landmarks[:, [BODY_25.index(name) for name in KEYPOINTS]] = truth[:, list(SEEN)] + 0.3
    both = replace(track, positions=landmarks)
    points = lift(both, network, landmark_share=(1.0, 1.0))
    np.testing.assert_allclose(points[:, list(SEEN)], truth[:, list(SEEN)], atol=1e-6)
    alone = lift(both, network, landmark_share=(0.0, 0.0))
    half = lift(both, network, landmark_share=(0.5, 0.5))
    np.testing.assert_allclose(half[:, LIMBS], 0.5 * (points + alone)[:, LIMBS], atol=1e-6)
    # The walker's own size, though no height was given.
    length = [np.linalg.norm(p[:, LIMBS], axis=-1).mean() for p in (alone, truth)]
    assert length[0] == pytest.approx(length[1], rel=0.1)
    np.testing.assert_allclose(lift(track, network, 1.0) * 1.8, lift(track, network, 1.8), atol=1e-9)


def test_a_camera_that_looks_past_the_person_is_told_by_their_place_in_the_picture() -> None:
    network = load_lifting_network()
    straight, _ = seen(1.0)
    past, truth = seen(1.0, aside=0.4)
    points = lift(past, network)
    turned = camera_axes(points, past, focal=960.0)
    assert error(turned, truth) < error(points, truth) - 0.03
    np.testing.assert_allclose(camera_axes(lift(straight, network), straight), lift(straight, network), atol=0.02)


def test_what_cannot_be_lifted_is_refused() -> None:
    track, _ = seen()
    network = LiftingNetwork(16, 1).eval()
    blind = replace(track, pixels=np.full_like(track.pixels, np.nan), confidence=np.zeros_like(track.confidence))
    with pytest.raises(InputError, match="show no hips"):
        lift(blind, network)
    with pytest.raises(InputError, match="height"):
        lift(track, network, -1.0)
    with pytest.raises(InputError, match="image_size"):
        camera_axes(lift(track, network), replace(track, image_size=None))


def test_the_joints_are_the_default_humanoids() -> None:
    assert set(JOINTS) == set(default_humanoid().skeleton.names)
