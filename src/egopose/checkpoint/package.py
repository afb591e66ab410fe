"""``python -m egopose.ship run=RUN name=NAME``: a trained run as a small folder that can be given away.

The folder is a run directory like any other, with what using the weights takes and no more::

    weights.json            provenance, figures on held-out takes
    figures.md              the same figures as a table
    provenance.json         fingerprint of the data it was trained on
    checkpoints/CHECKPOINT  policy, critic, normaliser, resolved configuration without this machine's paths
    regressor/              the state regressor
    forecaster/             of a forecasting policy that follows one
    checksums.json          of all files

Numbers keep their type: what is loaded equals the run to the bit.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

from omegaconf import DictConfig

from egopose import __version__
from egopose.checkpoint import pretrained as weights
from egopose.checkpoint.checkpoint import (
    FOLDER,
    ComponentState,
    RunCheckpoint,
    find_checkpoint,
    has_component,
    read_json,
    seal,
    verify,
)
from egopose.core.config import command, resolved
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.protocols import METRICS
from egopose.evaluation.statistics import mean_interval, ratio_interval
from egopose.pipeline.forecaster import FOLDER as FORECASTER
from egopose.pipeline.forecaster import PARTS

#: What of a checkpoint is shipped.
COMPONENTS = ("policy", "critic", "transforms")


#: Metrics of the tables, of :data:`egopose.evaluation.protocols.METRICS`; of a forecast at each of the horizons.
SHOWN = ("E_pose", "E_vel", "A_accl", "E_key", "mpjpe_root_aligned", "root_drift", "foot_skate")


HORIZONS = (1.0, 3.0)  # s; Yuan & Kitani 2019, table 3


_PLACES = {"folder": None, "store": None}  # of the group data: where this machine keeps things


def ship(values: Mapping[str, Any]) -> Path:
    """Make the folder ``conf/ship.yaml`` describes, whole or not at all.

    Args:
        values: ``conf/ship.yaml``, resolved.

    Returns:
        The folder.

    Raises:
        InputError: the run is damaged or unfinished, its configuration names a file of this machine, or a setting or
            raw result is wrong.
    """

    run, name = Path(str(values["run"])), str(values["name"])
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError("conf/ship.yaml", "name", f"must be of small letters, digits and _, not {name!r}")
    out = weights.FOLDER / name if values["out"] is None else Path(str(values["out"]))
    checkpoint = find_checkpoint(run, str(values["which"]))
    run = checkpoint.resolve().parents[1]
    config = without_places(read_json(checkpoint, "config"), checkpoint)
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        _copy_components(checkpoint, part / FOLDER / checkpoint.name, COMPONENTS, config)
        if not (run / "regressor").is_dir():
            raise InputError(run, "regressor", "is missing: the policy cannot see without it")
        shutil.copytree(run / "regressor", part / "regressor")
        if (run / FORECASTER).is_dir():
            kept = [one for one in PARTS if has_component(run / FORECASTER, one)]
            _copy_components(run / FORECASTER, part / FORECASTER, kept)
        if (run / "provenance.json").is_file():
            shutil.copyfile(run / "provenance.json", part / "provenance.json")
        about = _about(values, run, checkpoint, config)
        (part / weights.ABOUT).write_text(json.dumps(about, indent=1) + "\n")
        (part / "figures.md").write_text(figures_table(about))
        seal(part)
        shutil.rmtree(out, ignore_errors=True)
        os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def without_places(config: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """A run's configuration without where this machine keeps data and runs.

    Raises:
        InputError: some other setting of it is an absolute path; names it.
    """
    data = {**config["data"], **_PLACES}
    if data.get("takes"):
        data["takes"] = []  # a user's own files
    out = {**config, "data": data, "output": "runs", "resume": None}
    for key, value in _strings(out):
        if PurePath(value).is_absolute() or value.startswith("~"):
            raise InputError(source, key, f"names a place of this machine, {value!r}: it cannot be shipped")
    return out


def _strings(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _strings(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(value, Sequence):
        for number, inner in enumerate(value):
            yield from _strings(inner, f"{key}[{number}]")


def _copy_components(source: Path, target: Path, names: Sequence[str], config: Mapping[str, Any] | None = None) -> None:
    """A checkpoint of some of another one's components, and of ``config`` where it is given."""

    states: dict[str, Any] = {}

    def component(name: str) -> ComponentState:
        return ComponentState(lambda: states[name], lambda state: states.update({name: state}))

    parts = {name: component(name) for name in names}
    metadata = RunCheckpoint(parts).restore(source, set(names))
    target.parent.mkdir(parents=True, exist_ok=True)
    RunCheckpoint(parts | ({} if config is None else {"config": config})).save(target, metadata=metadata)


def _about(values: Mapping[str, Any], run: Path, checkpoint: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """``weights.json``."""

    metadata, raws = verify(checkpoint), {}
    for method, path in values["figures"].items():
        raws[str(method)] = read_json(Path(str(path)), "figures")
    notes = {
        key: read_json(run / f"{key}.json", key) if (run / f"{key}.json").is_file() else None
        for key in ("git", "versions", "finished")
    }
    first: dict[str, Any] = next(iter(raws.values()), {})
    noted = (notes["git"] or {}).get("commit")
    return {
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


def _figures(raw: Mapping[str, Any], interval: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Mean over held-out takes of each shown metric, with its interval; resets of the fail-safe a minute."""

    out: dict[str, Any] = {"takes": raw["takes"]}
    for label, scores in _scores(raw, method).items():
        found = mean_interval([scores], float(interval["level"]), int(interval["draws"]), int(interval["seed"]))
        out[label] = {"value": found.value, "low": found.low, "high": found.high}
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
        raise InputError("conf/ship.yaml", "figures", "the raw results are of different takes")
    ours, theirs, out = _scores(above, "first"), _scores(below, "other"), {}
    for label in ours.keys() & theirs.keys():
        level, draws, seed = float(interval["level"]), int(interval["draws"]), int(interval["seed"])
        found = ratio_interval([ours[label]], [theirs[label]], level, draws, seed)
        out[label] = {"value": found.value, "low": found.low, "high": found.high}
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


@command("ship")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    try:
        out = ship(resolved(config))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"{out}: {size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()
