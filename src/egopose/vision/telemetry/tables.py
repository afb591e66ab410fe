"""Telemetry from tables: a sensor of the user's own, and the way of Aria glasses as Meta's MPS gives it.

A sensor's axes are seldom the camera's. ``mount`` says how the two are turned against each other: the quaternion that
takes a direction in camera axes (x right, y down, z ahead) to the sensor's. Its columns as a matrix are the camera's
right, down and ahead, as the sensor has them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, between, conjugate, continuous, multiply, normalize, rotate
from egopose.vision.telemetry.samples import Samples, Telemetry, Trajectory

#: Axes of the sensor are the camera's.
UNTURNED = (1.0, 0.0, 0.0, 0.0)
#: How the RGB camera of Aria sits in its device axes, with pictures turned upright (90 degrees clockwise). The device
#: is the left SLAM camera, whose x is down, and which looks 38 degrees to the left of the RGB camera. The numbers are
#: one device's factory calibration, T_Device_Camera (w .9443, x .3241, y .0402, z .0411), times the quarter turn; of
#: another device ``online_calibration.jsonl`` has them.
ARIA_RGB_MOUNT = tuple(
    multiply(normalize(np.array([0.944261, 0.32414, 0.0402123, 0.0410768])), np.array([0.5, 0.0, 0.0, -0.5]) * 2**0.5)
    .round(6)
    .tolist()
)

_MAX_BYTES = 2**30
_MAX_ROWS = 20_000_000
_MAX_HEADER = 2**16
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_LETTERS = "xyz"
_AXIS = r"[ _.]*([xyzw])(?![a-z])"
_PATTERNS = {
    "gyroscope": re.compile(r"^(?:gyroscope|gyro|gyr|angular[ _]?velocity|omega|w)" + _AXIS),
    "accelerometer": re.compile(r"^(?:accelerometer|acceleration|accel|acc|a)" + _AXIS),
    "orientation": re.compile(r"^(?:quaternion|quat|orientation|rotation|q)" + _AXIS),
    "position": re.compile(r"^(?:position|pos|p|t)" + _AXIS),
}
_TIME = re.compile(r"^(?:time|timestamp|t)(?![a-z])[ _]*(?:stamp)?[ _\[(]*([a-zµ]*)[\])]*$")


def read_imu_csv(
    path: str | PathLike[str], mount: Sequence[float] = UNTURNED, video_start: float | None = None
) -> Telemetry:
    """A table of a sensor that is fixed to the camera, one row a sample.

    The first line names the columns, whatever their order: a time with its unit (``time_s``, ``timestamp [ns]``; ``t``
    alone is in s), ``gyro_x gyro_y gyro_z`` in rad/s, or with ``deg`` or ``dps`` in the name in deg/s. Optional are
    ``accel_x ...`` in m/s^2 (``g`` as the unit: in g), ``q_w q_x q_y q_z`` (sensor axes to a world with z up), and
    ``position_x ...`` in m. Columns are apart by commas, semicolons or tabs.

    Args:
        path: the file.
        mount: ``[4]`` wxyz, from camera axes to the sensor's.
        video_start: the sensor's time (s) of the video's first frame; None: the first row's.

    Raises:
        InputError: a column is missing or there twice, a cell is no number, times do not rise; names column and row.
    """
    names, separator = _header(path)
    low = [name.lower() for name in names]
    times = [(k, match[1]) for k, name in enumerate(low) if (match := _TIME.match(name))]
    if len(times) != 1:
        raise InputError(path, "time", f"{len(times)} columns of time; expected one, such as time_s or timestamp [ns]")
    unit = _SECONDS.get(times[0][1] or "s")
    if unit is None:
        raise InputError(path, names[times[0][0]], f"no unit of time: {times[0][1]}; there are s, ms, us, ns")
    columns = {kind: _columns(path, names, kind) for kind in _PATTERNS}
    if columns["gyroscope"] is None and columns["orientation"] is None:
        raise InputError(path, "gyro_x", "is missing: neither a gyroscope nor an orientation")
    wanted = [times[0][0], *(c for found in columns.values() for c in found or ())]
    table = dict(zip(wanted, _table(path, names, separator, wanted).T, strict=True))
    seconds = table[times[0][0]] * unit
    _check_times(path, names[times[0][0]], seconds)
    seconds = seconds - (seconds[0] if video_start is None else video_start)
    turn = _mount(path, mount)

    def samples(kind: str) -> Samples | None:
        found = columns[kind]
        if found is None:
            return None
        values = np.stack([table[c] for c in found], axis=1) * _unit(low[found[0]], kind)
        return Samples(seconds, rotate(conjugate(turn), values))

    trajectory = None
    if columns["orientation"] is not None:
        placed = columns["position"]
        position = None if placed is None else np.stack([table[c] for c in placed], axis=1)
        quaternions = np.stack([table[c] for c in columns["orientation"]], axis=1)
        trajectory = _trajectory(path, names[columns["orientation"][0]], seconds, position, quaternions, turn)
    return Telemetry("", samples("gyroscope"), samples("accelerometer"), trajectory=trajectory)


def read_aria_trajectory(
    path: str | PathLike[str], mount: Sequence[float] = ARIA_RGB_MOUNT, video_start: float | None = None
) -> Telemetry:
    """``closed_loop_trajectory.csv`` of Project Aria's Machine Perception Services: the device's way, at 1 kHz.

    Its poses are of the device, the left SLAM camera: x down, y left, z ahead and to the left. A file must be of one
    world (one ``graph_uid``). Columns: facebookresearch.github.io/projectaria_tools, *MPS output - Trajectory*.

    Args:
        path: the file.
        mount: ``[4]`` wxyz, from camera axes to the device's; unless said, of the RGB camera with upright pictures.
        video_start: device time (s) of the video's first frame; None: the first row's.

    Returns:
        Gyroscope, gravity and trajectory of the camera.

    Raises:
        InputError: a column is missing, a cell is no number, times do not rise; names column and row.
    """
    names, separator = _header(path)
    groups = [
        ["tracking_timestamp_us"],
        [f"t{a}_world_device" for a in _LETTERS],
        [f"q{a}_world_device" for a in "wxyz"],
        [f"angular_velocity_{a}_device" for a in _LETTERS],
        [f"gravity_{a}_world" for a in _LETTERS],
    ]
    for name in (name for group in groups for name in group):
        if names.count(name) != 1:
            raise InputError(path, name, f"{names.count(name)} columns of this name; expected one")
    wanted = [names.index(name) for group in groups for name in group]
    table = _table(path, names, separator, wanted)
    seconds, position, quaternions, rates, gravity = np.split(table, np.cumsum([len(g) for g in groups])[:-1], axis=1)
    times = seconds[:, 0] * 1e-6
    _check_times(path, groups[0][0], times)
    times = times - (times[0] if video_start is None else video_start)
    turn = _mount(path, mount)
    weight = np.linalg.norm(gravity, axis=1, keepdims=True)
    if (weight < 1.0).any():
        raise InputError(path, groups[4][0], f"row {int(np.argmin(weight)) + 2}: no gravity")
    # Straight down already in every file seen; were it not, the world is turned until it is.
    upright = between((gravity / weight).mean(axis=0), np.array([0.0, 0.0, -1.0]))
    placed = multiply(upright, _unit_quaternions(path, groups[2][0], quaternions))
    trajectory = _trajectory(path, groups[2][0], times, rotate(upright, position), placed, turn)
    down = rotate(conjugate(trajectory.orientation), rotate(upright, gravity / weight))
    return Telemetry(
        "Aria",
        gyroscope=Samples(times, rotate(conjugate(turn), rates)),
        gravity=Samples(times, down),
        trajectory=trajectory,
    )


def _header(path: str | PathLike[str]) -> tuple[list[str], str]:
    """Names of the columns, and what separates them."""
    file = Path(path)
    if not file.is_file():
        raise InputError(path, "telemetry", "is a folder or a device" if file.exists() else "no such file")
    if file.stat().st_size > _MAX_BYTES:
        raise InputError(path, "size", f"{file.stat().st_size} bytes; at most {_MAX_BYTES} are read")
    with file.open("rb") as stream:
        raw = stream.readline(_MAX_HEADER)
    line = raw.decode("utf-8-sig", errors="replace").strip()
    if not line or not raw.endswith(b"\n") or "\0" in line:
        raise InputError(path, "line 1", "no header: expected the names of the columns")
    separator = max(",;\t", key=line.count)
    return [name.strip().strip('"') for name in line.split(separator)], separator


def _columns(path: str | PathLike[str], names: Sequence[str], kind: str) -> list[int] | None:
    """Columns of a vector (x y z) or a quaternion (w x y z), or None where there are none."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        if match := _PATTERNS[kind].match(name.lower()):
            if match[1] in found:
                raise InputError(path, name, f"a second column of {kind} {match[1]}, besides {names[found[match[1]]]}")
            found[match[1]] = k
    letters = "wxyz" if kind == "orientation" else _LETTERS
    if not set(found) & set(letters):
        return None
    for letter in letters:
        if letter not in found:
            raise InputError(path, f"{kind} {letter}", "is missing, though there are others of its columns")
    return [found[letter] for letter in letters]


