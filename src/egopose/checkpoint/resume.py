"""Going on with a run: its own configuration but for what may change on the way, and which runs need not go on."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser

from egopose.checkpoint.checkpoint import read_json, recover
from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.core.former_names import upgraded
from egopose.core.safe_io import read_json as read_json_file
from egopose.core.safe_io import read_yaml

#: What a resumed run may change: how long it goes on, what it keeps, where it is logged, how it uses the processor.
CHANGEABLE = (
    "training",
    "logger",
    "output",
    "resume",
    "algo.iterations",
    "algo.autocast",
    "collector.physics_threads",
    "collector.threads",
    "collector.update_threads",
    "collector.address",
)
#: In a run directory whose training came to its end; says how.
FINISHED = "finished.json"
#: A run that came to its end under these goes on under larger ones.
BUDGET = ("algo.iterations", "training.total_steps", "training.max_seconds")


def resumed_config(
    folder: Path, composed: Mapping[str, Any], overrides: Sequence[str]
) -> tuple[dict[str, Any], Path | None]:
    """The configuration of the run in ``folder`` with the command line's changes, and the checkpoint to go on from.

    Args:
        folder: a run directory.
        composed: the configuration as the command line would make it for a new run.
        overrides: the command line's, ``["resume=...", "training.max_seconds=60"]``.

    Returns:
        The checkpoint is None where the run ended before its first one.

    Raises:
        InputError: no such run; none of its checkpoints is whole; ``config.yaml`` was edited, or an override changes
            what a run keeps throughout. Names the field.
    """
    checkpoint = recover(folder)
    config = _saved_config(folder, checkpoint)
    if config is None:
        raise InputError(folder, "config.yaml", "is missing, and there is no checkpoint: this is no run directory")
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


def continued_job(folder: Path, composed: Mapping[str, Any]) -> Path | None:
    """The checkpoint a job of a sweep goes on from; None where its directory is new, or holds none yet.

    Raises:
        InputError: the directory is that of another job; none of its checkpoints is whole.
    """
    checkpoint = recover(folder)
    config = _saved_config(folder, checkpoint)
    for field, before, now in differences(config, composed) if config is not None else []:
        if not _changeable(field):
            raise InputError(
                folder, field, f"is {before!r} in the job of this directory, not {now!r}: give another hydra.sweep.dir"
            )
    return checkpoint


def mark_finished(folder: Path, config: Mapping[str, Any], figures: Mapping[str, Any]) -> None:
    """Note in ``folder/finished.json`` that training came to its end, under which budget, and ``figures``."""
    budget = {field: _select(config, field) for field in BUDGET}
    write_text_whole(folder / FINISHED, json.dumps({**figures, "budget": budget}, indent=1))


def finished(folder: Path, config: Mapping[str, Any]) -> dict[str, Any] | None:
    """What :func:`mark_finished` noted, None where there is more to do under ``config``'s budget."""
    path = folder / FINISHED
    if not path.exists():
        return None
    try:
        noted = dict(read_json_file(path, FINISHED))
        budget = noted["budget"]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(path, "budget", f"is damaged: {error!r}; without this file the run goes on") from None
    return noted if budget == {field: _select(config, field) for field in BUDGET} else None


@contextmanager
def only_process(folder: Path) -> Iterator[None]:
    """Hold the run directory's lock, the file ``.lock`` in it; the system releases it however its holder ends.

    Raises:
        InputError: another process is training there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(folder / ".lock").acquire(blocking=False)
    except Timeout:
        raise InputError(folder, "run directory", "another process is training in it") from None
    with held:
        yield


def _saved_config(folder: Path, checkpoint: Path | None) -> dict[str, Any] | None:
    """The run's configuration: the checkpoint's, but for what may change, where the newer ``config.yaml`` decides.

    Raises:
        InputError: ``config.yaml`` cannot be read, or was edited in what may not change.
    """
    path = folder / "config.yaml"
    written: dict[str, Any] | None = None
    if path.is_file():
        result = read_yaml(path, "config.yaml")
        if not isinstance(result, dict):
            raise InputError(path, "config.yaml", "cannot be read: is no mapping")
        written = upgraded({str(key): value for key, value in result.items()})
    if checkpoint is None:
        return written
    config = dict(read_json(checkpoint, "config"))
    for field, before, now in differences(config, written) if written is not None else []:
        if not _changeable(field):
            raise InputError(path, field, f"was {before!r} when the run was saved, is {now!r}: start a new run")
        _set(config, field, now)
    return config


def differences(first: Any, second: Any, where: str = "") -> list[tuple[str, Any, Any]]:
    """Fields ``(dotted name, first's value, second's value)`` in which two nested mappings differ; absent is None."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return [
            result
            for key in sorted(set(first) | set(second), key=str)
            for result in differences(first.get(key), second.get(key), f"{where}.{key}" if where else str(key))
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
