"""A steadied film turned back: a far textured wall seen by a camera that shakes, steadied as a camera would."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, conjugate, from_rotvec, multiply, rotate, to_matrix, to_rotvec
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera
from egopose.vision.stabilisation import as_the_camera_saw
from egopose.vision.telemetry import Samples, Telemetry, read_telemetry, write_gpmf_mp4
from egopose.vision.video import read_frames, write_video

WIDTH, HEIGHT, FPS, FRAMES = 320, 240, 30.0, 40
TIMES = np.arange(FRAMES) / FPS
FLOW = FlowConfig("medium", 128, 32)
CAMERA = Camera(field_of_view=95.0, lens="fisheye", view=45.0)


def wall() -> np.ndarray:
    """A texture that fills 160 degrees: its pixel at angle a from the middle lies at radius tan(a)."""
    rng = np.random.default_rng(2)
    size = 1600
    out = sum(cv2.resize(rng.random((n, n)), (size, size), interpolation=cv2.INTER_CUBIC) for n in (60, 150, 400))
    return ((out - out.min()) / np.ptp(out) * 255).astype(np.uint8)


def pictures(lens: Camera, orientation: Array) -> list[np.ndarray]:
    """What a camera sees whose picture is turned so, ``[T, 4]`` from picture to the wall's axes."""
    texture = wall()
    focal = lens.focal_length(WIDTH)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    x, y = (columns - (WIDTH - 1) / 2) / focal, (rows - (HEIGHT - 1) / 2) / focal
    angle = np.hypot(x, y)  # equidistant
    sine = np.where(angle > 1e-9, np.sin(angle) / np.maximum(angle, 1e-9), 1.0)
    rays = np.stack([x * sine, y * sine, np.cos(angle)], axis=-1)
    out = []
    for turn in orientation:
        seen = rays @ to_matrix(turn).T
        across, down = (260.0 * seen[..., k] / np.maximum(seen[..., 2], 0.05) + 800.0 for k in (0, 1))
        grey = cv2.remap(texture, across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR)
        out.append(np.repeat(grey[..., None], 3, axis=2))
    return out


def shaken() -> Array:
    """A head: quick small turns about all axes, ``[T, 4]`` from camera to the wall's axes."""
    angles = [
        0.10 * np.sin(2 * np.pi * 1.9 * TIMES),
        0.14 * np.sin(2 * np.pi * 1.1 * TIMES + 1),
        0.08 * np.sin(9 * TIMES),
    ]
    return from_rotvec(np.stack(angles, axis=1))


def turning(orientation: Array) -> Array:
    return to_rotvec(multiply(conjugate(orientation[:-1]), orientation[1:]))


def of_flow(squares: list[np.ndarray], view: float) -> Array:
    return camera_rotation(np.stack(list(flow_of_frames(squares, FLOW))), view)[1:]


