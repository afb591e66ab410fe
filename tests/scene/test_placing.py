"""From keypoints to the humanoid, into the pictures, and to the scene: against what they were made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.filmed_walk import FPS, filmed_walk
from helpers.mocap import default_humanoid

from egopose.core.errors import InputError
from egopose.scene.articulation import articulated
from egopose.scene.drawing import box_corners, draw_box
from egopose.scene.edits import add_box, remove_box, remove_contact, with_box, with_contact
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.timing import cut, known_span, resampled
from egopose.scene.projection import fit_projection
from egopose.scene.root import Support
from egopose.scene.scene_file import FLOOR, Box, Contact, Scene
from egopose.scene.supports import (
    contacts_of,
    filled_scene,
    floor_height,
    level_heights,
    levels,
    matched,
    told_contacts,
    touched,
)


def directions(points: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    bones = np.stack([points[:, b] - points[:, a] for a, b in pairs], axis=1)
    return bones / np.linalg.norm(bones, axis=2, keepdims=True)


def test_the_humanoid_takes_the_keypoints_poses() -> None:
    _, world = filmed_walk()
    relative = world - world[:, [BODY_25.index("mid_hip")]]
    sure = np.full(relative.shape[:2], 0.9)
    motion, report = articulated(Path("walk"), relative, sure, default_humanoid(), FPS)
    joints, _ = motion.forward_kinematics()
    limbs = [("hip", "knee", "UpLeg", "Leg"), ("knee", "ankle", "Leg", "Foot"), ("elbow", "wrist", "ForeArm", "Hand")]
    for side in ("left", "right"):
        for a, b, joint, child in limbs:
            keypoints = directions(relative, [(BODY_25.index(f"{side}_{a}"), BODY_25.index(f"{side}_{b}"))])
            names = [f"{side.capitalize()}{name}" for name in (joint, child)]
            body = directions(joints, [(motion.skeleton.index(names[0]), motion.skeleton.index(names[1]))])
            away = np.rad2deg(np.arccos(np.clip((keypoints * body).sum(axis=2), -1, 1)))
            assert away.mean() < 5.0, f"{side}_{a}"
    hips = joints[:, [motion.skeleton.index(f"{s}UpLeg") for s in ("Left", "Right")]].mean(axis=1)
    assert np.abs(hips).max() < 0.05
    assert report.position_mm


def test_a_projection_is_found_again() -> None:
    rng = np.random.default_rng(0)
    frames, count = 20, 12
    points = rng.normal(size=(frames, count, 3))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    to_world = np.tile(axes, (frames, 1, 1))
    origin = rng.uniform(100, 500, size=(frames, 2))
    pixels = 150.0 * np.einsum("ij,tkj->tki", axes.T[:2], points) + origin[:, None]
    pixels[7] = np.nan
    found = fit_projection(points, pixels, np.ones((frames, count)), to_world, FPS)
    known = np.arange(frames) != 7
    np.testing.assert_allclose(found.pixels(points)[known], pixels[known], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.matrix[7, 0]), 150.0)


def supports() -> list[Support]:
    """Right foot on the floor, left on a step of 0.4 m, right beside it, left down again."""
    return [Support(0, 0, 10, 1.0), Support(1, 8, 20, 1.4), Support(0, 15, 25, 1.41), Support(1, 24, 30, 1.02)]


def feet() -> np.ndarray:
    """``[T, 2, 2]``: walking along x, a metre a second."""
    ahead = np.repeat(np.array([0.0, 1.0, 2.0]), 10)
    return np.stack([np.stack([ahead, 0 * ahead - 0.1], 1), np.stack([ahead, 0 * ahead + 0.1], 1)], axis=1)


def test_what_lies_above_the_floor_becomes_a_box() -> None:
    rows, scene = supports(), Scene()
    touches = touched(scene, rows)
    floor = floor_height(rows, touches)
    assert floor == pytest.approx(1.0, abs=0.03)
    lowered = [Support(s.foot, s.start, s.stop, s.height - floor) for s in rows]
    on = levels(lowered, touches, 0.0, feet(), np.zeros(30))
    assert [level.supports for level in on] == [(1, 2)]
    filled = filled_scene(scene, lowered, touches, on)
    (box,) = filled.boxes
    assert box.height == pytest.approx(0.405, abs=0.01)
    assert box.known
    assert [(c.effector, c.touches, c.first, c.last) for c in filled.contacts] == [
        ("right_foot", FLOOR, 0, 9),
        ("left_foot", box.name, 8, 19),
        ("right_foot", box.name, 15, 24),
        ("left_foot", FLOOR, 24, 29),
    ]
    # What was filled in is kept as it is when it comes back.
    again = touched(filled, lowered)
    assert filled_scene(filled, lowered, again, levels(lowered, again, 0.0, feet(), np.zeros(30))) == filled


def test_a_box_that_the_user_described_takes_the_level() -> None:
    rows = [Support(s.foot, s.start, s.stop, s.height - 1.0) for s in supports()]
    scene = Scene(boxes=(Box("bench", (0.4, 1.2), height=0.5),))
    touches = touched(scene, rows)
    filled = filled_scene(scene, rows, touches, levels(rows, touches, 0.0, feet(), np.zeros(30)))
    (bench,) = filled.boxes
    assert (bench.name, bench.size, bench.height) == ("bench", (0.4, 1.2), 0.5)
    assert bench.place is not None
    assert filled.contacts[1].touches == "bench"


def test_feet_stand_on_the_boxes_that_a_scene_tells_or_on_its_floor() -> None:
    """The step was guessed 0.15 m too high; the last support seems to float, and there is nothing but floor."""
    rows = [Support(s.foot, s.start, s.stop, s.height - 1.0) for s in supports()]
    rows[-1] = Support(1, 24, 30, 0.2)
    step = Box("step", (0.5, 0.8), place=(1.0, 0.0), height=0.55, yaw=0.0)
    on = matched(Scene(boxes=(step,)), rows, [None] * 4, 0.0, feet())
    assert on == [FLOOR, "step", "step", FLOOR]
    # Nobody stands on the floor in the middle of a box, however low the box was guessed.
    wide = Box("wide", (1.5, 1.5), place=(1.0, 0.0), height=0.3, yaw=0.0)
    low = [Support(1, 12, 18, 0.05)]
    assert matched(Scene(boxes=(wide,)), low, [None], 0.0, feet()) == ["wide"]
    assert matched(Scene(), rows, [None] * 4, 0.0, feet()) == [FLOOR] * 4
    assert matched(Scene(boxes=(step,)), rows, ["step", None, None, None], 0.0, feet())[0] == "step"


def test_a_box_without_a_place_waits_for_what_is_on_no_other() -> None:
    rows = [Support(s.foot, s.start, s.stop, s.height - 1.0) for s in supports()]
    on = matched(Scene(boxes=(Box("bench", (0.4, 1.2)),)), rows, [None] * 4, 0.0, feet())
    assert on == [FLOOR, None, None, FLOOR]


def test_feet_on_one_thing_stand_at_one_height() -> None:
    rows = [Support(s.foot, s.start, s.stop, s.height - 1.0) for s in supports()]
    on = levels(rows, [FLOOR, "a", "a", FLOOR], 0.0, feet(), np.zeros(30))
    heights = level_heights(rows, 0.0, on)
    assert heights[0] == heights[3] == 0.0
    assert heights[1] == heights[2] == pytest.approx(0.405, abs=0.006)


def test_contacts_that_are_given_win() -> None:
    contacts = (Contact("left_foot", "bench", 8, 19), Contact("left_hand", "bench", 3, 5))
    scene = Scene(boxes=(Box("bench", (0.4, 1.2)),), contacts=contacts)
    touching = told_contacts(scene, 30)
    assert touching is not None
    assert touching[:, 0].sum() == 0
    assert np.flatnonzero(touching[:, 1]).tolist() == list(range(8, 20))
    assert contacts_of(touching) == (("left_foot", 8, 19),)
    assert told_contacts(Scene(), 30) is None


def test_boxes_are_drawn_where_they_stand() -> None:
    box = Box("a", (2.0, 1.0), (3.0, 4.0), 0.5, 0.5 * np.pi)
    corners = box_corners(box)
    assert corners[:4, 2].tolist() == [0.5] * 4
    np.testing.assert_allclose([np.ptp(corners[:, 0]), np.ptp(corners[:, 1])], [1.0, 2.0])
    np.testing.assert_allclose(corners.mean(axis=0)[:2], [3.0, 4.0])
    with pytest.raises(ValueError, match="place"):
        box_corners(Box("b", (1.0, 1.0)))
    points = np.random.default_rng(0).normal(size=(1, 6, 3))
    level = np.array([[[1.0, 0, 0], [0, 0, 1], [0, -1.0, 0]]])
    pixels = 40.0 * np.einsum("ij,tkj->tki", level[0].T[:2], points) + [50, 100]
    projection = fit_projection(points, pixels, np.ones((1, 6)), level, FPS)
    picture = np.zeros((200, 300, 3), np.uint8)
    drawn = draw_box(picture, box, projection, 0)
    assert not picture.any()
    rows, columns = np.nonzero(drawn.any(axis=2))
    assert (columns.min(), columns.max()) == pytest.approx((50 + 40 * 2.5, 50 + 40 * 3.5), abs=3)
    assert rows.max() - rows.min() == pytest.approx(20, abs=3)


def test_edits_keep_a_scene_whole() -> None:
    scene = Scene(boxes=(Box("a", (1.0, 1.0), (0.0, 0.0), 0.3, 0.0),), contacts=(Contact("left_foot", "a", 0, 3),))
    more, name = add_box(scene, np.array([1.0, 2.0]))
    assert name == "box1"
    assert more.box(name).known
    assert remove_box(more, "a").contacts[0].touches == FLOOR
    assert with_box(scene, "a", height=0.7).boxes[0].height == 0.7
    with pytest.raises(InputError, match="height"):
        with_box(scene, "a", height=7.0)
    two = with_contact(scene, 1, Contact("right_foot", FLOOR, 2, 4))
    assert remove_contact(two, 1) == scene


def test_a_track_at_another_rate_and_a_part_of_it() -> None:
    track, _ = filmed_walk()
    twice = resampled(track, 60.0)
    assert len(twice) == 2 * len(track) - 1
    np.testing.assert_allclose(twice.pixels[::2], track.pixels)
    np.testing.assert_allclose(resampled(twice, 30.0).pixels, track.pixels)
    pixels = track.pixels.copy()
    pixels[:3] = np.nan
    pixels[-2:] = np.nan
    blind = replace(track, pixels=pixels)
    start, stop = known_span(blind)
    assert (start, stop) == (3, len(track) - 2)
    assert np.isfinite(cut(blind, start, stop).pixels).all()
