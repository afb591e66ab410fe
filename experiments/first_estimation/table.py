"""Writes README.md and curves.png beside this file from ``raw/``: the evaluation's results, the training's curves.

    python experiments/first_estimation/table.py [--run RUN_DIR]

``--run`` first copies the raw results out of a run directory that has been evaluated.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
RAW = HERE / "raw"
#: Yuan & Kitani 2019, table 1, single subject: ours, PoseReg.
PAPER = {"E_pose": (0.640, 0.833), "E_vel": (4.469, 5.450), "A_accl": (5.002, 7.733)}
COMMANDS = """python -m egopose.train experiment=first_estimation data.folder=PATH/cmu_bvh60 output=runs/first
python -m egopose.evaluate checkpoint=runs/first/RUN which=latest failsafe.reset_threshold=0.3
python experiments/first_estimation/table.py --run runs/first/RUN"""


def collect(run: Path) -> None:
    """Copy the raw results out of a run directory."""
    RAW.mkdir(exist_ok=True)
    here = str(run.resolve().parents[1]) + "/"
    names = ("curves.csv", "config.yaml", "versions.json", "git.json")
    for path in (*(run / n for n in names), *(run / "evaluation" / "test" / n for n in ("results.json", "takes.csv"))):
        # Paths of the machine it ran on say nothing to anybody else.
        text = re.sub(r"(folder: ).*/(cmu_bvh60)", r"\1PATH/\2", path.read_text().replace(here, ""))
        (RAW / path.name).write_text(text)


def ratio_table(results: dict) -> list[str]:
    """Markdown rows: ours, PoseReg, ratio with interval, the paper's ratio."""
    rows = [
        "| metric | ours | PoseReg | ours / PoseReg (95 % over takes) | paper's ratio |",
        "| --- | --- | --- | --- | --- |",
    ]
    for metric, figure in results["figures"]["ours"].items():
        base, ratio = results["figures"]["PoseReg"][metric], results["ratios"]["ours"][metric]
        paper = f"{PAPER[metric][0] / PAPER[metric][1]:.3f}" if metric in PAPER else ""
        rows.append(
            f"| {metric} {results['units'][metric]} | {figure['value']:.3f} | {base['value']:.3f} | "
            f"{ratio['value']:.3f} [{ratio['low']:.3f}, {ratio['high']:.3f}] | {paper} |"
        )
    return rows


def draw_curves(rows: list[dict[str, str]]) -> None:
    """Frames survived, reward and the held-out look over control steps."""
    steps = [float(r["steps"]) / 1e6 for r in rows]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2))
    for axis, key, label in zip(
        axes,
        ("episode_length", "reward", "falls"),
        ("frames survived (sampled actions)", "reward", "falls"),
        strict=True,
    ):
        axis.plot(steps, [float(r[key]) for r in rows], lw=0.8)
        axis.set_xlabel("control steps, millions")
        axis.set_title(label, fontsize=9)
    looks = [(s, float(r["evaluation/score"])) for s, r in zip(steps, rows, strict=True) if r.get("evaluation/score")]
    if looks:
        axes[0].plot(*zip(*looks, strict=True), "o-", ms=3, label="held-out frames, mean action")
        axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(HERE / "curves.png", dpi=110)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path)
    run = parser.parse_args().run
    if run is not None:
        collect(run)
    results = json.loads((RAW / "results.json").read_text())
    rows = list(csv.DictReader((RAW / "curves.csv").open()))
    draw_curves(rows)
    survival = results["survival"][0]
    seconds = sum(float(r["seconds_collect"]) + float(r["seconds_gae"]) + float(r["seconds_update"]) for r in rows)
    lines = [
        "# The first estimation run",
        "",
        "*Written by `table.py` from `raw/`; do not edit.* The question: does a policy trained within an hour on",
        "two CPU cores beat the state regressor it stands on (PoseReg), as the paper's does?",
        "",
        "CMU mocap, subject 2 (walk, run, jump, punch, bend, swordplay, wash), each take's first 80 % in time trains,",
        "the rest tests. **The wearer's video is rendered from the mocap.** One seed.",
        "",
        "```bash",
        COMMANDS,
        "```",
        "",
        f"{float(rows[-1]['steps']) / 1e6:.2f} M control steps in {seconds / 60:.0f} minutes of PPO "
        f"({float(rows[-1]['steps']) / seconds:.0f} steps/s with other work on the machine), "
        f"{len(results['takes'])} test fragments, {results['resets']['ours']:.0f} resets.",
        "",
        *ratio_table(results),
        "",
        "Frames survived from random starts on the test fragments: "
        + ", ".join(f"{name.replace('_', ' ')} {result['frames']:.1f}" for name, result in survival.items())
        + ".",
        "",
        "![curves](curves.png)",
        "",
        (HERE / "findings.md").read_text() if (HERE / "findings.md").is_file() else "",
    ]
    (HERE / "README.md").write_text("\n".join(lines).rstrip() + "\n")
    print(HERE / "README.md")


if __name__ == "__main__":
    main()
