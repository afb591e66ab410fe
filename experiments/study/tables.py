"""Writes the tables beside the paper's figures, and ratios.json, from the raw results that are there.

    python experiments/study/tables.py [--results experiments]

A method's scores are an array of seeds by takes (all folds' takes one after the other). Intervals are bootstraps over
both, as in egopose.evaluation.statistics. Nothing is filled in: what has not been measured is in no table.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.result_files import write_json
from egopose.core.safe_io import read_json
from egopose.evaluation.statistics import Interval, mean_interval, ratio_interval
from egopose.inference.outputs import RENDERED_NOTE
from egopose.motion.rotations import Array

HERE = Path(__file__).resolve().parent
ESTIMATION, ABLATIONS, HORIZONS = "table1_estimation", "table2_ablations", "table3_horizons"
#: Names in ratios.json, and the study's folds: windows of four seconds need longer test parts than estimation does.
FORECASTS = {"forecast": "forecast_single", "forecast_cross": "forecast_cross"}
OURS = {"estimation": "ours", "forecasting": "ours_forecast"}
LABELS = {
    "ours": "ours",
    "ours_forecast": "ours",
    "shipped_forecast": "as shipped: flow alone, fewer moments",
    "no_planner": "ours, the policy alone",
    "live": "ours, live",
    "posereg": "PoseReg",
    "vgail": "VGAIL",
    "pathpose": "PathPose",
    "erd": "ERD",
    "aclstm": "acLSTM",
    "full": "(a) full",
    "pose_and_end_effectors": "(b) pose and end effectors",
    "pose_only": "(c) pose",
    "deepmimic": "(d) DeepMimic's reward",
    "no_failsafe": "(e) no fail-safe",
}
#: Yuan & Kitani 2019, Table 1: ours and the others by protocol and metric.
PAPER: dict[str, dict[str, float | None]] = {
    "single/e_pose": {"ours": 0.640, "vgail": 0.978, "pathpose": 1.035, "posereg": 0.833},
    "single/e_vel": {"ours": 4.469, "vgail": 6.561, "pathpose": 19.135, "posereg": 5.450},
    "single/a_accl": {"ours": 5.002, "vgail": 9.631, "pathpose": 63.526, "posereg": 7.733},
    "cross/e_pose": {"ours": 1.183, "vgail": 1.316, "pathpose": 1.637, "posereg": 1.308},
    "cross/e_vel": {"ours": 5.645, "vgail": 7.198, "pathpose": 32.454, "posereg": 6.334},
    "cross/a_accl": {"ours": 5.260, "vgail": 8.837, "pathpose": 117.5, "posereg": 8.281},
    # On data that the paper has not.
    "people/e_pose": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "people/e_vel": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "people/a_accl": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "large/e_pose": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "large/e_vel": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "large/a_accl": {"ours": None, "vgail": None, "pathpose": None, "posereg": None},
    "wild/e_key": {"ours": 0.099, "vgail": 0.175, "pathpose": 0.147, "posereg": 0.109},
    "wild/a_accl": {"ours": 5.795, "vgail": 9.278, "pathpose": 125.4, "posereg": 7.611},
    "forecast/e_pose_1s": {"ours": 0.833, "erd": 0.949, "aclstm": 0.861},
    "forecast/e_pose_3s": {"ours": 1.078, "erd": 1.266, "aclstm": 1.232},
    "forecast/e_vel": {"ours": 5.456, "erd": 6.242, "aclstm": 6.010},
    "forecast/a_accl": {"ours": 4.759, "erd": 5.916, "aclstm": 5.855},
    "forecast_cross/e_pose_1s": {"ours": 1.179, "erd": 1.374, "aclstm": 1.314},
    "forecast_cross/e_pose_3s": {"ours": 1.339, "erd": 1.619, "aclstm": 1.511},
    "forecast_cross/e_vel": {"ours": 6.045, "erd": 7.238, "aclstm": 7.454},
    "forecast_cross/a_accl": {"ours": 4.210, "erd": 6.419, "aclstm": 7.123},
}
TITLES = {
    "people": "People never seen (CMU: 23 people train, 3 others test; `people.yaml`)",
    "single": "Single subject",
    "cross": "Cross subject",
    "wild": "In the wild",
    "large": "A large set (Bandai Namco Research Motiondataset 1, the first 80 % of each take trains; `large.yaml`)",
}
#: Table 2, cross subject: N_reset, E_pose, E_vel, A_accl.
PAPER_ABLATIONS = {
    "full": (4, 1.183, 5.645, 5.260),
    "pose_and_end_effectors": (55, 1.211, 5.730, 5.515),
    "pose_only": (14, 1.236, 6.468, 8.167),
    "deepmimic": (52, 1.515, 7.413, 17.504),
    "no_failsafe": (4, 1.206, 5.693, 5.397),
}
#: Table 3, cross subject: E_pose at 1/3, 2/3, 1, 2, 3 s.
PAPER_HORIZONS = {
    "ours_forecast": (1.140, 1.154, 1.179, 1.268, 1.339),
    "erd": (1.239, 1.309, 1.374, 1.521, 1.619),
    "aclstm": (1.299, 1.297, 1.314, 1.425, 1.511),
}
#: In a raw result's overrides; PoseReg has none.
BUDGET = "training.total_steps="
#: Nothing is divided by less: a method that stands still has no acceleration.
SMALLEST = 1e-6
METRICS = {"e_pose": "E_pose", "e_vel": "E_vel", "a_accl": "A_accl", "e_key": "E_key"}


@dataclass(frozen=True)
class Scores:
    """Raw results of one method under one protocol: ``results[fold][seed]``."""

    results: Mapping[str, Mapping[int, Mapping[str, Any]]]

    def seeds(self, folds: Sequence[str]) -> list[int]:
        """Seeds measured in every one of ``folds``."""
        return sorted(set.intersection(*(set(self.results[fold]) for fold in folds)))

    def takes(self, folds: Sequence[str]) -> list[tuple[str, ...]]:
        """Names of the takes of each fold. Raises InputError: they differ between seeds."""
        out = []
        for fold in folds:
            names = {tuple(result["takes"]) for result in self.results[fold].values()}
            if len(names) != 1:
                raise InputError(fold, "takes", "differ between seeds: some raw results are of other data")
            out.append(names.pop())
        return out

    def values(self, metric: str, folds: Sequence[str], seeds: Sequence[int], horizon: float | None = None) -> Array:
        """``[S, K]``: seeds by the takes of all folds; at a horizon in seconds where results have several."""
        return np.array(
            [[v for fold in folds for v in _column(self.results[fold][seed], metric, horizon)] for seed in seeds]
        )


def _column(result: Mapping[str, Any], metric: str, horizon: float | None) -> list[float]:
    rows = result["figures"][metric]
    if horizon is not None:
        at = int(np.argmin(np.abs(np.array(result["horizons"]) - horizon)))
        rows = [row[at] for row in rows]
    return [float("nan") if v is None else float(v) for v in rows]


def gather(results: Path) -> dict[tuple[str, str], Scores]:
    """All raw results by protocol and method.

    Of a study under way to a larger budget, those that have come to it; the others are named on standard error.

    Raises:
        InputError: a file is damaged.
    """
    raw: list[tuple[Path, Mapping[str, Any], int | None]] = []
    for table in (ESTIMATION, ABLATIONS, HORIZONS):
        for path in sorted((results / table / "raw").glob("*.json")):
            result = read_json(path, "raw result")
            try:
                words = [w for w in result["overrides"] if w.startswith(BUDGET)]
                budget = int(words[-1].removeprefix(BUDGET)) if words else None
                int(result["seed"]), result["protocol"], result["method"], result["fold"]
                result["takes"], result["figures"]
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise InputError(path, "raw result", f"is damaged: {error!r}") from None
            raw.append((path, result, budget))
    largest = max((budget for _, _, budget in raw if budget is not None), default=None)
    found: dict[tuple[str, str], dict[str, dict[int, Any]]] = defaultdict(lambda: defaultdict(dict))
    for path, result, budget in raw:
        if budget not in (None, largest):
            print(f"left out: {path.name} had {budget} of {largest} steps", file=sys.stderr)
            continue
        found[result["protocol"], result["method"]][result["fold"]][int(result["seed"])] = result
    return {key: Scores(folds) for key, folds in found.items()}


def paired(ours: Scores, other: Scores) -> tuple[list[str], list[int], list[int]]:
    """Folds both were measured on, and the seeds of each: the same ones, or one of the other's against all of ours.

    Raises:
        InputError: they were measured on other takes.
    """
    folds = [fold for fold in ours.results if fold in other.results]
    if not folds:
        return [], [], []
    if ours.takes(folds) != other.takes(folds):
        raise InputError(", ".join(folds), "takes", "ours and a baseline were judged on other takes")
    mine, theirs = ours.seeds(folds), other.seeds(folds)
    if len(theirs) > 1:
        mine = theirs = [seed for seed in mine if seed in theirs]
    return folds, mine, theirs


def ratios(found: Mapping[tuple[str, str], Scores]) -> dict[str, dict[str, Any]]:
    """``{name: {ours, baseline, ratio, low, high, paper, seeds}}`` of everything measured that the paper compares."""
    out: dict[str, dict[str, Any]] = {}
    for name, paper in PAPER.items():
        part, metric = name.split("/")
        task = "forecasting" if part.startswith("forecast") else "estimation"
        protocol = FORECASTS.get(part, part)
        ours = found.get((protocol, OURS[task]))
        for baseline in paper:
            other = found.get((protocol, baseline))
            if baseline == "ours" or ours is None or other is None:
                continue
            folds, mine, theirs = paired(ours, other)
            if not mine or not theirs:
                continue
            key, horizon = METRICS[metric.rsplit("_", 1)[0] if metric[-1] == "s" else metric], None
            if task == "forecasting":
                horizon = float(metric[:-1].rsplit("_", 1)[1]) if metric[-1] == "s" else 3.0
            above, below = ours.values(key, folds, mine, horizon), other.values(key, folds, theirs, horizon)
            if not (np.isfinite(above) & np.isfinite(below)).any():
                continue
            if float(np.nanmean(below)) < SMALLEST:
                continue
            interval = ratio_interval(above, below)
            both = np.isfinite(above).all(axis=0) & np.isfinite(below).all(axis=0)
            out[f"{name}/{baseline}"] = {
                "ours": float(above[:, both].mean()),
                "baseline": float(below[:, both].mean()),
                "ratio": interval.value,
                "low": interval.low,
                "high": interval.high,
                "paper": _published(paper["ours"], paper[baseline]),
                "seeds": interval.runs,
                "takes": interval.takes,
                "folds": folds,
            }
    return out


def _published(ours: float | None, baseline: float | None) -> float | None:
    return None if ours is None or baseline is None else round(ours / baseline, 3)


def estimation_table(found: Mapping[tuple[str, str], Scores], measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Table 1's half of estimation, as Markdown."""
    lines: list[str] = []
    for protocol, metrics in (("people", 3), ("single", 3), ("cross", 3), ("wild", 2), ("large", 3)):
        keys = [name for name in PAPER if name.startswith(f"{protocol}/")][:metrics]
        methods = [m for m in ("ours", "no_planner", "live", "vgail", "pathpose", "posereg") if (protocol, m) in found]
        if not methods:
            continue
        heads = [name.split("/")[1] for name in keys]
        title = TITLES[protocol]
        heading = ["method", *(METRICS[h] for h in heads)]
        lines += [
            f"## {title}",
            "",
            *_header([*heading, "resets a minute", "whole takes", "fallen", "seeds", "takes"]),
        ]
        for method in methods:
            scores = found[protocol, method]
            folds = list(scores.results)
            seeds = scores.seeds(folds)
            cells = [_cell(_interval(scores, METRICS[h], folds, seeds)) for h in heads]
            takes = sum(len(names) for names in scores.takes(folds))
            reported = [*_resets(scores, folds, seeds), _fallen(scores, folds, seeds), str(len(seeds)), str(takes)]
            lines.append(_row([LABELS[method], *cells, *reported]))
        lines += ["", *_ratio_rows([f"{protocol}/{h}" for h in heads], measured), ""]
    return lines


