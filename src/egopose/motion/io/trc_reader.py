"""TRC in: OpenSim's marker file, as Pose2Sim, OpenCap, FreeMoCap and laboratories write it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._files import MAX_JOINTS, excerpt, read_text
from egopose.motion.io.frames import UNITS, frame_rate
from egopose.motion.io.point_body import check_points, motion_of_points
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: Letters of one row: 2048 points with twenty letters a number.
_MAX_ROW = 2**18


def read_trc(
    path: str | Path,
    *,
    unit: str | None = None,
    up: str | None = None,
    fps: float | None = None,
    points: Mapping[str, str | Sequence[str]] | None = None,
) -> Motion:
    """Read a TRC and fit a skeleton to its points, see :mod:`point_body`.

    Args:
        path: the file.
        unit: of its numbers, in place of what its header says.
        up: its up axis; by default looked for in the motion, y where that does not tell.
        fps: frames per second, in place of what its header says.
        points: part of the body (``right_knee``) -> name of a point, or of several whose middle is meant, for layouts
            whose names are not known.

    Raises:
        InputError: no TRC, numbers that are none, rows of another length, an unknown unit, names that are not known, a
            header whose rate the times contradict.
    """
    path = Path(path)
    lines = read_text(path).split("\n")
    if not lines[0].startswith("PathFileType") or len(lines) < 6:
        raise InputError(path, "line 1", f"a TRC begins with PathFileType, found {excerpt(lines[0])}")
    header = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    names = _names(path, lines[3])
    times, values = _rows(path, lines, len(names))
    declared = header.get("Units", "").lower()
    if unit is None and declared not in UNITS:
        raise InputError(path, "Units", f"{excerpt(declared)} is not known: say unit=mm or unit=m")
    meta: dict[str, Any] = {"format": "trc"}
    announced = header.get("NumFrames", "")
    if announced.isdigit() and int(announced[:12]) != len(values):
        meta["notes"] = [f"the header announces {announced[:12]} frames, {len(values)} are there and were read"]
    return motion_of_points(
        path,
        names,
        values,
        _rate(path, header, times, fps),
        declared_unit=declared,
        declared_up="y",
        unit=unit,
        up=up,
        given=points,
        meta=meta,
    )


def _names(path: Path, line: str) -> list[str]:
    words = line.split("\t") if "\t" in line else line.split()
    names = [word.strip() for word in words if word.strip()][2:]
    if not names or not words[0].strip().lower().startswith("frame"):
        raise InputError(path, "line 4", "expected Frame#, Time and the names of the points")
    if len(names) > MAX_JOINTS:
        raise InputError(path, "line 4", f"{len(names)} points; at most {MAX_JOINTS} are read")
    return names


def _rows(path: Path, lines: list[str], count: int) -> tuple[Array, Array]:
    """Times ``[T]`` and points ``[T, P, 3]``; an empty field is NaN."""
    tabs = "\t" in lines[3]
    check_points(path, "line 7", len(lines) - 5, count)
    rows = []
    for number, line in islice(enumerate(lines, start=1), 5, None):
        if not line.strip():
            continue
        if len(line) > _MAX_ROW:
            raise InputError(path, f"line {number}", f"{len(line)} characters long")
        words = line.split("\t") if tabs else line.split()
        words = words[: 2 + 3 * count] if not "".join(words[2 + 3 * count :]).strip() else words
        if len(words) > 2 + 3 * count or (not tabs and len(words) < 2 + 3 * count):
            raise InputError(path, f"line {number}", f"{len(words)} fields; {2 + 3 * count} are wanted")
        try:
            row = [float(word) if word.strip() else np.nan for word in words]
        except ValueError:
            raise InputError(path, f"line {number}", f"not all of {excerpt(line)} are numbers") from None
        rows.append(np.array(row + [np.nan] * (2 + 3 * count - len(row))))
    if not rows:
        raise InputError(path, "line 7", "there are no frames")
    table = np.stack(rows)
    if (np.abs(np.nan_to_num(table, posinf=np.inf)) > 1e7).any():
        bad = int(np.argmax((np.abs(np.nan_to_num(table, posinf=np.inf)) > 1e7).any(axis=1)))
        raise InputError(path, f"frame {bad + 1}", "a number is infinite or absurdly large")
    return table[:, 1], table[:, 2:].reshape(len(table), count, 3)


def _rate(path: Path, header: dict[str, str], times: Array, given: float | None) -> float:
    if given is not None:
        if isinstance(given, bool) or not isinstance(given, int | float) or not 1e-3 <= given <= 1e5:
            raise InputError(path, "option fps", f"{given!r:.40} is not a frame rate")
        return float(given)
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) and np.isfinite(steps).all() else 0.0
    try:
        rate = float(header.get("DataRate", ""))
    except ValueError:
        rate = 0.0
    if not 1e-3 <= rate <= 1e5:
        if not 1e-5 <= step <= 1e3:
            raise InputError(path, "DataRate", "neither it nor the times give a frame rate: say fps=RATE")
        return frame_rate(step)
    # Times are written with few digits; over the clip they must come to the same.
    if step > 0 and abs((times[-1] - times[0]) * rate - len(steps)) > max(1.5, 0.02 * len(steps)):
        seconds = times[-1] - times[0]
        cause = f"{rate:g}, but {len(times)} frames take {seconds:.3f} s by their times: say fps=RATE"
        raise InputError(path, "DataRate", cause)
    return rate
