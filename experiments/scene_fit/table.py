"""``python experiments/scene_fit/table.py BENCH_JSON ...``: ``result.json`` and README.md's tables from the bench."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
#: Figure of the bench -> name in result.json, head of its column, decimals.
FIGURES = {
    "mpjpe_mm": ("mpjpe_mm", "MPJPE, mm", 0),
    "w_mpjpe100_mm": ("w_mpjpe_mm", "W-MPJPE100, mm", 0),
    "wa_mpjpe100_mm": ("wa_mpjpe_mm", "WA-MPJPE100, mm", 0),
    "root_percent": ("rte_percent", "root, % of path", 1),
    "success": ("success", "within 0.5 m", 2),
    "contact_accuracy": ("contact_accuracy", "contacts right", 2),
    "box_place_m": ("box_place_m", "box place, m", 2),
    "box_height_m": ("box_error_m", "box height, m", 2),
    "jitter": ("jitter", "jitter, m/s³", 0),
    "foot_skate": ("foot_skate", "foot skate, m/s", 2),
    "penetration_mm": ("penetration_mm", "penetration, mm", 0),
}
MOTIONS = {
    "still": "still",
    "anchored": "anchored",
    "kinematic": "kinematic",
    "simulated, given": "given",
    "simulated, fitted": "fitted",
}


def main() -> None:
    """The command."""
    results = [json.loads(Path(word).read_text()) for word in sys.argv[1:]]
    rows = [row for result in results for row in result["rows"] if "failed" not in row]
    kept: dict[str, dict[str, Any]] = {}
    lines = []
    for clip, camera, motion, some in _grouped(rows, ("clip", "camera", "motion")):
        told = _means(some)
        kept.setdefault(clip if camera == "fixed" else f"{clip}.{camera}", {})[MOTIONS[motion]] = told
        lines.append([clip, camera, MOTIONS[motion], *_cells(told)])
    summary = []
    for camera, motion, some in _grouped(rows, ("camera", "motion")):
        clips = len({row["clip"] for row in some})
        summary.append([camera, MOTIONS[motion], str(clips), *_cells(_means(some))])
    (HERE / "result.json").write_text(json.dumps(kept, indent=1) + "\n")
    page = HERE / "README.md"
    page.write_text(_with(page.read_text(), "summary", ["camera", "motion", "clips"], summary))
    page.write_text(_with(page.read_text(), "table", ["clip", "camera", "motion"], lines))


def _grouped(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[tuple[Any, ...]]:
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    order = list(MOTIONS)
    ranked = sorted(groups.items(), key=lambda item: (*item[0][:-1], order.index(item[0][-1])))
    return [(*key, some) for key, some in ranked]


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Over clips and seeds, of what is told."""
    out: dict[str, float | None] = {}
    for key, (name, _, _) in FIGURES.items():
        told = [row[key] for row in rows if row.get(key) is not None and np.isfinite(row[key])]
        out[name] = float(np.mean(told)) if told else None
    if "seconds" in rows[0]:
        out["wall_clock_h"] = float(np.mean([row["seconds"] for row in rows])) / 3600.0
    return out


def _cells(told: Mapping[str, float | None]) -> list[str]:
    hours = told.get("wall_clock_h")
    minutes = _said(None if hours is None else 60.0 * hours, 1)
    return [*(_said(told[name], decimals) for name, _, decimals in FIGURES.values()), minutes]


def _with(page: str, name: str, keys: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    head = [*keys, *(head for _, head, _ in FIGURES.values()), "minutes"]
    rows = [head, ["---"] * len(keys) + ["---:"] * (len(head) - len(keys)), *lines]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    before, _, rest = page.partition(f"<!-- {name} -->")
    return f"{before}<!-- {name} -->\n{table}\n<!-- end {name} -->{rest.partition(f'<!-- end {name} -->')[2]}"


def _said(value: float | None, decimals: int) -> str:
    return "–" if value is None or value != value else f"{value:.{decimals}f}"


if __name__ == "__main__":
    main()
