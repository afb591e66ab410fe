"""The tables of ``egopose bench film`` from the JSON in ``raw/``: README.md here, and docs/film-figures.md.

``python experiments/film/film.py`` after the commands in README.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from egopose.benchmarks.film_table import by_camera, grouped, tables

HERE = Path(__file__).parent
FIGURES = HERE.parents[1] / "docs" / "film-figures.md"
MARK = "<!-- written by experiments/film/film.py -->\n"
HEAD = """# How well is motion read from film?

*Written by `film.py` from `raw/`; do not edit.* Question: what do speed, turns, path, steps and pose of a walk come to
when they are read from a film, by the camera and by what it tells of itself? And does the score *follows the film* tell
bad films from good ones?

```bash
cd experiments/film/raw
for place in open_ground street furnished_room
do egopose bench film --json --rounds ROUNDS part=cameras place=$place stabilised=no > cameras_$place.json
done
egopose bench film --json --rounds ROUNDS part=cameras stabilised=yes pitch=20 > cameras_stabilised.json
egopose bench film --json part=clips,confidence > clips.json
python ../film.py
```

ROUNDS, the seeds of each place, is {rounds} in these tables. Steadied pictures are filmed at one pitch only, to save
time.

How films and measures are made, and how to read the tables, is in [film-figures.md](../../docs/film-figures.md).
"""


def main() -> None:
    """The command."""
    raw = [json.loads(path.read_text()) for path in sorted((HERE / "raw").glob("*.json"))]
    result: dict[str, Any] = {}
    for one in raw:
        result |= {key: value for key, value in one.items() if key != "cameras"}
    result["cameras"] = [row for one in raw for row in one.get("cameras", [])]
    places = grouped(result["cameras"], ("place", "imu"), ("speed", "yaw_r", "net_path_percent", "step_error"))
    result["by_camera"] = sorted(by_camera(result["cameras"]), key=lambda row: (not row["imu"], row["stabilised"]))
    text = tables(result)
    lines = ["| place | imu | films | speed / true | yaw rate r | net path error, % | steps/s error |"]
    lines.append("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for row in places:
        cells = [row["place"].replace("_", " "), "yes" if row["imu"] else "no", str(row["films"])]
        for name, digits in (("speed", 2), ("yaw_r", 2), ("net_path_percent", 1), ("step_error", 2)):
            cells.append(f"{row[name]:.{digits}f} ({row[f'{name}_worst']:.{digits}f})")
        lines.append("| " + " | ".join(cells) + " |")
    told = f"{text}\n\n## Places, over all cameras\n\n" + "\n".join(lines) + "\n"
    rounds = str(min(one["rounds"] for one in raw if "cameras" in one))
    (HERE / "README.md").write_text(HEAD.replace("{rounds}", rounds) + f"\n{told}")
    head = FIGURES.read_text().partition(MARK)[0]
    FIGURES.write_text(f"{head}{MARK}\n{told}")


if __name__ == "__main__":
    main()
