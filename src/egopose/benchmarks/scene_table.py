"""Tables of ``egopose bench scenes``: a row a clip and camera, and means by camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_Row = Mapping[str, Any]
#: Figure of :func:`egopose.evaluation.scene_metrics.scene_figures` -> its column and decimals.
FIGURES = {
    "mpjpe_mm": ("MPJPE, mm", 0),
    "w_mpjpe100_mm": ("W-MPJPE100, mm", 0),
    "wa_mpjpe100_mm": ("WA-MPJPE100, mm", 0),
    "root_percent": ("root, % of path", 1),
    "root_furthest_m": ("furthest, m", 2),
    "success": ("within 0.5 m", 2),
    "contact_accuracy": ("contacts right", 3),
    "box_place_m": ("box place, m", 2),
    "box_height_m": ("box height, m", 2),
    "boxes_missing": ("boxes missing", 1),
    "boxes_invented": ("boxes invented", 1),
    "jitter": ("jitter, m/s³", 0),
    "foot_skate": ("foot skate, m/s", 2),
    "penetration_mm": ("penetration, mm", 0),
}
_SEEN = ("camera", "noise", "boxes", "gap")


def by_camera(rows: Sequence[_Row]) -> list[dict[str, Any]]:
    """Means over the clips of each way to see them and each judged motion; NaN where no clip tells."""
    groups: dict[tuple[Any, ...], list[_Row]] = {}
    for row in rows:
        groups.setdefault((row["motion"], *(row[key] for key in _SEEN)), []).append(row)
    out = []
    for (motion, *values), some in groups.items():
        mean: dict[str, Any] = {"motion": motion, **dict(zip(_SEEN, values, strict=True)), "clips": len(some)}
        for name in FIGURES:
            told = np.array([row[name] for row in some if name in row], dtype=float)
            told = told[np.isfinite(told)]
            mean[name] = float(told.mean()) if len(told) else float("nan")
        out.append(mean)
    return out


def tables(result: Mapping[str, Any]) -> str:
    """The whole result as Markdown: means by camera, then every clip, then what failed."""
    out = ["## By camera\n\n" + _table(result["by_camera"], ("motion", *_SEEN, "clips"))]
    rows = [row for row in result["rows"] if "failed" not in row]
    out.append("## Clips\n\n" + _table(rows, ("clip", "motion", *_SEEN)))
    failed = [row for row in result["rows"] if "failed" in row]
    if failed:
        lines = [f"- {row['clip']}, {', '.join(_said(row[key]) for key in _SEEN)}: {row['failed']}" for row in failed]
        out.append("## Failed\n\n" + "\n".join(lines))
    return "\n\n".join(out)


def _table(rows: Sequence[_Row], keys: Sequence[str]) -> str:
    lines = [[*keys, *(head for head, _ in FIGURES.values())]]
    for row in rows:
        lines.append([*(_said(row[key]) for key in keys), *(_cell(row[name], FIGURES[name][1]) for name in FIGURES)])
    rule = ["---"] * len(keys) + ["---:"] * len(FIGURES)
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], rule, *lines[1:]])


def _cell(value: float | None, decimals: int) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{decimals}f}"


def _said(value: object) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)
