"""Writes README.md, clean against corrupted video for every method, from the raw results of noise.py.

    python experiments/noise/table.py [--results DIR]

A row is a method trained on one kind of video, a column what it was judged with. Means over takes, then seeds;
intervals are bootstraps of the ratio to the same method's clean figure, over takes and seeds. What has not been
measured is in no table.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.statistics import ratio_interval
from egopose.inference.outputs import RENDERED_NOTE
from egopose.motion.rotations import Array

HERE = Path(__file__).resolve().parent
CLEAN = "none"
CORRUPTIONS = {
    CLEAN: "clean",
    "jitter": "jitter",
    "drift": "drift",
    "shake": "shake",
    "dropped": "dropped frames",
    "all": "all at once",
}
METHODS = {
    "ours": "ours",
    "blended": "the regressor ours follows",
    "vgail": "VGAIL",
    "pathpose": "PathPose",
    "posereg": "PoseReg",
}
METRICS = {
    "E_pose": "E_pose (rad)",
    "E_vel": "E_vel",
    "A_accl": "A_accl",
    "mpjpe_root_aligned": "MPJPE, roots aligned (mm)",
}
#: Raw results by corruption, each one a seed.
Row = Mapping[str, Sequence[Mapping[str, Any]]]


def gather(results: Path) -> dict[tuple[str, str, str], Row]:
    """Raw results: (fold, method, trained with) -> corruption -> seeds in order.

    Raises:
        InputError: a file is damaged, or the takes of a fold differ.
    """
    result: dict[tuple[str, str, str], dict[str, list[Mapping[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    takes: dict[str, list[str]] = {}
    for path in sorted((results / "raw").glob("*.json")):
        raw = read_json(path, "raw result")
        try:
            fold, key = raw["fold"], (raw["fold"], raw["method"], raw["trained"])
            if takes.setdefault(fold, raw["takes"]) != raw["takes"]:
                raise InputError(path, "takes", "differ from those of other methods of this fold")
            result[key][raw["corruption"]].append(raw)
        except (KeyError, TypeError) as error:
            raise InputError(path, "raw result", f"is damaged: {error!r}") from None
    return {key: {name: sorted(raws, key=_seed) for name, raws in row.items()} for key, row in result.items()}


def _seed(raw: Mapping[str, Any]) -> int:
    return int(raw["seed"])


def values(raws: Sequence[Mapping[str, Any]], metric: str) -> Array:
    """``[seeds, takes]``."""
    return np.array([raw["figures"][metric] for raw in raws], dtype=np.float64)


def cell(row: Row, corruption: str, metric: str) -> str:
    """The figure, and how many times the clean one it is, of the seeds measured on both."""
    if corruption not in row:
        return "-"
    mine = row[corruption]
    figure = f"{values(mine, metric).mean():.3f}"
    seeds = {_seed(raw) for raw in mine} & {_seed(raw) for raw in row.get(CLEAN, ())}
    if corruption == CLEAN or not seeds:
        return figure
    both = [[raw for raw in raws if _seed(raw) in seeds] for raws in (mine, row[CLEAN])]
    ratio = ratio_interval(values(both[0], metric), values(both[1], metric))
    return f"{figure} (x {ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}])"


def resets(row: Row, corruption: str) -> str:
    """Of the fail-safe, a minute."""
    if corruption not in row:
        return "-"
    counted = sum(sum(raw["resets"]) for raw in row[corruption])
    return f"{counted * 30 * 60 / sum(sum(raw['frames']) for raw in row[corruption]):.1f}"


def fold_tables(rows: Mapping[tuple[str, str], Row]) -> list[str]:
    """One table a metric of a fold's methods ``(method, trained with)``, as Markdown lines."""
    names = [name for name in CORRUPTIONS if any(name in row for row in rows.values())]
    ordered = sorted(rows, key=lambda key: (list(METHODS).index(key[0]), key[1] != "clean", key[1]))
    lines = []
    for metric, label in [*METRICS.items(), ("resets", "resets a minute")]:
        head = ["method", "trained on", *(CORRUPTIONS[name] for name in names)]
        lines += [f"### {label}", "", _line(head), _line(["---", "---", *(["---:"] * len(names))])]
        for key in ordered:
            if metric == "resets" and key[0] not in ("ours", "vgail"):
                continue
            cells = [resets(rows[key], n) if metric == "resets" else cell(rows[key], n, metric) for n in names]
            lines.append(_line([METHODS[key[0]], key[1], *cells]))
        lines.append("")
    return lines


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def write_table(results: Path) -> Path:
    """``README.md`` in ``results``, with ``findings.md`` at its end where that is there.

    Raises:
        InputError: there is nothing to make it of, or a raw result is damaged.
    """
    result = gather(results)
    if not result:
        raise InputError(results, "raw", "holds no results: run noise.py first")
    settings = {name: raws[0]["settings"] for row in result.values() for name, raws in row.items()}
    lines = [
        "# Corrupted video",
        "",
        "*Written by `table.py` from `raw/`; do not edit.* How much each method loses where the camera jitters, slips",
        "or swings in its mount and where frames never come (`conf/corruption`). Means over takes, then seeds; in",
        "brackets the ratio to the same method's clean figure and its 95 % bootstrap interval over takes and seeds.",
        f"{RENDERED_NOTE} For every corruption it was rendered anew, the camera turned, so flow is",
        "what such a camera would have seen.",
        "",
        "```bash",
        "python experiments/noise/noise.py RUN [RUN ...]    # judges; what is done is skipped",
        "python experiments/noise/table.py",
        "```",
        "",
        "| corruption | settings |",
        "| --- | --- |",
        *(_line([CORRUPTIONS[name], _said(settings[name])]) for name in CORRUPTIONS if name in settings),
        "",
    ]
    for fold in sorted({key[0] for key in result}):
        rows = {key[1:]: row for key, row in result.items() if key[0] == fold}
        one = next(iter(next(iter(rows.values())).values()))[0]
        lines += [f"## {fold}: {len(one['takes'])} takes, {sum(one['frames']) / 30:.0f} s", "", *fold_tables(rows)]
    findings = results / "findings.md"
    text = "\n".join(lines).rstrip() + "\n"
    out = results / "README.md"
    out.write_text(text + ("\n" + findings.read_text() if findings.is_file() else ""))
    return out


def _said(settings: Mapping[str, Any]) -> str:
    rate = f"degrees at {settings['shake_rate']:g} Hz"
    units = {"jitter": "degrees", "drift": "degrees a root of a second", "shake": rate, "dropped": "of the frames"}
    return ", ".join(f"{name} {settings[name]:g} {unit}" for name, unit in units.items() if settings[name]) or "none"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE)
    try:
        print(write_table(parser.parse_args().results))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
