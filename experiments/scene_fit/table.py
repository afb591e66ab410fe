"""``python experiments/scene_fit/table.py BENCH_JSON ...``: ``result.json`` and README.md's table from the bench."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
#: Figure of the bench -> name in result.json, head of its column, decimals.
FIGURES = {
    "mpjpe_mm": ("mpjpe_mm", "MPJPE, mm", 0),
    "w_mpjpe100_mm": ("w_mpjpe_mm", "W-MPJPE100, mm", 0),
    "wa_mpjpe100_mm": ("wa_mpjpe_mm", "WA-MPJPE100, mm", 0),
    "root_percent": ("rte_percent", "root, % of path", 1),
    "success": ("success", "within 0.5 m", 0),
    "contact_accuracy": ("contact_accuracy", "contacts right", 2),
    "box_place_m": ("box_place_m", "box place, m", 2),
    "box_height_m": ("box_error_m", "box height, m", 2),
    "jitter": ("jitter", "jitter, m/s³", 0),
    "foot_skate": ("foot_skate", "foot skate, m/s", 2),
    "penetration_mm": ("penetration_mm", "penetration, mm", 0),
}
MOTIONS = {"kinematic": "kinematic", "simulated, given": "given", "simulated, fitted": "fitted"}


def main() -> None:
    """The command."""
    results = [json.loads(Path(word).read_text()) for word in sys.argv[1:]]
    rows = [row for result in results for row in result["rows"] if "failed" not in row]
    kept: dict[str, dict[str, Any]] = {}
    lines = [["clip", "motion", *(head for _, head, _ in FIGURES.values()), "minutes"]]
    lines.append(["---"] * 2 + ["---:"] * (len(FIGURES) + 1))
    for row in rows:
        told = {name: row[key] for key, (name, _, _) in FIGURES.items()}
        if "seconds" in row:
            told["wall_clock_h"] = row["seconds"] / 3600.0
        kept.setdefault(row["clip"], {})[MOTIONS[row["motion"]]] = told
        values = [_said(row[key], decimals) for key, (_, _, decimals) in FIGURES.items()]
        minutes = _said(row["seconds"] / 60.0, 1) if "seconds" in row else ""
        lines.append([row["clip"], MOTIONS[row["motion"]], *values, minutes])
    (HERE / "result.json").write_text(json.dumps(kept, indent=1) + "\n")
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    page = HERE / "README.md"
    before, _, rest = page.read_text().partition("<!-- table -->")
    page.write_text(f"{before}<!-- table -->\n{table}\n<!-- end -->{rest.partition('<!-- end -->')[2]}")


def _said(value: float | None, decimals: int) -> str:
    return "–" if value is None or value != value else f"{value:.{decimals}f}"


if __name__ == "__main__":
    main()
