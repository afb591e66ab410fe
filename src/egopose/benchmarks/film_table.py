"""Tables of ``egopose bench film``: rows of films put together by camera or motion, and written as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from egopose.benchmarks.film_measures import MEASURES, OF_STANDING, OF_TURNING, OF_WALKS

_Row = Mapping[str, Any]
_CAMERA = ("pitch", "width", "stabilised", "imu")
#: Measures that are best at one, and those that are the better the higher they are; all others, the lower.
_ONE, _HIGH = ("speed",), ("yaw_r", "yaw_r_raw", "score")


def grouped(rows: Sequence[_Row], keys: Sequence[str], names: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each combination of ``keys``: it, the number of films, and each measure's ``mean`` and ``worst``.

    Films in which a measure has no meaning are left out of it; NaN where all are.
    """
    together: dict[tuple[Any, ...], list[_Row]] = {}
    for row in rows:
        together.setdefault(tuple(row[key] for key in keys), []).append(row)
    out = []
    for values, films in together.items():
        summary: dict[str, Any] = dict(zip(keys, values, strict=True)) | {"films": len(films)}
        for name in names:
            told = np.array([film[name] for film in films if film[name] is not None], dtype=float)
            told = told[np.isfinite(told)]
            summary[name] = float(told.mean()) if len(told) else float("nan")
            summary[f"{name}_worst"] = _worst(name, told)
        out.append(summary)
    return out


def _worst(name: str, values: np.ndarray) -> float:
    if not len(values):
        return float("nan")
    if name in _ONE:
        return float(values[np.argmax(np.abs(values - 1.0))])
    return float(values.min() if name in _HIGH else values.max())


def by_camera(rows: Sequence[_Row]) -> list[dict[str, Any]]:
    """Means and worst over the films of each camera."""
    return grouped(rows, _CAMERA, (*OF_WALKS, "score"))


def by_clip(rows: Sequence[_Row]) -> list[dict[str, Any]]:
    """Means and worst over the films of each motion, by the cameras' way to be read."""
    return grouped(rows, ("clip", "imu"), (*MEASURES, "score"))


def tables(result: Mapping[str, Any]) -> str:
    """All that a result of the bench holds, as Markdown. A cell is the mean over films, and the worst film."""
    out = []
    if "by_camera" in result:
        out.append("## Cameras\n\n" + _table(result["by_camera"], _CAMERA, (*OF_WALKS, "score")))
    if "by_clip" in result:
        out.append("## Motions\n\n" + _motions(result["by_clip"]))
    if "areas" in result:
        out.append("## Good films and bad ones\n\n" + _areas(result["areas"]))
        out.append("## What tells them apart\n\n" + _separation(result["separation"]))
    if "body" in result:
        rows = grouped(result["body"], ("clip", "imu"), OF_WALKS)
        out.append("## The body\n\n" + _table(rows, ("clip", "imu"), OF_WALKS))
    return "\n\n".join(out)


def _motions(rows: Sequence[_Row]) -> str:
    kinds = {"standing": OF_STANDING, "turning": OF_TURNING}
    groups: dict[tuple[str, ...], list[_Row]] = {}
    for row in rows:
        groups.setdefault(kinds.get(row["clip"], OF_WALKS), []).append(row)
    return "\n\n".join(_table(some, ("clip", "imu"), (*names, "score")) for names, some in groups.items())


def _table(rows: Sequence[_Row], keys: Sequence[str], names: Sequence[str]) -> str:
    heads = {**{name: head for name, (head, _) in MEASURES.items()}, "score": "follows film"}
    lines = [[*keys, "films", *(heads[name] for name in names)]]
    for row in rows:
        cells = [_cell(row[name], row[f"{name}_worst"], name) for name in names]
        lines.append([*(_said(row[key]) for key in keys), str(row["films"]), *cells])
    return _markdown(lines, len(keys))


def _cell(mean: float | None, worst: float | None, name: str) -> str:
    if mean is None or worst is None or not np.isfinite(mean):
        return "–"
    decimals = MEASURES[name][1] if name in MEASURES else 2
    return f"{mean:.{decimals}f} ({worst:.{decimals}f})"


def _areas(rows: Sequence[_Row]) -> str:
    lines = [["bad films", "imu", "good / bad", "scores", "area, films", "95%", "area, frames", "95%"]]
    for row in rows:
        cells = [row["kind"], _said(row["imu"]), f"{row['good']} / {row['bad']}"]
        cells.append(f"{row['good_score']:.2f} / {row['bad_score']:.2f}")
        for name in ("films", "frames"):
            cells += [f"{row[name]:.2f}", f"{row[f'{name}_low']:.2f} to {row[f'{name}_high']:.2f}"]
        lines.append(cells)
    return _markdown(lines, 2)


def _separation(rows: Sequence[_Row]) -> str:
    if not rows:
        return ""
    names = [name for name in rows[0] if name != "kind"]
    lines = [["part or feature", *(row["kind"] for row in rows)]]
    for name in names:
        lines.append([name.partition("_")[2], *(f"{row[name]:.2f}" for row in rows)])
    return _markdown(lines, 1)


def _said(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _markdown(lines: Sequence[Sequence[str]], left: int) -> str:
    rule = ["---"] * left + ["---:"] * (len(lines[0]) - left)
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], rule, *lines[1:]])
