"""``python experiments/learning_curves/curves.py NAME=RUN_DIR ...``: what a tracker learns by steps and by hours.

Reads each run's ``curves.csv`` and writes ``raw/NAME.csv`` (a row for each evaluation), ``curves.png`` and the table in
``README.md``, between its two marks.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
KEPT = ("steps", "hours", "evaluation/score", "evaluation/falls", "episode_length", "reward", "kl", "steps_per_s")
BEGIN, END = "<!-- table -->", "<!-- end -->"


def evaluations(run: Path) -> list[dict[str, float]]:
    """Rows of the iterations in which the mean action was judged, with the hours of training before each."""
    rows, seconds = [], 0.0
    with open(run / "curves.csv", encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            numbers = {key: float(value) for key, value in row.items() if value not in ("", None)}
            seconds += sum(numbers.get(f"seconds_{part}", 0.0) for part in ("collect", "gae", "update"))
            if "evaluation/score" in numbers:
                rows.append({**numbers, "hours": seconds / 3600})
    return rows


def main() -> None:
    """The command."""
    named = dict(word.split("=", 1) for word in sys.argv[1:])
    (HERE / "raw").mkdir(exist_ok=True)
    for name, run in named.items():
        with open(HERE / "raw" / f"{name}.csv", "w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, KEPT, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(evaluations(Path(run)))
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
    lines = [
        "| run | million steps | hours | frames survived, first -> last | best | falls, last | reward | KL | steps/s |",
        "| --- | ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for path in sorted((HERE / "raw").glob("*.csv")):
        with open(path, encoding="utf-8", newline="") as stream:
            rows = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(stream)]
        if not rows:
            continue
        survived = [row["evaluation/score"] for row in rows]
        axes[0].plot([row["steps"] / 1e6 for row in rows], survived, label=path.stem)
        axes[1].plot([row["hours"] for row in rows], survived)
        last = rows[-1]
        lines.append(
            f"| {path.stem.replace('_', ' ')} | {last['steps'] / 1e6:.1f} | {last['hours']:.2f} | {survived[0]:.1f} -> "
            f"{survived[-1]:.1f} | {max(survived):.1f} | {last['evaluation/falls']:.0%} | {last.get('reward', 0):.3f} "
            f"| {last.get('kl', 0):.3f} | {last.get('steps_per_s', 0):.0f} |"
        )
    axes[0].set(xlabel="million control steps", ylabel="frames survived by the mean action, of 149")
    axes[1].set(xlabel="hours of training on two cores")
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(HERE / "curves.png", dpi=100)
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    readme.write_text(f"{before}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
