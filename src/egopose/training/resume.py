"""The configuration a resumed run goes on with: its own, but for what may change on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from egopose.errors import InputError
from egopose.training.checkpoint import find_checkpoint, read_json

#: What a resumed run may change: how long it goes on, what it keeps, where it is logged, on how many threads it runs.
CHANGEABLE = (
    "training",
    "logger",
    "output",
    "resume",
    "algo.iterations",
    "collector.physics_threads",
    "collector.threads",
    "collector.update_threads",
)


def resumed_config(folder: Path, composed: Mapping[str, Any], overrides: Sequence[str]) -> tuple[dict[str, Any], Path]:
    """The configuration of the run in ``folder`` with the command line's changes, and the checkpoint to go on from.

    Args:
        folder: a run directory.
        composed: the configuration as the command line would make it for a new run.
        overrides: the command line's, ``["resume=...", "training.max_seconds=60"]``.

    Raises:
        InputError: no such run or no checkpoint in it; ``config.yaml`` was edited, or an override changes what a run
            keeps throughout. Names the field.
    """
    checkpoint = find_checkpoint(folder)
    config = read_json(checkpoint, "config")
    written = folder / "config.yaml"
    if written.is_file():
        edited = OmegaConf.to_container(OmegaConf.load(written))
        for field, before, now in differences(config, edited):
            if not _changeable(field):
                raise InputError(written, field, f"was {before!r} when the run was saved, is {now!r}: start a new run")
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key.startswith("hydra"):
            continue
        now = _select(composed, key)
        for field, before, value in differences({key: _select(config, key)}, {key: now}):
            if not _changeable(field):
                raise InputError(
                    folder,
                    field,
                    f"is {before!r} in this run, not {value!r}: start a new run without resume",
                )
        _set(config, key, now)
    return config, checkpoint


def differences(first: Any, second: Any, where: str = "") -> list[tuple[str, Any, Any]]:
    """Fields ``(dotted name, first's value, second's value)`` in which two nested mappings differ; absent is None."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return [
            found
            for key in sorted(set(first) | set(second), key=str)
            for found in differences(first.get(key), second.get(key), f"{where}.{key}" if where else str(key))
        ]
    return [] if first == second else [(where, first, second)]


def _changeable(field: str) -> bool:
    return any(field == name or field.startswith(f"{name}.") for name in CHANGEABLE)


def _select(config: Mapping[str, Any], key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _set(config: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    for part in path:
        config = config.setdefault(part, {})
    config[last] = value