def _unit(name: str, kind: str) -> float:
    if kind == "gyroscope" and re.search(r"deg|dps|°", name):
        return float(np.deg2rad(1.0))
    if kind == "accelerometer" and re.search(r"[_ \[(]g[\])]*$", name):
        return 9.80665
    return 1.0


def _table(path: str | PathLike[str], names: Sequence[str], separator: str, wanted: Sequence[int]) -> Array:
    """``[rows, wanted]`` finite numbers below the header."""
    try:
        table = np.loadtxt(
            path,
            delimiter=separator,
            skiprows=1,
            usecols=wanted,
            ndmin=2,
            max_rows=_MAX_ROWS + 1,
            comments=None,
            encoding="utf-8",
        )
    except (ValueError, UnicodeError) as error:
        raise _faulty(path, names, str(error)) from None
    if len(table) > _MAX_ROWS or len(table) < 2:
        raise InputError(path, "rows", f"{len(table)}; 2 to {_MAX_ROWS}")
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise InputError(path, names[wanted[column]], f"row {row + 2}: not a finite number")
    return table


def _faulty(path: str | PathLike[str], names: Sequence[str], said: str) -> InputError:
    """NumPy's words for a faulty cell, with the column's name and the line of the file."""
    if cell := re.search(r"string ('.{0,40}).* at row (\d+), column (\d+)", said):
        column = int(cell[3]) - 1
        name = names[column] if column < len(names) else f"column {column + 1}"
        return InputError(path, name, f"row {int(cell[2]) + 2}: no number: {cell[1].rstrip(chr(39))}'")
    if short := re.search(r"at row (\d+) with (\d+) columns", said):
        return InputError(path, f"row {int(short[1]) + 1}", f"{short[2]} columns; the header has {len(names)}")
    return InputError(path, "rows", f"cannot be read: {' '.join(said.split())}"[:200])


