"""A trained run as a small folder that can be given away.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

from egopose.checkpoint import pretrained as weights
from egopose.checkpoint.checkpoint import (
    FOLDER,
    ComponentState,
    RunCheckpoint,
    find_checkpoint,
    has_component,
    read_json,
)
from egopose.checkpoint.checksums import seal
from egopose.checkpoint.run_folder import FOLDER as FORECASTER
from egopose.checkpoint.run_folder import PARTS
from egopose.core.errors import InputError

#: What of a checkpoint is shipped.
COMPONENTS = ("policy", "critic", "transforms")
_PLACES = {"folder": None, "store": None}  # of the group data: where this machine keeps things
#: ``describe(values, run, checkpoint, config)`` gives the contents of ``weights.json`` and ``figures.md``.
Describe = Callable[[Mapping[str, Any], Path, Path, Mapping[str, Any]], tuple[dict[str, Any], str]]


def package_run(values: Mapping[str, Any], describe: Describe) -> Path:
    """Make the folder ``conf/package.yaml`` describes, whole or not at all.

    Args:
        values: ``conf/package.yaml``, resolved.
        describe: gives provenance and figures, and these as a table.

    Returns:
        The folder.

    Raises:
        InputError: the run is damaged or unfinished, its data's licence forbids it (``data.ship``), its configuration
            names a file of this machine, or a setting or raw result is wrong.
    """
    run, name = Path(str(values["run"])), str(values["name"])
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError("conf/package.yaml", "name", f"must be of small letters, digits and _, not {name!r}")
    out = weights.FOLDER / name if values["out"] is None else Path(str(values["out"]))
    checkpoint = find_checkpoint(run, str(values["which"]))
    run = checkpoint.resolve().parents[1]
    config = without_places(read_json(checkpoint, "config"), checkpoint)
    if config["data"].get("ship", True) is not True:
        cause = f"the licence of the set {config['data'].get('name')} does not let weights trained on it be given away"
        raise InputError(checkpoint, "data.ship", cause)
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
        about, table = describe(values, run, checkpoint, config)
        (part / weights.ABOUT).write_text(json.dumps(about, indent=1) + "\n")
        (part / "figures.md").write_text(table)
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
    if "training" in config:  # which run a policy came from is a place of this machine too
        out["training"] = {**config["training"], "start_from": None}
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
