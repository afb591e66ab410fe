"""Faults caused on purpose in projected motion capture are found, put right and told."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from helpers.walking import walking

from egopose.motion.rotations import Array
from egopose.scene.poses.following import Candidate, follow
from egopose.scene.poses.from_motion import motion_keypoints
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.mending import MADE_UP, exchange_sides, fill_gaps, with_keyframes
from egopose.scene.poses.sides import facing, mend_sides
from egopose.scene.poses.track import PoseTrack


@lru_cache
def projected(azimuth: float = 0.6, clip: str = "deepmimic_walk", noise: float = 0.005) -> PoseTrack:
    """A walk seen by a pinhole camera that stands still, 4 m away, with the noise of a good estimator.

    Heel and nose, which have no joint, are put where a foot and a head have them.
    """
    world = motion_keypoints(walking(clip))
    for side in ("left", "right"):
        ankle, toe = (world[:, BODY_25.index(f"{side}_{part}")] for part in ("ankle", "big_toe"))
        level = (toe - ankle) * [1.0, 1.0, 0.0]
        world[:, BODY_25.index(f"{side}_heel")] = ankle - 0.35 * level
    hips = world[:, [BODY_25.index("mid_hip")]]
    c, s = np.cos(azimuth), np.sin(azimuth)
    # World to camera axes: x right, y down, z ahead.
    turn = np.array([[-s, c, 0.0], [0.0, 0.0, -1.0], [-c, -s, 0.0]])
    seen = (world - hips) @ turn.T
    rng = np.random.default_rng(0)
    depth = seen[..., 2:] + 4.0
    pixels = 800.0 * (seen[..., :2] / depth) + [640, 360] + rng.normal(size=(*seen.shape[:2], 2)) * noise * 300.0
    known = np.isfinite(pixels).all(axis=-1)
    return PoseTrack(BODY_25, pixels, 0.9 * known, 30.0, (1280, 720), seen)


def marked(count: int, *stretches: tuple[int, int]) -> np.ndarray:
    out = np.zeros(count, dtype=bool)
    for a, b in stretches:
        out[a:b] = True
    return out


@pytest.mark.parametrize("azimuth", [0.0, 0.6, 1.57, 2.4, 4.0])
def test_a_walk_from_any_side_is_left_as_it_is(azimuth: float) -> None:
    """Legs that pass each other in a side view are no exchange."""
    track = projected(azimuth)
    assert not mend_sides(track).swapped.any()
    assert (facing(track) > 0.5).all()


@pytest.mark.parametrize("azimuth", [0.0, 0.6, 2.4])
@pytest.mark.parametrize("depth", [True, False], ids=["3D", "2D"])
def test_exchanged_sides_are_found_and_put_right(azimuth: float, depth: bool) -> None:
    track = projected(azimuth)
    if not depth:
        track = PoseTrack(track.schema, track.pixels, track.confidence, track.fps)
    wrong = marked(len(track), (6, 9), (14, 15), (20, 27))
    mended = mend_sides(exchange_sides(track, wrong))
    np.testing.assert_array_equal(mended.pixels, track.pixels)
    assert f"in {wrong.sum()} of {len(track)} frames" in mended.notes[-1]


def test_a_clip_with_the_sides_wrong_throughout_is_told_by_the_body() -> None:
    track = projected()
    mended = mend_sides(exchange_sides(track, np.ones(len(track), dtype=bool)))
    np.testing.assert_array_equal(mended.positions, track.positions)
    # Nothing but the body tells: pixels alone stay as they came.
    flat = PoseTrack(track.schema, track.pixels[:, track.schema.mirror], track.confidence, track.fps)
    assert mend_sides(flat) is flat


def test_a_gap_is_interpolated_marked_and_told() -> None:
    track = projected()
    pixels, confidence, positions = track.pixels.copy(), track.confidence.copy(), track.positions
    assert positions is not None
    positions = positions.copy()
    pixels[8:14], confidence[8:14], positions[8:14] = np.nan, 0.0, np.nan
    pixels[:2], confidence[:2], positions[:2] = np.nan, 0.0, np.nan
    pixels[20, 4], confidence[20, 4] = np.nan, 0.0
    filled = fill_gaps(PoseTrack(track.schema, pixels, confidence, track.fps, positions=positions))
    known = np.isfinite(track.pixels[0]).all(axis=-1)
    middle = track.pixels[7, known] + (track.pixels[14, known] - track.pixels[7, known]) * (3 / 7)
    np.testing.assert_allclose(filled.pixels[10, known], middle)
    assert filled.filled[8:14][:, known].all()
    assert filled.filled.sum() == 6 * known.sum() + 1
    assert (filled.confidence[8:14][:, known] == MADE_UP).all()
    assert np.isnan(filled.pixels[:2]).all()
    told = " | ".join(filled.notes)
    assert "frames 8 to 13: nobody" in told
    assert "1 single keypoints" in told
    assert "frames 0 to 1: nobody was found, at the clip's end or beginning" in told


def test_a_keyframe_leads_the_interpolation_and_keeps_its_weight() -> None:
    track = projected()
    assert track.positions is not None
    positions = track.positions.copy()
    positions[10:20] = np.nan
    confidence = track.confidence.copy()
    confidence[10:20] = 0.0
    pose = track.positions[15] + 0.05
    gap = PoseTrack(track.schema, track.pixels, confidence, track.fps, positions=positions)
    filled = fill_gaps(with_keyframes(gap, {15: pose}))
    assert filled.positions is not None
    np.testing.assert_allclose(filled.positions[15], pose)
    known = np.isfinite(pose).all(axis=-1)
    want = track.positions[9, known] + (pose[known] - track.positions[9, known]) * (3 / 6)
    np.testing.assert_allclose(filled.positions[12, known], want)
    assert filled.weights[15] == MADE_UP
    assert (np.delete(filled.weights, 15) == 1).all()
    with pytest.raises(ValueError, match="keyframe 99"):
        with_keyframes(gap, {99: pose})


def figure(x: float, y: float, size: float = 200.0, confidence: float = 0.9) -> Candidate:
    rng = np.random.default_rng(3)
    places: Array = rng.uniform(-0.5, 0.5, size=(25, 2)) * size * np.array([0.4, 1.0]) + [x, y]
    return Candidate(places, np.full(25, confidence))


def test_a_person_lost_beside_another_is_not_taken_for_the_other() -> None:
    """The one who is followed is lost while somebody walks by a body's height away, and is found again."""
    frames = [[figure(400, 200)] * (not 30 <= t < 50) + [figure(900 - 10 * t, 330, 190, 0.97)] for t in range(90)]
    chain = follow(frames, 30.0)
    picked = [None if k < 0 else float(frames[t][k].pixels[:, 1].mean()) for t, k in enumerate(chain)]
    first = picked[0]
    assert {p for p in picked if p is not None} == {first} or chain[0] < 0


def test_two_who_cross_are_told_apart() -> None:
    a = [figure(300 + 10 * t, 300, 200) for t in range(60)]
    b = [figure(900 - 10 * t, 315, 185, 0.85) for t in range(60)]
    chain = follow([[p, q] if t % 3 else [q, p] for t, (p, q) in enumerate(zip(a, b, strict=True))], 30.0)
    assert chain == [0 if t % 3 else 1 for t in range(60)]


def test_nobody_anywhere_is_no_one() -> None:
    assert follow([[], [], []], 30.0) == [-1, -1, -1]