@pytest.fixture(scope="module")
def steadied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film whose pictures slowly pan while the camera shakes, with what the camera tells of it."""
    camera = shaken()
    view = from_rotvec(np.stack([0 * TIMES, 0.1 * TIMES, 0 * TIMES], axis=1))
    turned = multiply(conjugate(camera), view)
    folder = tmp_path_factory.mktemp("steadied")
    write_video(folder / "plain.mp4", pictures(CAMERA, multiply(camera, turned)), FPS)
    told = Telemetry(
        camera_orientation=Samples(TIMES, camera), image_orientation=Samples(TIMES, turned), stabilised=True
    )
    write_gpmf_mp4(folder / "plain.mp4", folder / "film.mp4", told, FPS)
    return folder / "film.mp4"


def test_the_flow_tells_the_cameras_turns_once_undone(steadied: Path) -> None:
    telemetry = read_telemetry(steadied)
    assert telemetry is not None
    assert telemetry.stabilised
    true, seen = turning(shaken()), CAMERA.seen_view(WIDTH, HEIGHT)
    assert seen == pytest.approx(45.0)
    undone, ignored = (
        list(as_the_camera_saw(read_frames(steadied), telemetry, camera, 64, steadied))
        for camera in (CAMERA, replace(CAMERA, stabilised="ignore"))
    )
    right, wrong = (of_flow([square for _, square, _ in film], seen) for film in (undone, ignored))
    for axis in range(3):
        assert np.corrcoef(right[:, axis], true[:, axis])[0, 1] > 0.99
        assert abs(np.corrcoef(wrong[:, axis], true[:, axis])[0, 1]) < 0.5
    assert np.sqrt(((right - true) ** 2).mean()) < 0.1 * np.sqrt((true**2).mean())
    assert np.sqrt(((wrong - true) ** 2).mean()) > 0.8 * np.sqrt((true**2).mean())


def test_the_picture_is_the_cameras_own(steadied: Path) -> None:
    """Turned back, each square is what a camera without steadying films."""
    telemetry = read_telemetry(steadied)
    assert telemetry is not None
    undone = [square for _, square, _ in as_the_camera_saw(read_frames(steadied), telemetry, CAMERA, 64, steadied)]
    rectify = CAMERA.rectifier(WIDTH, HEIGHT, 64)
    for number in (0, 7, 23, 39):
        own = rectify(pictures(CAMERA, shaken()[number : number + 1])[0]).astype(float)
        assert np.abs(undone[number] - own).mean() < 8  # of 256: sampled twice, and packed
        assert np.corrcoef(undone[number].ravel(), own.ravel())[0, 1] > 0.97


def test_what_the_film_has_no_picture_of_is_told() -> None:
    camera = Camera(field_of_view=60.0, view=50.0)
    rectify = camera.turning_rectifier(320, 240, 32)
    frame = np.full((240, 320, 3), 200, np.uint8)
    square, inside = rectify(frame, np.array([1.0, 0.0, 0.0, 0.0]))
    assert square.shape == (64, 64, 3)
    assert inside.all()
    # A picture turned 20 degrees to the right of the camera lacks the camera's left.
    turn = from_rotvec(np.array([0.0, np.deg2rad(20), 0.0]))
    assert rotate(turn, np.array([0.0, 0.0, 1.0]))[0] > 0
    square, inside = rectify(frame, turn)
    assert not inside[:, :8].any()
    assert inside[32, 40:].all()
    # Its left edge is at 20 - 30 degrees from the axis.
    focal = 32 / np.tan(np.deg2rad(camera.seen_view(320, 240) / 2))
    edge = 31.5 + focal * np.tan(np.deg2rad(20 - 30))
    assert np.argmax(inside[32]) == pytest.approx(edge, abs=1.5)
    assert (square == 200).all()  # the edge goes on


def test_an_unturned_picture_is_rectified_as_ever() -> None:
    frame = pictures(CAMERA, shaken()[:1])[0]
    square, inside = CAMERA.turning_rectifier(WIDTH, HEIGHT, 64)(frame, np.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(square, CAMERA.rectifier(WIDTH, HEIGHT, 64)(frame))
    assert inside.all()


def test_what_cannot_be_undone_is_refused(steadied: Path) -> None:
    frames = [(0.0, np.zeros((HEIGHT, WIDTH, 3), np.uint8))]
    blind = Telemetry(stabilised=True)
    with pytest.raises(InputError, match=r"film.mp4: stabilised: .* camera.stabilised=ignore"):
        list(as_the_camera_saw(frames, blind, CAMERA, 64, steadied))
    assert len(list(as_the_camera_saw(frames, blind, replace(CAMERA, stabilised="ignore"), 64, steadied))) == 1
    with pytest.raises(InputError, match="camera: field_of_view: is missing"):
        list(as_the_camera_saw(frames, Telemetry(), Camera(), 64, steadied))
    with pytest.raises(InputError, match="stabilised: 'perhaps'"):
        Camera(stabilised="perhaps")
