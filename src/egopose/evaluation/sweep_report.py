"""One page of a sweep: what its jobs differ in, what came of each, and their curves over each other."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.former_names import upgraded
from egopose.core.safe_io import read_json, read_yaml
from egopose.evaluation.charts import Chart, Line, line_chart
from egopose.evaluation.estimation_page import SHOWN
from egopose.evaluation.page import Number, Table, labelled, render, result_cell
from egopose.evaluation.protocols import METRICS
from egopose.motion.rotations import Array

_STEPS = "steps"


@dataclass(frozen=True)
class SweepSettings:
    """See ``conf/report.yaml``.

    Args:
        curves: columns of ``curves.csv`` that are drawn, where a job has them.
        last: iterations whose mean is a job's figure in the table.
    """

    curves: tuple[str, ...]
    last: int


@dataclass(frozen=True)
class Job:
    """One run of a sweep: its settings with dotted names, its curves, whether it ended, its evaluations by split."""

    name: str
    settings: Mapping[str, Any]
    curves: Mapping[str, Array]
    finished: bool
    evaluations: Mapping[str, Mapping[str, Any]]


def write_sweep_report(folder: Path, settings: SweepSettings, out: Path) -> Path:
    """Write the page of a sweep's directory.

    Args:
        folder: its jobs are the folders in it with a ``config.yaml`` and a ``curves.csv``.
        settings: how much is shown.
        out: the HTML file; its folder must exist.

    Raises:
        InputError: there is no job in it, or a file of one is damaged.
    """
    jobs = read_jobs(folder)
    changed = differences(jobs)
    figures = {
        job.name: {"settings": {k: job.settings.get(k) for k in changed}, **_figures(job, settings)} for job in jobs
    }
    html = render(
        "sweep.html",
        title=f"Sweep: {folder.resolve().name}",
        data=figures,
        finished=sum(job.finished for job in jobs),
        command=_command(folder),
        jobs=_jobs_table(jobs, changed, figures, settings),
        last=settings.last,
        evaluations=_evaluations(jobs) if any(job.evaluations for job in jobs) else None,
        curves=_curves(jobs, changed, settings),
    )
    out.write_text(html, encoding="utf-8")
    return out


def read_jobs(folder: Path) -> list[Job]:
    """The jobs, numbered ones in the order of their numbers.

    Raises:
        InputError: there is none, or a file of one is damaged.
    """
    result = [path for path in folder.iterdir() if path.is_dir() and (path / "config.yaml").is_file()]
    result = [path for path in result if (path / "curves.csv").is_file()]
    if not result:
        raise InputError(folder, "path", "neither an evaluation (results.json) nor a sweep of runs (JOB/curves.csv)")
    result.sort(key=lambda path: (not path.name.isdigit(), int(path.name) if path.name.isdigit() else 0, path.name))
    jobs = []
    for path in result:
        evaluations = {
            results.parent.name: read_json(results, "results")
            for results in sorted(path.glob("evaluation/*/results.json"))
        }
        settings = dict(_flat(upgraded(read_yaml(path / "config.yaml", "config"))))
        ended = (path / "finished.json").is_file()
        jobs.append(Job(path.name, settings, _read_curves(path / "curves.csv"), ended, evaluations))
    return jobs


def differences(jobs: Sequence[Job]) -> list[str]:
    """Dotted names of the settings that are not the same in all jobs."""
    names = dict.fromkeys(name for job in jobs for name in job.settings)
    return [name for name in names if any(job.settings.get(name) != jobs[0].settings.get(name) for job in jobs)]


def _flat(value: Any, prefix: str = "") -> list[tuple[str, Any]]:
    if not isinstance(value, Mapping):
        return [(prefix, value)]
    return [item for key, inner in value.items() for item in _flat(inner, f"{prefix}.{key}" if prefix else str(key))]


def _read_curves(path: Path) -> dict[str, Array]:
    """Columns of numbers; empty cells are NaN."""
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        names = [name for name in (rows[0] if rows else {}) if name]
        return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(path, "curves", f"is damaged: {' '.join(str(error).split())}"[:200]) from None


def _figures(job: Job, settings: SweepSettings) -> dict[str, Any]:
    """Steps done, and the mean of each shown column's last finite values; None where there are none."""
    out: dict[str, Any] = {"finished": job.finished, _STEPS: _last(job.curves.get(_STEPS), 1)}
    return out | {name: _last(job.curves.get(name), settings.last) for name in settings.curves}


def _last(column: Array | None, count: int) -> float | None:
    finite = column[np.isfinite(column)] if column is not None else np.empty(0)
    return float(finite[-count:].mean()) if len(finite) else None


def _command(folder: Path) -> str | None:
    """What made the sweep; None where Hydra left no record."""
    swept = folder / "multirun.yaml"
    if not swept.is_file():
        return None
    overrides = (read_yaml(swept, "hydra").get("hydra") or {}).get("overrides") or {}
    words = [str(w) for part in ("hydra", "task") for w in overrides.get(part) or []]
    words = [word for word in words if not word.startswith("hydra.mode=")]
    return shlex.join(["python", "-m", "egopose.train", "--multirun", *words])


def _jobs_table(
    jobs: Sequence[Job], changed: Sequence[str], figures: Mapping[str, Mapping[str, Any]], settings: SweepSettings
) -> Table:
    shown = [name for name in settings.curves if any(figures[job.name][name] is not None for job in jobs)]
    rows = [
        [
            job.name,
            *(job.settings.get(name, "-") for name in changed),
            Number(figures[job.name][_STEPS], 0),
            *(Number(figures[job.name][name]) for name in shown),
            "yes" if job.finished else "no",
        ]
        for job in jobs
    ]
    return Table(["job", *changed, _STEPS, *shown, "finished"], rows)


def _evaluations(jobs: Sequence[Job]) -> Table:
    """A row a job and split: what ``egopose evaluate`` found."""
    shown = [m for m in METRICS if m.key in SHOWN]
    rows = []
    for job in jobs:
        for split, results in job.evaluations.items():
            if figures := results.get("figures", {}):
                ours = next(iter(figures.values()))
                rows.append([job.name, split, *(result_cell(ours.get(m.key), m.decimals) for m in shown)])
    return Table(["job", "split", *map(labelled, shown)], rows)


def _curves(jobs: Sequence[Job], changed: Sequence[str], settings: SweepSettings) -> dict[str, Chart]:
    """By column of ``curves.csv``: a line a job, where any has figures."""
    charts = {}
    for name in settings.curves:
        lines = []
        for job in jobs:
            if name not in job.curves or _STEPS not in job.curves:
                continue
            there = np.isfinite(job.curves[name])
            differs = ", ".join(f"{key.rsplit('.', 1)[-1]}={job.settings.get(key)}" for key in changed[:4])
            lines.append(Line(f"{job.name}: {differs}", job.curves[_STEPS][there], job.curves[name][there]))
        if lines := [line for line in lines if len(np.asarray(line.x))]:
            charts[name] = line_chart(lines, "control steps", name)
    return charts
