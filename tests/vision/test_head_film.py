"""Films to rows of flow and to head signals: rates, steadied pictures, lenses and sensors beside the film."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.seen_ground import walk

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, from_rotvec
from egopose.vision.head_film import (
    UNKNOWN_VIEW,
    HeadRow,
    WornCamera,
    film_camera,
    head_rows,
    head_signal_of_rows,
    read_head_signal,
    telemetry_of,
)
from egopose.vision.lens import Camera
from egopose.vision.telemetry import Samples, Telemetry, write_gpmf_mp4
from egopose.vision.video import Frame, write_video

VIEW, WIDTH, HEIGHT, PITCH = 75.0, 240, 180, 45.0
CAMERA, WORN = Camera(field_of_view=VIEW), WornCamera(pitch_down=PITCH)
SPEED = 1.2


def texture() -> Array:
    """A floor of 10 by 10 m, 50 pixels a metre, with grain of several sizes."""
    rng = np.random.default_rng(0)
    sizes = (40, 120, 250)
    grain = sum(
        cv2.resize(rng.random((n, n)).astype(np.float32), (500, 500), interpolation=cv2.INTER_CUBIC) for n in sizes
    )
    return np.asarray(255 * (grain - grain.min()) / np.ptp(grain), dtype=np.float32)  # type: ignore[arg-type]


def frames_of(positions: Array, rotations: Array) -> list[Frame]:
    """What a pinhole sees of the textured floor: every pixel's ray goes to the floor."""
    floor, focal = texture(), 0.5 * WIDTH / np.tan(np.deg2rad(VIEW / 2))
    across, down = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    rays = np.stack([across, down, np.full_like(across, focal)], axis=-1) / focal
    out = []
    for at, turned in zip(positions, rotations, strict=True):
        world = rays @ turned.T
        place = at[:2] + world[..., :2] * (at[2] / -world[..., 2:])
        pixel = (50 * (place + np.array([2.0, 5.0]))).astype(np.float32)
        grey = cv2.remap(floor, pixel[..., 0], pixel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        out.append(np.repeat(grey.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2))
    return out


def walked(path: Path, fps: float, seconds: float = 1.0, turn: float = 0.0) -> Path:
    write_video(path, frames_of(*walk(seconds, fps, SPEED, np.deg2rad(PITCH), bob=0.0, turn=turn)), fps)
    return path


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return walked(tmp_path_factory.mktemp("film") / "walk.mp4", 30.0)


def rows_of(video: Path, camera: Camera = CAMERA, telemetry: Telemetry | None = None) -> list[HeadRow]:
    return list(head_rows(video, 30.0, 0.0, film_camera(video, camera, telemetry)[0], telemetry))


def test_a_walk_over_a_floor(film: Path) -> None:
    rows = rows_of(film)
    assert len(rows) == 30
    assert rows[0].flow.shape == (2, 18, 24)
    assert all(np.isfinite(row.flow).all() for row in rows)
    np.testing.assert_array_equal(rows[0].flow, 0.0)
    assert rows[3].view == pytest.approx(VIEW, abs=0.2)
    signal = read_head_signal(film, 30.0, CAMERA, WORN)
    np.testing.assert_allclose(signal.velocity[2:].mean(0), [SPEED / 1.6, 0.0, 0.0], atol=0.05)
    assert np.abs(signal.turning[2:].mean(0)).max() < 0.03
    assert signal.quality[2:].min() > 0.7
    np.testing.assert_allclose(np.rad2deg(signal.tilt[:, 0]), PITCH, atol=3.0)


def test_a_turn_to_the_left_is_one(tmp_path: Path) -> None:
    signal = read_head_signal(walked(tmp_path / "turn.mp4", 30.0, 0.6, turn=0.6), 30.0, CAMERA, WORN)
    assert signal.turning[2:, 2].mean() == pytest.approx(0.6, abs=0.06)


@pytest.mark.parametrize("rate", [25.0, 60.0])
def test_films_of_other_rates_keep_their_speed(tmp_path: Path, rate: float) -> None:
    rows = rows_of(walked(tmp_path / "walk.mp4", rate))
    assert len(rows) == pytest.approx(30, abs=1)
    repeats = [k for k in range(1, len(rows)) if rows[k] is rows[k - 1]]
    if rate < 30:
        assert len(repeats) == 5  # of 30 frames of motion 25 are filmed
        assert {round(row.interval, 3) for row in rows[2:]} == {0.04}
    else:
        assert not repeats
        np.testing.assert_allclose([row.interval for row in rows[1:]], 1 / 30, atol=1e-3)
    signal = head_signal_of_rows(rows, CAMERA, None, WORN)
    np.testing.assert_allclose(signal.velocity[2:, 0], SPEED / 1.6, atol=0.12)


def test_the_offset_skips_and_the_count_ends(film: Path) -> None:
    rows = list(head_rows(film, 30.0, 0.2, CAMERA, None, count=10))
    assert len(rows) == 10
    assert rows[0].time == pytest.approx(0.2, abs=0.01)
    shown: list[Frame] = []
    assert len(list(head_rows(film, 30.0, 0.0, CAMERA, None, shown.append))) == len(shown) == 30


def steadied(folder: Path, rate: float) -> tuple[Path, Telemetry]:
    """A picture that stands still while its camera turns right at ``rate`` rad/s."""
    positions, rotations = walk(0.5, 30.0, 0.0, np.deg2rad(PITCH), bob=0.0)
    write_video(folder / "plain.mp4", frames_of(positions, rotations), 30.0)
    times = np.arange(15) / 30.0
    turned = np.column_stack([np.zeros(15), -rate * times, np.zeros(15)])
    told = Telemetry(
        model="HERO11 Black",
        image_orientation=Samples(times, from_rotvec(turned)),
        field_of_view=VIEW,
        lens="linear",
        stabilised=True,
    )
    write_gpmf_mp4(folder / "plain.mp4", folder / "steady.mp4", told, 30.0)
    return folder / "steady.mp4", told


def test_what_a_camera_steadied_is_undone_and_the_edge_is_left_out(tmp_path: Path) -> None:
    video, _ = steadied(tmp_path, 0.6)
    told = telemetry_of(video, WORN)
    assert told is not None
    rows = rows_of(video, Camera(), told)
    # At the film's end the camera looks 16 degrees to the right of the picture: the right edge shows nothing.
    hidden = np.isnan(rows[-1].flow).all(axis=(0, 1))
    assert hidden[-1]
    assert not np.isnan(rows[-1].flow[:, :, :10]).any()
    signal = head_signal_of_rows(rows, film_camera(video, Camera(), told)[0], None, WORN)
    # About the camera's y axis, which is not the vertical: a part of it rolls.
    np.testing.assert_allclose(np.linalg.norm(signal.turning[3:], axis=1), 0.6, atol=0.1)
    assert signal.turning[3:, 2].max() < -0.2
    left = rows_of(video, Camera(stabilised="ignore"), told)
    assert np.isfinite(left[-1].flow).all()
    assert np.abs(left[-1].flow).max() < 2e-3


def test_a_steadied_film_that_nothing_undoes_is_refused() -> None:
    told = Telemetry(model="HERO11 Black", stabilised=True)
    with pytest.raises(InputError, match="stabilised"):
        film_camera("film.mp4", Camera(), told)
    film_camera("film.mp4", Camera(stabilised="ignore"), told)


def test_a_field_of_view_that_nobody_knows_is_guessed_and_said() -> None:
    camera, guessed = film_camera("film.mp4", Camera(), None)
    assert (camera.field_of_view, guessed) == (UNKNOWN_VIEW, True)
    camera, guessed = film_camera("film.mp4", CAMERA, None)
    assert (camera, guessed) == (CAMERA, False)
    camera, guessed = film_camera("film.mp4", Camera(), Telemetry("", field_of_view=93.0, lens="linear"))
    assert (camera.field_of_view, guessed) == (93.0, False)


def sensors(path: Path, pitch: float, seconds: float = 1.2) -> Path:
    """A table of a camera that rests with its axis ``pitch`` degrees below the horizon."""
    up = -9.81 * np.array([0.0, np.cos(np.deg2rad(pitch)), np.sin(np.deg2rad(pitch))])
    rows = [f"{k / 100},0,0,0,{up[0]:.6f},{up[1]:.6f},{up[2]:.6f}\n" for k in range(round(100 * seconds))]
    path.write_text("time_s,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n" + "".join(rows))
    return path


def test_a_sensors_table_beside_the_film_tells_the_vertical(film: Path, tmp_path: Path) -> None:
    table = sensors(tmp_path / "imu.csv", PITCH)
    signal = read_head_signal(film, 30.0, CAMERA, WornCamera(telemetry=str(table)))
    np.testing.assert_allclose(np.rad2deg(signal.tilt), [[PITCH, 0.0]] * 30, atol=0.1)
    assert signal.quality[1:, 0].min() > 0.9  # the picture turns as the table says
    assert signal.velocity[2:, 0].mean() == pytest.approx(SPEED / 1.6, abs=0.05)
    # The table is believed even where it is wrong: nothing else was asked for.
    wrong = read_head_signal(film, 30.0, CAMERA, WornCamera(telemetry=str(sensors(tmp_path / "other.csv", 30.0))))
    np.testing.assert_allclose(np.rad2deg(wrong.tilt[:, 0]), 30.0, atol=0.1)


def test_a_table_keeps_what_the_file_says_of_its_lens(tmp_path: Path) -> None:
    video, _ = steadied(tmp_path, 0.2)
    told = telemetry_of(video, WornCamera(telemetry=str(sensors(tmp_path / "imu.csv", PITCH))))
    assert told is not None
    assert told.gyroscope is not None
    assert told.image_orientation is not None
    assert (told.field_of_view, told.stabilised) == (pytest.approx(VIEW, abs=0.1), True)


def test_tables_that_cannot_be_used_are_named(film: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv"):
        telemetry_of(film, WornCamera(telemetry=str(tmp_path / "none.csv")))
    short = sensors(tmp_path / "short.csv", PITCH, seconds=0.2)
    with pytest.raises(InputError, match="before what is asked"):
        read_head_signal(film, 30.0, CAMERA, WornCamera(telemetry=str(short)))


@pytest.mark.parametrize(
    ("field", "value"),
    [("mount", "knee"), ("pitch_down", 95.0), ("height", 0.1), ("height", 4.0), ("pitch_down", -70.0)],
)
def test_a_way_to_wear_a_camera_that_cannot_be_is_refused(field: str, value: str | float) -> None:
    with pytest.raises(InputError, match=field):
        WornCamera(**{field: value})
