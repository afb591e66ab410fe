"""Sensor tables of the user's own and Aria's trajectory."""

from __future__ import annotations

import lzma
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.telemetry_film import telemetry_folder
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.motion.rotations import conjugate, from_rotvec, rotate
from egopose.vision.telemetry import (
    ARIA_RGB_MOUNT,
    angular_velocity_at,
    down_at,
    read_aria_trajectory,
    read_imu_csv,
)

ROWS = "0.00,1,2,3,0.1,-9.8,0.2\n0.01,1,2,3,0.1,-9.8,0.2\n0.02,4,5,6,0.1,-9.8,0.2\n"
HEADER = "time_s,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n"


def table(folder: Path, text: str) -> Path:
    path = folder / "imu.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("header", "times"),
    [
        ("time_s,gyro_x,gyro_y,gyro_z", 1.0),
        ("t,w_x,w_y,w_z", 1.0),
        ("Timestamp [ms],Gyroscope X (rad/s),Gyroscope Y (rad/s),Gyroscope Z (rad/s)", 1e-3),
        ("timestamp_us,GyroX,GyroY,GyroZ", 1e-6),
        ("time(ns),angular_velocity_x,angular_velocity_y,angular_velocity_z", 1e-9),
    ],
)
def test_names_and_units_of_columns(tmp_path: Path, header: str, times: float) -> None:
    stamps = (5.0 + np.arange(3) * 0.01) / times
    rows = "".join(f"{round(stamp) if times < 1 else stamp},1,2,{k}\n" for k, stamp in enumerate(stamps.tolist()))
    found = read_imu_csv(table(tmp_path, f"{header}\n{rows}"))
    assert found.gyroscope is not None
    assert found.accelerometer is None
    np.testing.assert_allclose(found.gyroscope.times, [0, 0.01, 0.02], atol=1e-9)
    np.testing.assert_allclose(found.gyroscope.values, [[1, 2, 0], [1, 2, 1], [1, 2, 2]])


def test_degrees_g_and_the_videos_beginning(tmp_path: Path) -> None:
    text = "t;gyro_x_deg;gyro_y_deg;gyro_z_deg;acc_x [g];acc_y [g];acc_z [g]\n1;180;0;0;0;-1;0\n1.01;90;0;0;0;-1;0\n"
    found = read_imu_csv(table(tmp_path, text), video_start=0.5)
    assert found.gyroscope is not None
    assert found.accelerometer is not None
    np.testing.assert_allclose(found.gyroscope.values[:, 0], [np.pi, np.pi / 2])
    np.testing.assert_allclose(found.accelerometer.values[0], [0, -9.80665, 0])
    np.testing.assert_allclose(found.gyroscope.times, [0.5, 0.51])