def _fallen(scores: Scores, folds: Sequence[str], seeds: Sequence[int]) -> str:
    """Share of the frames in which the head is too low for the take; empty where that was not noted."""
    results = [scores.results[fold][seed] for fold in folds for seed in seeds]
    if not all("fallen" in result for result in results):
        return ""
    return f"{sum(sum(r['fallen']) for r in results) / sum(sum(r['frames']) for r in results):.1%}"


def ablation_table(found: Mapping[tuple[str, str], Scores]) -> list[str]:
    """Table 2, as Markdown: on the folds and seeds that all its rows have, or its order would be that of the takes.

    All rows are the policy alone, without a planner, as in the paper.
    """
    lines = _header(["", "resets", "E_pose", "E_vel", "A_accl", "paper: resets", "E_pose", "E_vel", "A_accl"])
    rows = {method: found["cross", method] for method in PAPER_ABLATIONS if ("cross", method) in found}
    if not rows:
        return lines
    folds = sorted(set.intersection(*(set(scores.results) for scores in rows.values())))
    seeds = sorted(set.intersection(*(set(scores.seeds(folds)) for scores in rows.values()))) if folds else []
    if not seeds:
        return lines
    for method, scores in rows.items():
        paper = PAPER_ABLATIONS[method]
        resets = np.mean([sum(sum(scores.results[f][s]["resets"]) for f in folds) for s in seeds])
        cells = [_cell(_interval(scores, key, folds, seeds)) for key in ("E_pose", "E_vel", "A_accl")]
        lines.append(_row([LABELS[method], f"{resets:g}", *cells, *(f"{v:g}" for v in paper)]))
    takes = sum(len(names) for names in next(iter(rows.values())).takes(folds))
    without = ", ".join(fold.removeprefix("without") for fold in folds)
    reported = f"The policy alone, no planner, in every row. Left out: {without}; {takes} takes, {len(seeds)} seed"
    return [*lines, "", f"{reported}{'s' if len(seeds) > 1 else ''} of every row. Resets: a whole pass over them."]


