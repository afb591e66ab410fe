"""A comparison as text, Markdown, JSON and CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from egopose.core.result_files import csv_cell
from egopose.evaluation.protocols import METRICS, Comparison
from egopose.evaluation.statistics import Interval


def rows(comparison: Comparison, keys: Sequence[str] | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of strings: a row a metric, a column a method, then each method's ratio to the baseline.

    Args:
        comparison: see :func:`egopose.evaluation.protocols.compare`.
        keys: of the metrics to show, all by default.
    """
    methods, divided = list(comparison.figures), list(comparison.ratios)
    header = ["metric", *methods, *(f"{m} / {comparison.baseline}" for m in divided)]
    out = []
    for metric in METRICS:
        if keys is not None and metric.key not in keys:
            continue
        label = f"{metric.label} ({metric.unit})" if metric.unit else metric.label
        cells = [_interval(comparison.figures[m].get(metric.key), metric.decimals) for m in methods]
        cells += [_interval(comparison.ratios[m].get(metric.key), 3) for m in divided]
        out.append([label, *cells])
    out.append(["resets", *(f"{comparison.resets[m]:g}" for m in methods), *("" for _ in divided)])
    return header, out


def as_markdown(comparison: Comparison, keys: Sequence[str] | None = None) -> str:
    """A Markdown table."""
    header, body = rows(comparison, keys)
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def as_text(comparison: Comparison, keys: Sequence[str] | None = None) -> str:
    """An aligned table for a terminal."""
    header, body = rows(comparison, keys)
    widths = [max(len(line[i]) for line in [header, *body]) for i in range(len(header))]
    lines = [
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in [header, *body]
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"


def as_dict(comparison: Comparison) -> dict[str, Any]:
    """The whole comparison as JSON-like values, units of :data:`METRICS` beside it."""
    intervals = {
        part: {m: {k: asdict(i) for k, i in table.items()} for m, table in getattr(comparison, part).items()}
        for part in ("figures", "ratios")
    }
    return {
        "takes": list(comparison.takes),
        "baseline": comparison.baseline,
        "units": {m.key: m.unit for m in METRICS},
        **intervals,
        "resets": dict(comparison.resets),
        "per_take": comparison.per_take,
    }


def write_csv(path: Path, comparison: Comparison) -> None:
    """One row per method, run and take; a column per metric."""
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["method", "run", "take", *(m.key for m in METRICS)])
        for method, table in comparison.per_take.items():
            for run in range(len(next(iter(table.values())))):
                for k, take in enumerate(comparison.takes):
                    writer.writerow([method, run, take, *(csv_cell(table[m.key][run][k]) for m in METRICS)])


def _interval(interval: Interval | None, decimals: int) -> str:
    if interval is None:
        return "-"
    return f"{interval.value:.{decimals}f} [{interval.low:.{decimals}f}, {interval.high:.{decimals}f}]"
