"""C3D in: points of a laboratory's file, or joint centres that another program put there.

Read by the package ``c3d`` (MIT, Python and NumPy alone). ``ezc3d`` reads more kinds of files, but is native code:
of 300 copies of a good file with one to sixteen bytes changed it crashed the process on 8 and did not end within 20 s
on one; ``c3d`` raised an exception or read them all. It also holds about fifteen times the file's size in memory.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._files import MAX_JOINTS
from egopose.motion.io.frames import UNITS, UP_AXES
from egopose.motion.io.point_body import check_points, motion_of_points
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: The largest file read, bytes, and the most frames: over an hour at 120 frames/s.
MAX_BYTES = 2**28
_MAX_FRAMES = 2**19
_BLOCK, _KEY, _PROCESSORS = 512, 0x50, (84, 85, 86)


def read_c3d(
    path: str | Path,
    *,
    unit: str | None = None,
    up: str | None = None,
    fps: float | None = None,
    points: Mapping[str, str | Sequence[str]] | None = None,
) -> Motion:
    """Read a C3D's points and fit a skeleton to them, see :mod:`point_body`; analog channels are left alone.

    Args:
        path: the file, of any of the three kinds of processor, whole numbers or floats.
        unit: of its points, in place of ``POINT:UNITS``.
        up: its up axis; by default looked for in the motion, ``POINT:Y_SCREEN`` or z where that does not tell.
        fps: frames per second, in place of ``POINT:RATE``.
        points: part of the body (``right_knee``) -> name of a point, or of several whose middle is meant.

    Raises:
        InputError: no C3D, over :data:`MAX_BYTES`, a header that announces more than the file holds or does not agree
            with its parameters, numbers that are not finite, names that are not known.
    """
    path = Path(path)
    _check_head(path)
    names, values, rate, declared_unit, screen = _contents(path)
    if fps is not None:
        rate = fps
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1e-3 <= rate <= 1e5:
        raise InputError(path, "option fps" if fps is not None else "POINT:RATE", f"{rate!r:.40} is not a frame rate")
    if unit is None and declared_unit not in UNITS:
        raise InputError(path, "POINT:UNITS", f"{declared_unit!r:.40} is not known: say unit=mm or unit=m")
    return motion_of_points(
        path,
        names,
        values,
        float(rate),
        declared_unit=declared_unit,
        declared_up=screen,
        unit=unit,
        up=up,
        given=points,
        meta={"format": "c3d"},
    )


def _check_head(path: Path) -> None:
    """What the first bytes say, before anything else reads them."""
    if not path.is_file():
        raise InputError(path, "path", "is a folder or a device" if path.exists() else "no such file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise InputError(path, "size", f"{size} bytes; at most {MAX_BYTES} are read")
    with path.open("rb") as stream:
        head = stream.read(2)
        if len(head) < 2 or head[1] != _KEY or not head[0] or size < 2 * _BLOCK:
            raise InputError(path, "header", "not a C3D file: its second byte is not 0x50, or it is cut short")
        stream.seek((head[0] - 1) * _BLOCK)
        section = stream.read(4)
    if len(section) < 4 or section[3] not in _PROCESSORS:
        raise InputError(path, "parameters", "they are not where the header says")


def _contents(path: Path) -> tuple[list[str], Array, float, str, str]:
    """Names, points ``[T, P, 3]`` (gaps NaN), rate, unit, up axis."""
    with path.open("rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return _read(path, stream)
        except InputError:
            raise
        except MemoryError:
            raise
        except Exception as error:  # struct, NumPy and the package raise whatever the damage happens to be
            cause = " ".join(str(error).split())[:160] or type(error).__name__
            raise InputError(path, "header", f"damaged, or not as the format says: {cause}") from error


def _read(path: Path, stream: BinaryIO) -> tuple[list[str], Array, float, str, str]:
    import c3d

    class Reader(c3d.Reader):
        """Frame numbers as Python's: two-byte ones begin again behind 65,535. Analog channels are not asked for."""

        first_frame = property(lambda self: int(super().first_frame))
        last_frame = property(lambda self: int(super().last_frame))

        def get_analog_transform(self) -> tuple[float, float]:
            return 1.0, 0.0

    reader = Reader(stream)
    count, frames = int(reader.point_used), reader.last_frame - reader.first_frame + 1
    if not 0 < count <= MAX_JOINTS:
        raise InputError(path, "POINT:USED", f"{count} points; 1 to {MAX_JOINTS} are read")
    if not 0 < frames <= _MAX_FRAMES:
        raise InputError(path, "POINT:FRAMES", f"{frames} frames; 1 to {_MAX_FRAMES} are read")
    check_points(path, "POINT:FRAMES", frames, count)
    word = 4 if reader.point_scale < 0 else 2
    row = word * (4 * count + int(reader.analog_used) * int(reader.analog_per_frame))
    there = path.stat().st_size - _BLOCK * (int(reader.header.data_block) - 1)
    if frames * row > there:
        cause = f"{frames} frames of {row} bytes announced, only {max(there, 0)} are there: cut short"
        raise InputError(path, "POINT:FRAMES", cause)
    values = np.full((frames, count, 3), np.nan)
    read = 0
    for _, points, _ in reader.read_frames(copy=False, analog_transform=False):
        seen = points[:, 3] >= 0
        values[read, seen] = points[seen, :3]
        read += 1
    if read < frames:
        raise InputError(path, "POINT:FRAMES", f"{frames} frames announced, only {read} can be read: cut short")
    if (np.abs(np.nan_to_num(values, posinf=np.inf)) > 1e7).any():
        bad = int(np.argmax((np.abs(np.nan_to_num(values, posinf=np.inf)) > 1e7).any(axis=(1, 2))))
        raise InputError(path, f"frame {bad + 1}", "a number is infinite or absurdly large")
    unit = _text(reader, "POINT:UNITS").lower() or "mm"
    screen = _text(reader, "POINT:Y_SCREEN").lower().removeprefix("+")
    return _names(path, reader, count), values, float(reader.point_rate), unit, screen if screen in UP_AXES else "z"


def _names(path: Path, reader: Any, count: int) -> list[str]:
    """``POINT:LABELS``, ``LABELS2`` ... in one row, as many as there are points."""
    names: list[str] = []
    for k in range(1, MAX_JOINTS):
        parameter = reader.get(f"POINT:LABELS{k if k > 1 else ''}")
        if parameter is None or len(names) >= count:
            break
        names += [str(name).strip() for name in parameter.string_array]
    if len(names) < count:
        raise InputError(path, "POINT:LABELS", f"{len(names)} names for {count} points")
    return names[:count]


def _text(reader: Any, key: str) -> str:
    parameter = reader.get(key)
    return "" if parameter is None else str(parameter.string_value).strip()
