"""Lens, shutter and rate of a real camera against OpenCV's projection and against calculation."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.vision.features import extract_flow
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import read_frames, write_video

FLOW = FlowConfig("medium", 128, 32, 1)
WIDTH, HEIGHT = 640, 480


def projected(camera: Camera, ray: np.ndarray) -> np.ndarray:
    """Where OpenCV's own model of the lens puts a ray, pixels of the frame."""
    focal = camera.focal_length(WIDTH)
    matrix = np.array([[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    none = np.zeros(3)
    if camera.lens == "fisheye":
        k = np.zeros(4)
        k[: len(camera.distortion)] = camera.distortion
        return cv2.fisheye.projectPoints(ray[None, None], none, none, matrix, k)[0].ravel()
    return cv2.projectPoints(ray[None, None], none, none, matrix, np.array(camera.distortion))[0].ravel()


@pytest.mark.parametrize(
    "camera",
    [
        Camera(field_of_view=120.0, lens="fisheye", view=80.0),
        Camera(field_of_view=118.0, lens="fisheye", distortion=(0.05, -0.01), view=80.0),
        Camera(field_of_view=92.0, distortion=(-0.2, 0.05, 0.001, -0.002, 0.0), view=60.0),
    ],
)
def test_rays_land_where_a_pinhole_has_them(camera: Camera) -> None:
    size = 128
    view = camera.seen_view(WIDTH, HEIGHT)
    rectify = camera.rectifier(WIDTH, HEIGHT, size)
    focal = size / np.tan(np.deg2rad(view / 2))
    for direction in ((0.0, 0.0), (0.3, 0.1), (-0.35, 0.3), (0.1, -0.38)):
        x, y = projected(camera, np.array([*direction, 1.0]))
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        cv2.circle(frame, (round(x), round(y)), 7, (255, 255, 255), -1)
        square = rectify(frame)[..., 0].astype(float)
        assert square.shape == (2 * size, 2 * size)
        rows, columns = np.mgrid[: 2 * size, : 2 * size]
        centre = np.array([(square * columns).sum(), (square * rows).sum()]) / square.sum()
        np.testing.assert_allclose(centre, size - 0.5 + focal * np.array(direction), atol=1.2)


def test_the_view_is_no_wider_than_the_lens_shows() -> None:
    wide = Camera(field_of_view=120.0, lens="fisheye")
    # Equidistant: the height of a 4:3 picture sees three quarters of the width's angle.
    assert wide.seen_view(640, 480) == pytest.approx(90.0, abs=0.2)
    narrow = Camera(field_of_view=60.0)
    assert narrow.seen_view(640, 640) == pytest.approx(60.0, abs=0.2)
    assert Camera(field_of_view=140.0, lens="fisheye").seen_view(640, 640) == pytest.approx(102.5)


def scrolling(readout: float, speed: float, count: int = 4) -> list[np.ndarray]:
    """A texture that falls by ``speed`` picture heights a frame (30 a second), row r exposed r/128 * readout late."""
    rng = np.random.default_rng(0)
    tall = sum(cv2.resize(rng.random((n * 4, n)), (128, 512), interpolation=cv2.INTER_CUBIC) for n in (8, 24, 60))
    tall = ((tall - tall.min()) / np.ptp(tall) * 255).astype(np.float32)
    rows, columns = np.mgrid[:128, :128].astype(np.float32)
    frames = []
    for number in range(count):
        late = number + rows / 128 * readout * 30
        seen = cv2.remap(tall, columns, (rows + 200 - late * speed * 128).astype(np.float32), cv2.INTER_LINEAR)
        frames.append(np.repeat(seen.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2))
    return frames


@pytest.mark.parametrize("speed", [0.05, -0.05])
def test_the_rolling_shutter_is_undone(speed: float) -> None:
    readout = 0.02
    flow = list(flow_of_frames(scrolling(readout, speed), FLOW))[2][None].astype(float)
    middle = np.median(flow[0, 1, 8:-8, 8:-8])
    # A row further down is later: what falls at v seems to fall at v / (1 - v * readout * fps).
    assert middle == pytest.approx(speed / (1 - speed * readout * 30), abs=4e-4)
    corrected = undo_rolling_shutter(flow, readout, 1 / 30)
    assert np.median(corrected[0, 1, 8:-8, 8:-8].astype(float)) == pytest.approx(speed, abs=4e-4)


def test_flow_of_a_file_takes_the_camera_into_account(tmp_path: Path) -> None:
    path = tmp_path / "fall.mp4"
    write_video(path, scrolling(0.02, 0.05, 8), 30)
    plain = extract_flow(path, FLOW, count=6)
    same = extract_flow(path, FLOW, count=6, camera=Camera())
    np.testing.assert_array_equal(plain, same)
    rolled = extract_flow(path, FLOW, count=6, camera=Camera(readout=0.02))
    assert np.median(rolled[3, 1]) < np.median(plain[3, 1])
    # Through a lens that sees less than the picture's 90 degrees, the same fall crosses more of the picture.
    zoomed = extract_flow(path, FLOW, count=6, camera=Camera(field_of_view=90.0, view=53.13))
    assert np.median(zoomed[3, 1].astype(float)) == pytest.approx(2 * np.median(plain[3, 1].astype(float)), rel=0.1)


def test_the_cameras_own_rate_replaces_the_stamps(tmp_path: Path) -> None:
    path = tmp_path / "slow.mp4"
    write_video(path, scrolling(0.0, 0.02, 9), 30)
    np.testing.assert_allclose([t for t, _ in read_frames(path, 240.0)], np.arange(9) / 240)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"lens": "fisheye"}, "field_of_view"),
        ({"field_of_view": 175.0}, "field_of_view"),
        ({"field_of_view": 90.0, "distortion": [1.0] * 6}, "distortion"),
        ({"view": 0.0}, "view"),
        ({"fps": 0.0}, "fps"),
        ({"focus": 1}, "focus"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(values: dict, field: str) -> None:
    with pytest.raises(InputError, match=field):
        Camera.from_mapping(values, "data.takes[0].camera")


def test_a_distortion_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(InputError, match="folds the picture"):
        Camera(field_of_view=120.0, lens="fisheye", distortion=(-2.0,)).rectifier(640, 480, 128)
