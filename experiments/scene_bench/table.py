"""Write the tables of README.md from result.json: python experiments/scene_bench/table.py."""

from __future__ import annotations

import json
from pathlib import Path

from egopose.benchmarks.scene_table import by_camera, tables

HERE = Path(__file__).parent
MARK = "<!-- tables: table.py writes what follows -->\n"


def main() -> None:
    """Put the tables behind the mark."""
    rows = json.loads((HERE / "result.json").read_text())["rows"]
    good = [row for row in rows if "failed" not in row]
    readme = HERE / "README.md"
    head = readme.read_text().partition(MARK)[0]
    # Clip by clip only what the project gives; simple answers are in the means.
    kinematic = [row for row in rows if row["motion"] == "kinematic"]
    readme.write_text(head + MARK + "\n" + tables({"rows": kinematic, "by_camera": by_camera(good)}) + "\n")


if __name__ == "__main__":
    main()
