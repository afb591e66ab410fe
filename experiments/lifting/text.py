"""The page that measure.py writes: page.txt with its tables."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

_COLUMNS = ("landmarks as they come", "landmarks", "lifter", "mean", "mean, lens known", "lifter, 1.7 m")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    head = list(head)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _lifting(result: dict[str, Any]) -> str:
    rows = []
    for view, row in result["lifting"].items():
        stages = ("before", "after") if row["swapped"] else ("after",)
        for stage in stages:
            what = f"{view}, {stage}" if row["swapped"] else view
            rows.append([what, *(f"{row[stage][c]['mpjpe']:.0f} / {row[stage][c]['pa']:.0f}" for c in _COLUMNS)])
    return table(["view", *_COLUMNS], rows)


def _choosing(result: dict[str, Any]) -> str:
    shares = sorted({key.split()[0] for key in result["choosing"]}, key=float)
    rows = [[f"across {a}", *(f"{result['choosing'][f'{a} {d}']:.0f}" for d in shares)] for a in shares]
    return table(["", *(f"depth {d}" for d in shares)], rows)


def _solved(ways: dict[str, dict[str, float]]) -> list[list[str]]:
    return [
        [way, f"{figures['error']:.1f}", f"{figures['acceleration']:.1f}" if "acceleration" in figures else ""]
        for way, figures in ways.items()
    ]


def _tables_of(parts: dict[str, Any], name: str) -> str:
    rows = [[part, *row] for part, ways in parts.items() for row in _solved(ways)]
    return table([name, "inverse kinematics", "error, mm", "acceleration, rad/s^2"], rows)


def _faults(result: dict[str, Any]) -> str:
    views = {name: row for name, row in result["robustness"].items() if name != "wrong person"}
    names = ("whole", "dropped", "gap", "whole, in the gap", "gap, in the gap")
    return table(["view", *names], [[view, *(f"{row[name]:.0f}" for name in names)] for view, row in views.items()])


def page(result: dict[str, Any]) -> str:
    """README.md."""
    across, depth = result["landmark_share"]
    swapped = {view: row["swapped"] for view, row in result["lifting"].items() if row["swapped"]}
    off = ", ".join(f"{row['off_px']:.0f}" for row in result["lifting"].values())
    told = next(row["told"] for name, row in result["robustness"].items() if name != "wrong person")
    wrong = "; ".join(
        f"{row['view']}: the woman in {row['woman']} frames, nobody in {row['nobody']}"
        for row in result["robustness"]["wrong person"]
    )
    return (
        (Path(__file__).parent / "page.txt")
        .read_text()
        .format(
            off=off,
            lifting=_lifting(result),
            across=f"{across:g}",
            depth=f"{depth:g}",
            plain=f"{result['mean_of_plain_views']:.0f}",
            swapped=", ".join(f"{count} frames of {view}" for view, count in swapped.items()),
            choosing=_choosing(result),
            ik_mocap=_tables_of(result["ik_mocap"], "noise"),
            ik_film=_tables_of(result["ik_film"], "view"),
            faults=_faults(result),
            told="; ".join(told),
            wrong=wrong,
        )
    )
