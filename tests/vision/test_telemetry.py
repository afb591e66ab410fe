"""Telemetry of real cameras: what is read, on which axes, and when."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.telemetry_film import any_telemetry, plain_video, telemetry_folder

from egopose.core.errors import InputError
from egopose.motion.rotations import conjugate, multiply, rotate, to_rotvec
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera
from egopose.vision.telemetry import (
    Samples,
    Telemetry,
    angular_velocity_at,
    camera_from_telemetry,
    down_at,
    image_rotation,
    read_telemetry,
    require_undoable,
)
from egopose.vision.telemetry.axes import to_camera
from egopose.vision.telemetry.clock import Block, sample_times
from egopose.vision.telemetry.lens_fields import across_diagonal, across_width
from egopose.vision.video import read_frames


@pytest.fixture
def folder(shared: Path) -> Path:
    return telemetry_folder(shared)


def known(path: Path) -> Telemetry:
    found = read_telemetry(path)
    assert found is not None
    return found


def rate(samples: Samples | None) -> float:
    assert samples is not None
    return float(1.0 / np.diff(samples.times).mean())


#: File: model, gyroscope's samples and rate, accelerometer's samples, what it has besides.
FILES = [
    ("hero5.raw", "Camera", 399, 398.6, 199, {"gps"}),
    ("hero6.raw", "Hero6 Black", 204, 203.8, 204, {"gps"}),
    ("hero6+ble.raw", "Hero6 Black", 198, 197.8, 198, {"gps"}),
    ("hero7.raw", "Hero7 Black", 3369, 198.4, 3369, {"gps", "readout"}),
    (
        "hero11.raw", "HERO11 Black", 2192, 199.25, 2192,
        {"gps", "gravity", "camera_orientation", "image_orientation", "stabilised"},
    ),
    ("Fusion.raw", "Fusion", 3300, 3296.7, 197, {"gps"}),
    ("karma.raw", "Camera", 392, 391.6, 196, set()),
    ("karma.mp4", "Camera", 4795, 397.2, 2397, set()),
    ("consecutive1.raw", "Hero7 Black", 444, 227.8, 444, {"gps", "readout"}),
    ("consecutive2.raw", "Hero7 Black", 648, 220.3, 648, {"gps", "readout"}),
]  # fmt: skip
BESIDES = (
    "gps",
    "gravity",
    "camera_orientation",
    "image_orientation",
    "stabilised",
    "readout",
    "lens",
    "field_of_view",
)


@pytest.mark.parametrize(("name", "model", "turns", "often", "pushes", "besides"), FILES)
def test_every_camera_is_read(
    folder: Path, name: str, model: str, turns: int, often: float, pushes: int, besides: set[str]
) -> None:
    telemetry = known(folder / name)
    assert telemetry.model == model
    assert telemetry.gyroscope is not None
    assert telemetry.accelerometer is not None
    assert (len(telemetry.gyroscope.times), len(telemetry.accelerometer.times)) == (turns, pushes)
    assert rate(telemetry.gyroscope) == pytest.approx(often, rel=1e-3)
    assert {field for field in BESIDES if getattr(telemetry, field) is not None} == besides
    for samples in (telemetry.gyroscope, telemetry.accelerometer, telemetry.gps):
        assert samples is None or (np.diff(samples.times) > 0).all()
    # Gravity is most of what an accelerometer measures, but for a drone's and a shaken camera's.
    assert 8.0 < np.median(np.linalg.norm(telemetry.accelerometer.values, axis=1)) < 15.0


@pytest.mark.parametrize("name", ["hero5.raw", "hero6.raw", "hero6+ble.raw", "hero11.raw", "Fusion.raw", "karma.mp4"])
def test_a_camera_held_upright_is_pushed_up(folder: Path, name: str) -> None:
    """Five models with four orders of axes: up is minus y in all of them."""
    samples = known(folder / name).accelerometer
    assert samples is not None
    right, down, ahead = samples.values.mean(axis=0)
    assert down < -8.5
    assert abs(down) > 3 * np.hypot(right, ahead)


def test_settings_of_the_film_alone_are_read(folder: Path) -> None:
    telemetry = known(folder / "mp4header.raw")
    assert (telemetry.model, telemetry.lens, telemetry.stabilised) == ("HERO7 Black", "wide", True)
    with pytest.raises(InputError, match=r"mp4header.raw: stabilised: .*HyperSmooth off.*camera.stabilised=ignore"):
        require_undoable(telemetry, folder / "mp4header.raw")


def test_speed_of_the_satellites(folder: Path) -> None:
    gps = known(folder / "hero11.raw").gps
    assert gps is not None
    np.testing.assert_allclose(gps.values[0], [42.4261529, -8.6499795, 34.098, 0.018, 0.01], atol=1e-6)


def test_readout_of_a_hero7(folder: Path) -> None:
    assert known(folder / "hero7.raw").readout == pytest.approx(0.008015, abs=1e-6)


def test_an_outside_reader_finds_the_same_in_a_real_file(folder: Path) -> None:
    outside = pytest.importorskip("telemetry_parser")
    groups = outside.Parser(str(folder / "karma.mp4")).telemetry(human_readable=False)
    telemetry = known(folder / "karma.mp4")
    for key, divisor, samples in (
        ("Gyroscope", 3755, telemetry.gyroscope),
        ("Accelerometer", 418, telemetry.accelerometer),
    ):
        data = [ast.literal_eval(g[key]["Data"]) if isinstance(g[key]["Data"], str) else g[key]["Data"] for g in groups]
        stored = np.array([list(row.values()) for rows in data for row in rows]) / divisor
        assert samples is not None
        np.testing.assert_allclose(samples.values, -stored[:, [1, 0, 2]], atol=1e-12)


def test_the_gyroscope_turns_with_the_picture(folder: Path) -> None:
    """A drone that flies straight on and turns right in its last half second; HERO5, mode M, 94 degrees across."""
    path = folder / "karma.mp4"
    frames = list(read_frames(path))[300:]
    times = np.array([time for time, _ in frames])
    camera = Camera(field_of_view=94.4, lens="fisheye", view=50.0)
    height, width = frames[0][1].shape[:2]
    rectify, view = camera.rectifier(width, height, 64), camera.seen_view(width, height)
    flow = np.stack(list(flow_of_frames((rectify(f) for _, f in frames), FlowConfig("medium", 128, 32))))
    seen = camera_rotation(flow, view)[1:] * 29.97
    measured = angular_velocity_at(known(path), times[1:], 1 / 29.97)
    assert measured[-1, 1] > 0.5
    assert np.corrcoef(seen[:, 1], measured[:, 1])[0, 1] > 0.98
    assert np.polyfit(measured[:, 1], seen[:, 1], 1)[0] == pytest.approx(1.0, abs=0.1)


def test_flight_tells_right_and_ahead(folder: Path) -> None:
    """It speeds up forwards in the first second, and is pushed to the right as it turns right in the last."""
    pushes = known(folder / "karma.mp4").accelerometer
    assert pushes is not None
    assert pushes.values[pushes.times < 1, 2].mean() > 2.0
    assert pushes.values[pushes.times > 12, 0].mean() > 3.0


@pytest.mark.parametrize("name", ["hero7.raw", "consecutive2.raw"])
def test_axes_are_right_handed(folder: Path, name: str) -> None:
    """Carried along by the gyroscope, what the accelerometer feels stays; by the mirrored one it does not."""
    telemetry = known(folder / name)
    assert telemetry.gyroscope is not None
    assert telemetry.accelerometer is not None
    times = np.arange(0.2, telemetry.gyroscope.times[-1] - 0.2, 1 / 30)

    def spread(sign: float) -> float:
        turned = replace(
            telemetry,
            gyroscope=Samples(telemetry.gyroscope.times, sign * telemetry.gyroscope.values),
            readout=None,
        )
        down = down_at(turned, times)
        pushes = telemetry.accelerometer
        felt = np.stack([np.interp(times, pushes.times, column) for column in pushes.values.T], axis=1)
        return float(np.linalg.norm((felt + 9.8 * down).mean(axis=0)))

    assert spread(1.0) < 0.6 * spread(-1.0)


def test_the_cameras_orientation_follows_its_gyroscope(folder: Path) -> None:
    """CORI of HERO11 turns as its gyroscope says; its samples are of the middle row, 8 ms after the stamp."""
    telemetry = replace(known(folder / "hero11.raw"), readout=0.016)
    assert telemetry.camera_orientation is not None
    times = telemetry.camera_orientation.times[1:]
    by_gyroscope = angular_velocity_at(replace(telemetry, accelerometer=None), times, 1 / 25)
    by_orientation = angular_velocity_at(replace(telemetry, gyroscope=None), times, 1 / 25)
    for axis in range(3):
        assert np.corrcoef(by_gyroscope[:, axis], by_orientation[:, axis])[0, 1] > 0.94
    slope = np.linalg.lstsq(by_gyroscope, by_orientation, rcond=None)[0]
    np.testing.assert_allclose(slope, np.eye(3), atol=0.12)


def test_the_orientation_drifts_as_the_gyroscope_does(folder: Path) -> None:
    telemetry = known(folder / "hero11.raw")
    turned, gyroscope = telemetry.camera_orientation, telemetry.gyroscope
    assert turned is not None
    assert gyroscope is not None
    whole = to_rotvec(multiply(conjugate(turned.values[0]), turned.values[-1]))
    inside = (gyroscope.times > turned.times[0]) & (gyroscope.times < turned.times[-1])
    summed = gyroscope.values[inside].sum(axis=0) / rate(gyroscope)
    np.testing.assert_allclose(whole, summed, atol=2e-3)


def test_the_steadied_view_is_steady(folder: Path) -> None:
    telemetry = known(folder / "hero11.raw")
    assert telemetry.camera_orientation is not None
    camera = telemetry.camera_orientation
    picture = image_rotation(telemetry, camera.times)
    assert picture is not None

    def shake(orientation: np.ndarray) -> float:
        turns = to_rotvec(multiply(conjugate(orientation[:-1]), orientation[1:]))
        return float(np.sqrt((np.diff(turns, axis=0) ** 2).mean()))

    assert shake(multiply(camera.values, picture)) < 0.1 * shake(camera.values)
    assert shake(multiply(camera.values, conjugate(picture))) > shake(camera.values)
    require_undoable(telemetry, "hero11.raw")


def test_down_without_the_cameras_own_vector(folder: Path) -> None:
    telemetry = known(folder / "hero11.raw")
    assert telemetry.gravity is not None
    times = telemetry.gravity.times[50:]  # its own vector settles in the first two seconds
    own, ours = down_at(telemetry, times), down_at(replace(telemetry, gravity=None), times)
    angle = np.rad2deg(np.arccos(np.clip((own * ours).sum(axis=1), -1, 1)))
    assert angle.mean() < 0.5
    assert angle.max() < 1.0


def test_a_file_without_telemetry_has_none(tmp_path: Path) -> None:
    assert read_telemetry(plain_video(tmp_path / "plain.mp4", 5)) is None
    (tmp_path / "other.avi").write_bytes(b"RIFF1234AVI ")
    assert read_telemetry(tmp_path / "other.avi") is None
    with pytest.raises(InputError, match="no such file"):
        read_telemetry(tmp_path / "missing.mp4")


@pytest.mark.parametrize(
    ("order", "stored"),
    [("ZXY", [9.8, 1.0, 2.0]), ("YxZ", [2.0, -1.0, 9.8]), ("zXy", [-9.8, 1.0, -2.0])],
)
def test_orders_of_axes(order: str, stored: list[float]) -> None:
    """Z up 9.8, X left 1, Y back 2."""
    np.testing.assert_allclose(to_camera(np.array([stored]), order, "a"), [[-1.0, -9.8, -2.0]])


def test_an_order_without_an_axis_is_refused() -> None:
    with pytest.raises(InputError, match="ORIN"):
        to_camera(np.zeros((1, 3)), "ZXX", "a.mp4")


def test_jitter_of_payloads_does_not_reach_the_samples() -> None:
    """A sensor at 200 Hz, cut into payloads that begin up to 20 ms late or early."""
    true = np.arange(2000) / 200.0
    cuts = np.arange(10) + np.random.default_rng(0).uniform(-0.02, 0.02, 10)
    counts = np.diff(np.append(np.searchsorted(true, cuts[1:]), 2000), prepend=0)
    blocks = [
        Block(k, n, np.zeros((n, 3)), None, t) for k, (n, t) in enumerate(zip(counts, counts.cumsum(), strict=True))
    ]
    times = sample_times(blocks, np.arange(10.0), np.ones(10), None)
    assert np.abs(times - true).max() < 0.02
    np.testing.assert_allclose(np.diff(times), 1 / 200, rtol=0.005)


def test_stamps_are_tied_to_the_first_frame() -> None:
    blocks = [Block(k, 200, np.zeros((200, 3)), 998.0 + k - 0.002, None) for k in range(3)]
    times = sample_times(blocks, np.arange(3.0), np.ones(3), 998.0)
    np.testing.assert_allclose(times, np.arange(600) / 200 - 0.002, atol=1e-9)


@pytest.mark.parametrize("lens", ["linear", "wide", None])
def test_angles_across_width_and_diagonal(lens: str | None) -> None:
    across = across_width(100.0, lens, 1920, 1080)
    assert across_diagonal(across, lens, 1920, 1080) == pytest.approx(100.0)
    if lens == "linear":  # the corner of a flat picture
        focal = 0.5 * np.hypot(1920, 1080) / np.tan(np.deg2rad(50))
        assert across == pytest.approx(np.rad2deg(2 * np.arctan(960 / focal)))


def test_the_users_settings_win() -> None:
    told = Telemetry(field_of_view=92.0, lens="linear", readout=0.015)
    assert camera_from_telemetry(told, Camera()) == Camera(field_of_view=92.0, lens="pinhole", readout=0.015)
    wide = replace(told, lens="wide")
    assert camera_from_telemetry(wide, Camera()).lens == "fisheye"
    own = Camera(field_of_view=118.0, lens="fisheye", readout=0.0)
    assert camera_from_telemetry(told, own) == own
    assert camera_from_telemetry(Telemetry(lens="wide"), Camera()) == Camera()
    assert camera_from_telemetry(wide, Camera(lens="pinhole")).lens == "pinhole"


def test_the_turn_of_a_picture_lies_between_those_of_its_neighbours() -> None:
    telemetry = any_telemetry(0, 30, 30.0)
    turned = telemetry.image_orientation
    assert turned is not None
    exact = image_rotation(telemetry, turned.times)
    assert exact is not None
    np.testing.assert_allclose(np.abs((exact * turned.values).sum(1)), 1.0, atol=1e-9)
    assert image_rotation(Telemetry(), turned.times) is None
    np.testing.assert_allclose(rotate(exact, np.eye(3)[0]), rotate(turned.values, np.eye(3)[0]), atol=1e-9)