def _check_times(path: str | PathLike[str], name: str, seconds: Array) -> None:
    steps = np.diff(seconds)
    if not (steps > 0).all():
        raise InputError(path, name, f"row {int(np.argmin(steps > 0)) + 3}: the time does not rise")
    usual = float(np.median(steps))
    if not 1e-5 <= usual <= 1.0:
        raise InputError(path, name, f"a row every {usual:g} s: name the unit of time in the header (time_ns, time_us)")


def _mount(path: str | PathLike[str], mount: Sequence[float]) -> Array:
    turn = np.asarray(mount, dtype=np.float64)
    if turn.shape != (4,) or not np.isfinite(turn).all() or abs(np.linalg.norm(turn) - 1.0) > 0.01:
        raise InputError(path, "mount", f"{list(mount)}; expected a unit quaternion w x y z")
    return normalize(turn)


def _unit_quaternions(path: str | PathLike[str], name: str, quaternions: Array) -> Array:
    length = np.linalg.norm(quaternions, axis=1)
    if (np.abs(length - 1.0) > 0.01).any():
        row = int(np.argmax(np.abs(length - 1.0)))
        raise InputError(path, name, f"row {row + 2}: a quaternion of length {length[row]:.3g}; expected 1")
    return normalize(quaternions)


def _trajectory(
    path: str | PathLike[str], name: str, times: Array, position: Array | None, quaternions: Array, turn: Array
) -> Trajectory:
    placed = multiply(_unit_quaternions(path, name, quaternions), np.broadcast_to(turn, quaternions.shape))
    return Trajectory(times, position, continuous(placed))