@settings(max_examples=20, deadline=None)
@given(turn=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_the_mount_turns_sensor_axes_to_the_cameras(
    tmp_path_factory: pytest.TempPathFactory, turn: list[float]
) -> None:
    path = table(tmp_path_factory.mktemp("mount"), HEADER + ROWS)
    mount = from_rotvec(np.array(turn))
    plain, turned = read_imu_csv(path), read_imu_csv(path, mount)
    for name in ("gyroscope", "accelerometer"):
        in_camera = getattr(turned, name).values
        np.testing.assert_allclose(rotate(mount, in_camera), getattr(plain, name).values, atol=1e-9)


def test_orientation_and_place(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    text = f"t,qw,qx,qy,qz,px,py,pz\n0,{half},{-half},0,0,1,2,3\n0.1,{half},{-half},0,0,1,2,4\n"
    found = read_imu_csv(table(tmp_path, text))
    assert found.trajectory is not None
    assert found.trajectory.position is not None
    np.testing.assert_allclose(found.trajectory.position[1], [1, 2, 4])
    # This sensor looks along the world's y, and is level.
    np.testing.assert_allclose(rotate(found.trajectory.orientation[0], np.array([0, 0, 1.0])), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(down_at(found, np.array([0.05])), [[0, 1, 0]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("gyro_x,gyro_y,gyro_z\n1,2,3\n", "time: 0 columns of time"),
        ("t,time_ms,gyro_x,gyro_y,gyro_z\n", "time: 2 columns of time"),
        ("time_h,gyro_x,gyro_y,gyro_z\n", "time_h: no unit of time: h"),
        ("t,gyro_x,gyro_z\n1,2,3\n", "gyroscope y: is missing"),
        ("t,a_x,a_y,a_z\n1,2,3,4\n", "gyro_x: is missing"),
        ("t,gyro_x,gyro_y,gyro_z,gyr_x\n", "gyr_x: a second column of gyroscope x"),
        (HEADER + ROWS.replace("4,5,6", "4,five,6"), "gyro_y: row 4: no number: 'five'"),
        (HEADER + ROWS.replace("4,5,6", "4,nan,6"), "gyro_y: row 4: not a finite number"),
        (HEADER + ROWS + "0.03,1\n", "row 5: 2 columns"),
        (HEADER + ROWS + "0.01,1,2,3,0,0,0\n", "time_s: row 5: the time does not rise"),
        (HEADER + ROWS.replace("0.00", "100").replace("0.01", "200").replace("0.02", "300"), "name the unit of time"),
        (HEADER, "rows: 0"),
        ("", "line 1: no header"),
        ("\x00\x01\x02\n", "line 1: no header"),
        ("t,qw,qx,qy,qz\n0,2,0,0,0\n0.1,2,0,0,0\n", "qw: row 2: a quaternion of length 2"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_a_faulty_table_says_where(tmp_path: Path, text: str, cause: str) -> None:
    path = table(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_imu_csv(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert cause in str(caught.value)


def test_a_mount_must_be_a_turn(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="mount"):
        read_imu_csv(table(tmp_path, HEADER + ROWS), (1.0, 1.0, 0.0, 0.0))


@pytest.fixture
def aria(shared: Path, tmp_path: Path) -> Path:
    """Eleven seconds of a head at 1 kHz."""
    packed = telemetry_folder(shared) / "aria_mps_closed_loop_trajectory.csv.xz"
    path = tmp_path / "closed_loop_trajectory.csv"
    path.write_bytes(lzma.decompress(packed.read_bytes()))
    return path


def test_arias_way(aria: Path) -> None:
    found = read_aria_trajectory(aria)
    assert found.gyroscope is not None
    assert found.trajectory is not None
    assert found.trajectory.position is not None
    assert len(found.gyroscope.times) == 11517
    assert np.diff(found.gyroscope.times).mean() == pytest.approx(1e-3, rel=0.02)
    # Its poses turn as its angular velocity says, in the camera's axes too.
    frames = np.arange(0.5, 11, 1 / 30)
    measured, placed = (angular_velocity_at(t, frames, 1 / 30) for t in (found, replace(found, gyroscope=None)))
    for axis in range(3):
        assert np.corrcoef(measured[:, axis], placed[:, axis])[0, 1] > 0.999
    np.testing.assert_allclose(down_at(found, frames), down_at(replace(found, gravity=None), frames), atol=1e-5)


def test_arias_camera_is_upright_on_a_head(aria: Path) -> None:
    down = down_at(read_aria_trajectory(aria), np.arange(0.5, 11, 0.1))
    right, below, ahead = down.mean(axis=0)
    assert below > 0.9
    assert abs(right) < 0.1
    assert 0.0 < ahead < 0.5  # a head looks down a little
    # The RGB camera looks to the right of the device, the left SLAM camera, by 38 degrees: towards minus y.
    axis = rotate(np.array(ARIA_RGB_MOUNT), np.array([0.0, 0.0, 1.0]))
    assert np.rad2deg(np.arctan2(-axis[1], axis[2])) == pytest.approx(38, abs=2)
    device = read_aria_trajectory(aria, (1.0, 0.0, 0.0, 0.0))
    assert device.gravity is not None
    np.testing.assert_allclose(device.gravity.values.mean(axis=0), [0.98, 0, 0.1], atol=0.1)


def test_aria_errors_name_column_and_row(aria: Path) -> None:
    lines = aria.read_text().splitlines()
    aria.write_text("\n".join([lines[0].replace("qx_world_device", "qx"), *lines[1:4]]) + "\n")
    with pytest.raises(InputError, match="qx_world_device: 0 columns"):
        read_aria_trajectory(aria)
    cells = lines[2].split(",")
    cells[lines[0].split(",").index("ty_world_device")] = "?"
    aria.write_text("\n".join([*lines[:2], ",".join(cells), lines[3]]) + "\n")
    with pytest.raises(InputError, match=r"ty_world_device: row 3: no number"):
        read_aria_trajectory(aria)


def test_conjugate_of_the_mount_undoes_it() -> None:
    mount = np.array(ARIA_RGB_MOUNT)
    np.testing.assert_allclose(rotate(conjugate(mount), np.array([1.0, 0, 0])), [0, 1, 0], atol=0.2)
