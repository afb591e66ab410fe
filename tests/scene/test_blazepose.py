"""BlazePose against MediaPipe's own program on a picture of a real person, turned, lost and found again."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.scene.poses.drawing import draw_pose
from egopose.scene.poses.keypoints import BLAZEPOSE_33, BODY_25
from egopose.scene.poses.track import PoseTrack
from egopose.vision.video import Frame

pytest.importorskip("ai_edge_litert", reason="the extra 'poses' is not installed")

from egopose.scene.poses.blazepose import BlazePose
from egopose.scene.poses.blazepose_networks import Region

PICTURES = Path(__file__).parent / "pictures"


@pytest.fixture(scope="module")
def person() -> Frame:
    return np.ascontiguousarray(cv2.imread(str(PICTURES / "person.jpg"))[..., ::-1])


@pytest.fixture(scope="module")
def reference() -> dict[str, np.ndarray]:
    card = json.loads((PICTURES / "person.json").read_text())
    return {key: np.array(card[key]) for key in ("pixels", "visibility", "world")}


def turned(points: np.ndarray, turns: int, frame: Frame) -> np.ndarray:
    """Points of a picture in ``np.rot90(picture, turns)``."""
    height, width = frame.shape[:2]
    x, y = points[..., 0], points[..., 1]
    places = ((x, y), (y, width - x), (width - x, height - y), (height - y, x))
    return np.stack(places[turns], axis=-1)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_keypoints_are_mediapipe_s_whichever_way_the_picture_lies(
    person: Frame, reference: dict[str, np.ndarray], turns: int
) -> None:
    track = BlazePose().estimate([np.ascontiguousarray(np.rot90(person, turns))], 30.0)
    height = np.ptp(reference["pixels"][:, 1])
    away = np.linalg.norm(track.pixels[0] - turned(reference["pixels"], turns, person), axis=1) / height
    assert np.median(away) < 0.01
    assert away[reference["visibility"] > 0.8].max() < 0.05
    assert track.positions is not None
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]  # np.rot90 turns against the clock; y points down
    world = reference["world"] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert np.linalg.norm(track.positions[0] - world, axis=1).mean() < 0.03
    if turns == 0:
        np.testing.assert_allclose(track.confidence[0], reference["visibility"], atol=0.15)


def test_who_is_lost_is_found_again_and_frames_without_anyone_are_unknown(person: Frame) -> None:
    empty = np.full_like(person, 90)
    track = BlazePose().estimate([person, empty, empty, np.roll(person, 6, axis=1)], 30.0)
    assert np.isnan(track.pixels[1:3]).all()
    assert (track.confidence[1:3] == 0).all()
    hips = [BLAZEPOSE_33.index(f"{side}_hip") for side in ("left", "right")]
    np.testing.assert_allclose((track.pixels[3] - track.pixels[0])[hips], [[6, 0], [6, 0]], atol=4)
    assert track.image_size == (person.shape[1], person.shape[0])
    box = track.boxes()
    assert np.isnan(box[1]).all()
    assert (box[0, :2] < track.pixels[0, hips].min(axis=0)).all()


def test_a_films_first_frames_are_read_again_from_the_first_sure_one(
    person: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = BlazePose(turns=(0,))
    look, blind = estimator._look, 3

    def looks_away(frame: Frame, around: Region | None = None) -> list[Region]:
        nonlocal blind
        blind -= 1
        return [] if blind >= 0 else look(frame, around)

    monkeypatch.setattr(estimator, "_look", looks_away)
    film = [np.roll(person, 3 * t, axis=1) for t in range(5)]
    track = estimator.estimate(film, 30.0)
    hips = [BLAZEPOSE_33.index(f"{side}_hip") for side in ("left", "right")]
    assert track.confidence.mean(axis=1).min() > 0.8
    np.testing.assert_allclose(
        track.pixels[:, hips] - track.pixels[:1, hips], [[[3 * t, 0]] * 2 for t in range(5)], atol=4
    )


def test_a_film_without_anyone_or_of_changing_size_is_refused(person: Frame) -> None:
    with pytest.raises(InputError, match="no person was found in 2 frames"):
        BlazePose().estimate([np.full_like(person, 90)] * 2, 30.0)
    with pytest.raises(InputError, match="frame 1"):
        BlazePose().estimate([person, person[:-1]], 30.0)


def test_the_drawing_marks_sides_and_leaves_the_picture_alone(person: Frame) -> None:
    pixels = np.full((1, 25, 2), np.nan)
    pixels[0, BODY_25.index("left_knee")], pixels[0, BODY_25.index("left_ankle")] = (50, 50), (50, 90)
    track = PoseTrack(BODY_25, pixels, np.isfinite(pixels[..., 0]).astype(float), 30.0)
    before = person.copy()
    drawn = draw_pose(person, track, 0)
    np.testing.assert_array_equal(person, before)
    changed = (drawn != person).any(axis=-1)
    assert changed[50:90, 50].all()
    assert not changed[:, 70:].any()
    assert drawn[70, 50, 2] > drawn[70, 50, 0]