def horizon_table(found: Mapping[tuple[str, str], Scores], measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Table 3 and Table 1's half of forecasting, as Markdown."""
    lines: list[str] = []
    for prefix, protocol in FORECASTS.items():
        methods = [m for m in (*PAPER_HORIZONS, "shipped_forecast") if (protocol, m) in found]
        if not methods:
            continue
        first = next(iter(next(iter(found[protocol, methods[0]].results.values())).values()))
        times = [float(h) for h in first["horizons"]]
        heads = [f"E_pose {h:.2g} s" for h in times]
        title = "Single subject" if prefix == "forecast" else "Cross subject"
        lines += [f"## {title}", "", *_header(["method", *heads, "E_vel 3 s", "A_accl 3 s"])]
        for method in methods:
            scores = found[protocol, method]
            folds = list(scores.results)
            seeds = scores.seeds(folds)
            cells = [_cell(_interval(scores, "E_pose", folds, seeds, h)) for h in times]
            cells += [_cell(_interval(scores, key, folds, seeds, 3.0)) for key in ("E_vel", "A_accl")]
            lines.append(_row([LABELS[method], *cells]))
            if prefix == "forecast_cross" and method in PAPER_HORIZONS:
                lines.append(_row(["the paper's", *(f"{v:.3f}" for v in PAPER_HORIZONS[method]), "", ""]))
        lines += ["", *_ratio_rows([name for name in PAPER if name.startswith(f"{prefix}/")], measured), ""]
    return lines


def _interval(
    scores: Scores, key: str, folds: Sequence[str], seeds: Sequence[int], horizon: float | None = None
) -> Interval | None:
    values = scores.values(key, folds, seeds, horizon)
    return mean_interval(values) if np.isfinite(values).any() else None


def _cell(interval: Interval | None) -> str:
    return "-" if interval is None else f"{interval.value:.3f} [{interval.low:.3f}, {interval.high:.3f}]"


def _resets(scores: Scores, folds: Sequence[str], seeds: Sequence[int]) -> tuple[str, str]:
    result = [scores.results[fold][seed] for fold in folds for seed in seeds]
    resets = np.concatenate([one["resets"] for one in result])
    minutes = sum(sum(one["frames"]) for one in result) / 30 / 60
    return f"{resets.sum() / minutes:.2f}", f"{(resets == 0).mean():.0%}"


def _ratio_rows(names: Sequence[str], measured: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rows = [
        _row(
            [
                name,
                f"{result['ratio']:.3f} [{result['low']:.3f}, {result['high']:.3f}]",
                "" if result["paper"] is None else f"{result['paper']:.3f}",
                str(result["seeds"]),
                str(result["takes"]),
            ]
        )
        for name, result in measured.items()
        if name.rsplit("/", 1)[0] in names
    ]
    return [*_header(["ours / baseline", "ratio (95 %)", "the paper's", "seeds", "takes"]), *rows] if rows else []


def _header(cells: Sequence[str]) -> list[str]:
    return [_row(cells), _row(["---"] + ["---:"] * (len(cells) - 1))]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def write_tables(results: Path) -> dict[str, dict[str, Any]]:
    """``ratios.json`` and a README.md in each table's folder; returns the ratios."""
    result = gather(results)
    measured = ratios(result)
    write_json(results / "ratios.json", measured)
    note = [
        "*Written by `experiments/study/tables.py` from `raw/`; do not edit.* Means over takes, then seeds, and",
        f"95 % bootstrap intervals over both in brackets. {RENDERED_NOTE}",
        "",
        "```bash",
        "python experiments/study/study.py data.folder=PATH/cmu_bvh60",
        "python experiments/study/tables.py",
        "```",
        "",
    ]
    tables = {
        ESTIMATION: ("Table 1: estimation", estimation_table(result, measured)),
        ABLATIONS: ("Table 2: ablations, cross subject", ablation_table(result)),
        HORIZONS: ("Table 3: forecasting by horizon", horizon_table(result, measured)),
    }
    for folder, (title, lines) in tables.items():
        if (results / folder / "raw").is_dir():
            (results / folder / "README.md").write_text("\n".join([f"# {title}", "", *note, *lines]).rstrip() + "\n")
    return measured


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE.parent)
    try:
        measured = write_tables(parser.parse_args().results)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    for name, result in measured.items():
        paper = "" if result["paper"] is None else f"  paper {result['paper']:.3f}"
        print(f"{name:32s} {result['ratio']:.3f} [{result['low']:.3f}, {result['high']:.3f}]{paper}")


if __name__ == "__main__":
    main()
