"""From a path to clips: a motion file, a folder of an estimate, an evaluation (of estimates or forecasts), a run."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.data.prepare_motion import without_lead_in
from egopose.inference.outputs import FOOTAGE
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.viewer.clip import Clip, Footage, Run

_MAX_TABLE_BYTES = 64 * 2**20


def read_run(path: str | Path, footage: Footage | None = None, reader: Mapping[str, Any] | None = None) -> Run:
    """All clips of a source.

    Args:
        path: a motion file; a folder with ``estimate.npz`` (of ``estimate``, or a take of an evaluation) or
            ``forecast.npz`` (a window); an evaluation's folder; or a run directory, whose evaluations are all shown.
        footage: the wearer's video of a source that is one clip, in place of what lies beside it.
        reader: options for the reader of a motion file.

    Raises:
        InputError: nothing there that can be shown, a damaged file, or a video given for several clips.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, "path", "no such file or folder")
    if path.is_file():
        # With a video its time 0 is the one that preparing and `egopose sync` count from.
        motion = read_motion(path, **(reader or {}))
        clips = {path.stem: Clip(motion if footage is None else without_lead_in(motion))}
    elif (path / "estimate.npz").is_file() or (path / "forecast.npz").is_file():
        clips = {path.name: _read_folder(path)}
    else:
        clips = _read_evaluation(path, "")
        for evaluation in sorted((path / "evaluation").glob("*")):
            clips |= _read_evaluation(evaluation, f"{evaluation.name}/")
    if not clips:
        cause = "no motion, no estimate, and no takes or windows of an evaluation; run `egopose evaluate` on it first"
        raise InputError(path, "path", cause)
    if footage is not None:
        if len(clips) > 1:
            raise InputError(path, "video", f"belongs to one clip, and here are {len(clips)}")
        clips = {name: replace(clip, footage=footage) for name, clip in clips.items()}
    return Run(path.name, clips)


def read_runs(
    paths: Sequence[str | Path], footage: Footage | None = None, reader: Mapping[str, Any] | None = None
) -> list[Run]:
    """:func:`read_run` of each; labels are made to differ. Raises as it does."""
    runs: list[Run] = []
    for path in paths:
        run = read_run(path, footage, reader)
        same = sum(other.label == run.label or other.label.startswith(f"{run.label} (") for other in runs)
        runs.append(replace(run, label=f"{run.label} ({same + 1})") if same else run)
    return runs


def _read_evaluation(folder: Path, prefix: str) -> dict[str, Clip]:
    result = [*sorted((folder / "takes").glob("*")), *sorted((folder / "windows").glob("*"))]
    whole = [f for f in result if (f / "estimate.npz").is_file() or (f / "forecast.npz").is_file()]
    return {f"{prefix}{f.name}": _read_folder(f) for f in whole}


def _read_folder(folder: Path) -> Clip:
    """``estimate.npz`` or ``forecast.npz`` and what lies beside it."""
    forecast = (folder / "forecast.npz").is_file()
    motion = read_motion(folder / ("forecast.npz" if forecast else "estimate.npz"))
    reference = next(
        (read_motion(p) for p in (folder / "reference.npz", folder / "reference.bvh") if p.is_file()), None
    )
    futures = tuple(read_motion(p) for p in sorted(folder.glob("future_*.npz")))
    frames, edges = folder / "frames.csv", folder / "bands.csv"
    curves = read_columns(frames, len(motion)) if frames.is_file() else {}
    bands: dict[str, dict[str, Array]] = {}
    for name, values in (read_columns(edges, len(motion)) if edges.is_file() else {}).items():
        degree, _, edge = name.rpartition("_")
        bands.setdefault(degree, {})[edge] = values
    bands = {d: b for d, b in bands.items() if set(b) == {"low", "median", "high"}}
    footage = _read_footage(folder)
    for other in (*futures, *([reference] if reference else [])):
        _check_length(folder, motion, other)
    return Clip(motion, reference, futures, forecast, curves, bands, footage)


def _read_footage(folder: Path) -> Footage | None:
    """The video that ``wearer.json`` names, else the last panel of ``side_by_side.mp4``; None where neither is there.

    Raises:
        InputError: ``wearer.json`` is damaged.
    """
    record, panels = folder / FOOTAGE, folder / "side_by_side.mp4"
    if record.is_file():
        result = read_json(record, "footage")
        try:
            path, rate = Path(str(result["video"])), result["taken_at"]
            offset, start = float(result["sync_offset"]), float(result["start"])
            rate = None if rate is None else float(rate)
            footage = Footage(path, offset, start, rendered=bool(result["rendered"]), taken_at=rate)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(record, "footage", f"is damaged: {error!r}") from None
        if path.is_file():
            return footage
    return Footage(panels, last_panel=True) if panels.is_file() else None


def _check_length(folder: Path, motion: Motion, other: Motion) -> None:
    if len(other) != len(motion):
        raise InputError(folder, "motions", f"of {len(motion)} and {len(other)} frames: they are not of one take")


def read_columns(path: Path, length: int) -> dict[str, Array]:
    """The columns of a table with one row a frame, but its ``frame``; empty cells are NaN.

    Raises:
        InputError: too large, not ``length`` rows, or a cell that is no number.
    """
    if path.stat().st_size > _MAX_TABLE_BYTES:
        raise InputError(path, "size", f"over {_MAX_TABLE_BYTES} bytes")
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = csv.reader(stream)
        table = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows], dtype=np.float64)
    except (ValueError, csv.Error) as error:
        raise InputError(path, "table", " ".join(str(error).split())[:200]) from None
    if table.shape != (length, len(header)):
        raise InputError(path, "table", f"of shape {list(table.shape)}; {[length, len(header)]} expected")
    return {name: table[:, i] for i, name in enumerate(header) if name != "frame"}
