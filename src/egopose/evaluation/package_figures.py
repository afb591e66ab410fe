"""The figures that go with packaged weights: provenance, means on held-out takes, ratios to other methods."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egopose import __version__
from egopose.checkpoint.checkpoint import (
    verify,
)
from egopose.core import safe_io
from egopose.core.errors import InputError
from egopose.evaluation.protocols import METRICS
from egopose.evaluation.statistics import mean_interval, ratio_interval

#: Metrics of the tables, of :data:`egopose.evaluation.protocols.METRICS`; of a forecast at each of the horizons.
SHOWN = ("E_pose", "E_vel", "A_accl", "E_key", "mpjpe_root_aligned", "root_drift", "foot_skate")
HORIZONS = (1.0, 3.0)  # s; Yuan & Kitani 2019, table 3


def describe_run(
    values: Mapping[str, Any], run: Path, checkpoint: Path, config: Mapping[str, Any]
) -> tuple[dict[str, Any], str]:
    """The contents of ``weights.json`` and ``figures.md``, see :func:`egopose.checkpoint.package.package_run`."""
    metadata, raws = verify(checkpoint), {}
    for method, path in values["figures"].items():
        raws[str(method)] = safe_io.read_json(Path(str(path)), "figures")
    notes = {
        key: safe_io.read_json(run / f"{key}.json", key) if (run / f"{key}.json").is_file() else None
        for key in ("git", "versions", "finished")
    }
    first: dict[str, Any] = next(iter(raws.values()), {})
    noted = (notes["git"] or {}).get("commit")
    about = {
        "name": str(values["name"]),
        "egopose": __version__,
        "task": metadata["task"],
        "control_steps": metadata["steps"],
        "which": str(values["which"]),
        "data": {key: config["data"].get(key) for key in ("name", "about", "split")},
        "seed": config["seed"],
        "commit": values["commit"] or noted,
        "overrides": first.get("overrides", []),
        "versions": notes["versions"],
        "finished": notes["finished"],
        "interval": dict(values["interval"]),
        "figures": {method: _figures(raw, values["interval"], str(method)) for method, raw in raws.items()},
        "ratios": {method: _ratios(first, raw, values["interval"]) for method, raw in list(raws.items())[1:]},
    }
    return about, figures_table(about)


def _figures(raw: Mapping[str, Any], interval: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Mean over held-out takes of each shown metric, with its interval; resets of the fail-safe a minute."""
    out: dict[str, Any] = {"takes": raw["takes"]}
    for label, scores in _scores(raw, method).items():
        result = mean_interval([scores], float(interval["level"]), int(interval["draws"]), int(interval["seed"]))
        out[label] = {"value": result.value, "low": result.low, "high": result.high}
    if "resets" in raw:
        seconds = sum(raw["frames"]) / 30.0  # the control rate of every task here
        out["resets_per_minute"] = 60.0 * sum(raw["resets"]) / seconds
        out["takes_without_reset"] = sum(1 for count in raw["resets"] if count == 0)
        out["seconds"] = seconds
    return out


def _ratios(above: Mapping[str, Any], below: Mapping[str, Any], interval: Mapping[str, Any]) -> dict[str, Any]:
    """First method divided by another on the same takes.

    Raises:
        InputError: the raw results are of other takes.
    """
    if above["takes"] != below["takes"]:
        raise InputError("conf/package.yaml", "figures", "the raw results are of different takes")
    ours, theirs, out = _scores(above, "first"), _scores(below, "other"), {}
    for label in ours.keys() & theirs.keys():
        level, draws, seed = float(interval["level"]), int(interval["draws"]), int(interval["seed"])
        result = ratio_interval([ours[label]], [theirs[label]], level, draws, seed)
        out[label] = {"value": result.value, "low": result.low, "high": result.high}
    return out


def _scores(raw: Mapping[str, Any], source: str) -> dict[str, list[float]]:
    """A figure a take, by metric; of forecasts by metric and horizon (``E_pose at 1 s``)."""
    try:
        if "horizons" not in raw:
            return {key: raw["figures"][key] for key in SHOWN if key in raw["figures"]}
        at = {h: raw["horizons"].index(h) for h in HORIZONS if h in raw["horizons"]}
        return {
            f"{key} at {h:g} s": [take[index] for take in raw["figures"][key]]
            for key in SHOWN
            if key in raw["figures"]
            for h, index in at.items()
        }
    except (KeyError, TypeError, IndexError) as error:
        raise InputError(source, "figures", f"is no raw result of the study: {error!r}") from None


def figures_table(about: Mapping[str, Any]) -> str:
    """The figures of ``weights.json`` as a Markdown table, methods side by side; empty where there are none."""
    known = {metric.key: metric for metric in METRICS}
    methods = list(about["figures"])
    if not methods:
        return ""
    heads = ["", *methods, *(f"{methods[0]} / {other}" for other in methods[1:])]
    lines = ["| " + " | ".join(heads) + " |", "| " + " | ".join("---" for _ in heads) + " |"]
    for label in about["figures"][methods[0]]:
        key, at, horizon = label.partition(" at ")
        if key not in known:
            continue
        metric = known[key]
        cells = [_cell(about["figures"][method].get(label), metric.decimals) for method in methods]
        cells += [_cell(about["ratios"][other].get(label), 2) for other in methods[1:]]
        unit = f" ({metric.unit})" if metric.unit else ""
        lines.append(f"| {metric.label}{at}{horizon}{unit} | " + " | ".join(cells) + " |")
    rates = [about["figures"][method].get("resets_per_minute") for method in methods]
    if rates[0] is not None:
        cells = ["" if rate is None else f"{rate:.1f}" for rate in rates] + [""] * (len(methods) - 1)
        lines.append("| resets a minute | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(found: Mapping[str, float] | None, digits: int) -> str:
    if found is None:
        return ""
    value, low, high = (f"{found[key]:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"
