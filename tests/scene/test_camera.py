"""The camera's motion over pictures warped by known matrices: the truth is exact."""

from __future__ import annotations

from importlib.resources import files

import cv2
import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.scene.camera import camera_motion
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack
from egopose.vision.video import Frame

WIDTH, HEIGHT = 480, 270
CORNERS = np.array([[40.0, 40.0], [440.0, 30.0], [240.0, 135.0], [30.0, 240.0], [450.0, 250.0]])


def ground() -> Frame:
    """A photograph of gravel, enlarged, in large patches of other brightness."""
    path = str(files("egopose") / "assets" / "surfaces" / "gravel.jpg")
    picture = cv2.resize(cv2.imread(path)[..., ::-1], (1400, 1000), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(picture)


def flight(frames: int, kind: str) -> Array:
    """``[T, 3, 3]`` from each frame's pixels to the ground's: pan, zoom, roll; a homography also tilts."""
    t = np.arange(frames)
    turn, zoom = 0.004 * t, 1.0 + 0.006 * t
    out = np.tile(np.eye(3), (frames, 1, 1))
    out[:, 0, 0] = out[:, 1, 1] = zoom * np.cos(turn)
    out[:, 1, 0], out[:, 0, 1] = zoom * np.sin(turn), -zoom * np.sin(turn)
    out[:, 0, 2], out[:, 1, 2] = 200 + 7.0 * t, 150 + 3.0 * t
    if kind == "homography":
        out[:, 2, 0], out[:, 2, 1] = 4e-6 * t, -2e-6 * t
    return out


def film(matrices: Array) -> list[Frame]:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return [cv2.warpPerspective(ground(), m, (WIDTH, HEIGHT), flags=flags) for m in matrices]


def seen_from_first(matrices: Array, points: Array) -> Array:
    """Where the first frame shows points ``[T, N, 2]`` of each frame, by the matrices that made the film."""
    homogeneous = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    out = np.einsum("tij,tnj->tni", np.linalg.inv(matrices[0]) @ matrices, homogeneous)
    return out[..., :2] / out[..., 2:]


@pytest.mark.parametrize("kind", ["similarity", "homography"])
def test_a_known_warp_is_undone_to_a_fraction_of_a_pixel(kind: str) -> None:
    matrices = flight(25, kind)
    camera = camera_motion(film(matrices), kind=kind)
    points = np.tile(CORNERS, (25, 1, 1))
    away = np.linalg.norm(camera.undo(points) - seen_from_first(matrices, points), axis=-1)
    assert away.max() < (0.5 if kind == "similarity" else 1.5)
    assert not camera.degenerate.any()
    np.testing.assert_array_equal(camera.to_first[0], np.eye(3))
    np.testing.assert_allclose(camera.redo(camera.undo(points)), points, atol=1e-6)
    if kind == "similarity":
        np.testing.assert_allclose(camera.size(), 1.0 + 0.006 * np.arange(25), rtol=2e-3)


def with_person(frames: list[Frame]) -> tuple[list[Frame], Array]:
    """A large, richly patterned square that goes its own way, as a person nearby does, and its boxes."""
    pattern = np.random.default_rng(0).integers(0, 255, (12, 12, 3)).astype(np.uint8)
    pattern = cv2.resize(pattern, (200, 200), interpolation=cv2.INTER_NEAREST)
    out, boxes = [], []
    for t, frame in enumerate(frames):
        left, top = 20 + 9 * t, 30
        picture = frame.copy()
        picture[top : top + 200, left : left + 200] = pattern[:, : WIDTH - left]
        out.append(picture)
        boxes.append([left, top, left + 200, top + 200])
    return out, np.array(boxes, dtype=np.float64)


def test_a_person_who_moves_otherwise_is_left_out() -> None:
    matrices = flight(20, "similarity")
    matrices[:, :2, :2], matrices[:, :2, 2] = np.eye(2), [200.0, 150.0]  # the camera stands still
    frames, boxes = with_person([(0.35 * f).astype(np.uint8) for f in film(matrices)])
    masked, blind = camera_motion(frames, boxes), camera_motion(frames)
    points = np.tile(CORNERS, (20, 1, 1))
    assert np.linalg.norm(masked.undo(points) - points, axis=-1).max() < 0.3
    # Without the box the square's strong corners carry the camera away: the mask is what helps.
    assert np.linalg.norm(blind.undo(points) - points, axis=-1).max() > 20


def test_frames_that_show_nothing_are_marked_and_hold_the_last_place() -> None:
    matrices = flight(12, "similarity")
    frames = film(matrices)
    frames[6] = np.full_like(frames[6], 128)
    camera = camera_motion(frames)
    # The grey frame tells nothing of itself, nor of the way to the one after it.
    assert np.flatnonzero(camera.degenerate).tolist() == [6, 7]
    np.testing.assert_array_equal(camera.to_first[6], camera.to_first[5])


def test_poses_are_undone_and_say_where_the_camera_is_not_known() -> None:
    matrices = flight(10, "similarity")
    frames = film(matrices)
    frames[4] = np.full_like(frames[4], 128)
    camera = camera_motion(frames)
    pixels = np.full((10, 25, 2), np.nan)
    pixels[:4, :5] = camera.redo(np.tile(CORNERS, (10, 1, 1)))[:4]
    track = PoseTrack(BODY_25, pixels, np.isfinite(pixels[..., 0]).astype(float), 30.0)
    undone = camera.undo_track(track)
    np.testing.assert_allclose(undone.pixels[:4, :5], np.tile(CORNERS, (4, 1, 1)), atol=1e-6)
    assert "2 of 10 frames" in undone.notes[-1]
    np.testing.assert_array_equal(undone.confidence, track.confidence)
    with pytest.raises(ValueError, match="9 of poses"):
        camera.undo_track(PoseTrack(BODY_25, pixels[:9], track.confidence[:9], 30.0))


def test_what_is_no_film_is_refused() -> None:
    frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(InputError, match="similarity, homography"):
        camera_motion([frame], kind="affine")
    with pytest.raises(InputError, match="there are none"):
        camera_motion([])
    with pytest.raises(InputError, match="differs"):
        camera_motion([frame, frame[:-1]])
    with pytest.raises(InputError, match="boxes"):
        camera_motion([frame, frame], np.zeros((1, 4)))
