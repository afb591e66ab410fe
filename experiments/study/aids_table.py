"""Writes table 4, each training aid against training without it, from the raw results that are there.

    python experiments/study/aids_table.py [--results experiments]

Survival is of the mean action from the same uniform starts of the training takes for every row; its intervals and those
of the differences are bootstraps over these episodes (one training run a row: they do not tell how much another seed
would differ). Nothing is filled in: what has not been measured is in no row.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.statistics import Interval, mean_interval
from egopose.motion.rotations import Array

HERE = Path(__file__).resolve().parent
TABLE = "table4_training_aids"
PLAIN = "ours"
LABELS = {
    PLAIN: "none",
    "adaptive_starts": "adaptive starts",
    "assist": "assisting wrench",
    "strict_falls": "strict falls at first",
    "loose_falls": "loose falls at first",
    "wide_sigma": "wide sigma at first",
}
#: Of the raw results' ``figures``.
METRICS = ("E_pose", "E_vel", "A_accl")


def gather(folder: Path) -> dict[tuple[int, str], Mapping[str, Any]]:
    """Raw results of seed 0 and on, by (budget, method); the smallest seed of each stands in the table.

    Raises:
        InputError: a file is damaged.
    """
    result: dict[tuple[int, str], Mapping[str, Any]] = {}
    for path in sorted((folder / "raw").glob("*.json")):
        raw = read_json(path, "raw result")
        try:
            budget = int(raw["overrides"][_budget_at(raw["overrides"])].split("=")[1])
            key = (budget, str(raw["method"]))
            raw["survival"]["policy"], raw["takes"], raw["figures"], raw["resets"]
            if key not in result or int(raw["seed"]) < int(result[key]["seed"]):
                result[key] = raw
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise InputError(path, "raw result", f"is damaged: {error!r}") from None
    return result


def _budget_at(overrides: Sequence[str]) -> int:
    return next(i for i, word in enumerate(overrides) if word.startswith("training.total_steps="))


def table(found: Mapping[tuple[int, str], Mapping[str, Any]]) -> list[str]:
    """Markdown, one table a budget."""
    lines: list[str] = []
    for budget in sorted({key[0] for key in found}):
        rows = {method: found[budget, method] for method in LABELS if (budget, method) in found}
        plain = rows.get(PLAIN)
        lines += [f"## {budget:,} control steps", ""]
        head = ["aid", "frames survived", "more than without", *METRICS, "resets a minute"]
        lines += [_row(head), _row(["---"] + ["---:"] * (len(head) - 1))]
        for method, raw in rows.items():
            frames = np.array(raw["survival"]["policy"], dtype=np.float64)
            gained = "" if plain is None or method == PLAIN else _cell(_difference(frames, plain), sign=True)
            cells = [f"{np.nanmean([np.nan if v is None else v for v in raw['figures'][m]]):.3f}" for m in METRICS]
            minutes = sum(raw["frames"]) / 30 / 60
            resets = f"{sum(raw['resets']) / minutes:.1f}"
            lines.append(_row([LABELS[method], _cell(mean_interval(frames[None])), gained, *cells, resets]))
        if plain is not None:
            for name, label in (("base_tracking", "zero action"), ("reference_tracking", "the true pose, open loop")):
                frames = np.array(plain["survival"][name], dtype=np.float64)
                gained = _cell(_difference(frames, plain), sign=True)
                lines.append(
                    _row([f"*no policy: {label}*", _cell(mean_interval(frames[None])), gained, "", "", "", ""])
                )
        lines.append("")
    return lines


def _difference(frames: Array, plain: Mapping[str, Any]) -> Interval:
    """Of the same episodes. Raises InputError: there are more or fewer."""
    other = np.array(plain["survival"]["policy"], dtype=np.float64)
    if other.shape != frames.shape:
        raise InputError(TABLE, "survival", "rows were judged on other episodes")
    return mean_interval((frames - other)[None])


def _cell(interval: Interval, sign: bool = False) -> str:
    form = "+.1f" if sign else ".1f"
    return f"{interval.value:{form}} [{interval.low:{form}}, {interval.high:{form}}]"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def write_table(results: Path) -> None:
    """README.md in the table's folder."""
    folder = results / TABLE
    note = [
        "# Table 4: what eases training",
        "",
        "*Written by `experiments/study/aids_table.py` from `raw/`; do not edit.* `experiment=estimation` on subject 2",
        "with one aid of `conf/aids` each, one run a row. What it says: [findings.md](findings.md).",
        "",
        "```bash",
        "python experiments/study/study.py data.folder=PATH/cmu_bvh60 --only '*-aids-*'",
        "python experiments/study/aids_table.py",
        "```",
        "",
    ]
    (folder / "README.md").write_text("\n".join([*note, *table(gather(folder))]).rstrip() + "\n")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE.parent)
    try:
        write_table(parser.parse_args().results)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
