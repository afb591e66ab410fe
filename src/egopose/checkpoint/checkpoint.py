"""Checkpoints: a folder of memory-mapped tensors and JSON, without pickle, that refuses what does not match.

The layout is TorchRL's ``torchrl.checkpoint.Checkpoint`` in its directory format (so ``torchrl.render.load_checkpoint``
and TorchRL's own tools read it), with SHA-256 checksums added::

    manifest.json        TorchRL's: versions, components; our schema, task and counters under "metadata"
    checksums.json       {file: sha256} over every other file
    components/NNNN-policy/{state.json, state/*.memmap} ...

Components: ``policy critic policy_optimizer value_optimizer transforms rng simulation trainer_state config``.
"""

from __future__ import annotations

import os
import shutil
import sys
import uuid
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation

from egopose import __version__
from egopose.checkpoint.checksums import _files, check_files, seal
from egopose.checkpoint.pretrained import is_pretrained, pretrained_run
from egopose.core import safe_io
from egopose.core.errors import InputError
from egopose.core.former_names import upgraded
from egopose.core.safe_tensors import check_checkpoint_files, check_checkpoint_states

SCHEMA = 1
FOLDER = "checkpoints"
#: Score of a checkpoint whose weights no evaluation looked at: below any other, so that it never passes for the best.
NOT_JUDGED = -1e300
_PREFIX = "checkpoint-"  # of TorchRL's rotation; the control steps follow
#: Where :func:`recover` puts a checkpoint that is not whole.
SET_ASIDE = "damaged-"


class SaveFailed(RuntimeError):
    """A checkpoint could not be written; those written before are as they were."""


class ComponentState:
    """A component made of two functions, for what has no ``state_dict`` of its own.

    Args:
        read: gives the state, nested mappings of tensors and plain values.
        write: takes it back.
    """

    def __init__(self, read: Callable[[], Mapping[str, Any]], write: Callable[[Mapping[str, Any]], None]) -> None:
        self._read, self._write = read, write

    def state_dict(self) -> Mapping[str, Any]:
        return self._read()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._write(state)


class _Strict:
    """Compares a state with the component's own before it is taken over, key by key."""

    def __init__(self, name: str, component: Any) -> None:
        self.name, self.component = name, component

    def state_dict(self) -> Mapping[str, Any]:
        return self.component.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if not isinstance(self.component, ComponentState):
            compare_states(self.component.state_dict(), state, self.name)
        self.component.load_state_dict(state)


def compare_states(expected: Mapping[str, Any], found: Mapping[str, Any], name: str) -> None:
    """Tensors of both states must have the same keys, shapes and types.

    An optimizer's moments exist only after its first step: its lists of parameters are compared in their place.

    Raises:
        InputError: the first field that differs; its source is the component's name.
    """
    if "param_groups" in expected:
        sizes = [[len(group["params"]) for group in state.get("param_groups", ())] for state in (expected, found)]
        if sizes[0] != sizes[1]:
            raise InputError(name, "param_groups", f"holds {sizes[1]} parameters where {sizes[0]} are expected")
        return
    for key in expected:
        if key not in found:
            raise InputError(name, key, "is missing in the checkpoint")
    for key, value in found.items():
        if key not in expected:
            raise InputError(name, key, "is in the checkpoint and not in this configuration's networks")
        want = expected[key]
        if isinstance(want, torch.Tensor) != isinstance(value, torch.Tensor):
            raise InputError(name, key, f"is a {type(value).__name__} where a {type(want).__name__} is expected")
        if isinstance(want, torch.Tensor) and want.shape != value.shape:
            raise InputError(name, key, f"has shape {list(value.shape)} where {list(want.shape)} is expected")
        if isinstance(want, torch.Tensor) and want.dtype != value.dtype:
            raise InputError(name, key, f"has type {value.dtype} where {want.dtype} is expected")


class RunCheckpoint(Checkpoint):
    """TorchRL's coordinator with checksums, durable atomic publication and errors that name the field.

    Args:
        components: objects with ``state_dict``/``load_state_dict``, or JSON-like mappings.
    """

    def __init__(self, components: Mapping[str, Any]) -> None:
        super().__init__(
            **{k: v if isinstance(v, Mapping) else _Strict(k, v) for k, v in components.items()}, strict="error"
        )

    def save(self, path: str | Path, **options: Any) -> Path:
        """Write beside ``path``, flush to the disk, then rename: a crash leaves the old checkpoint or the new one.

        Raises:
            SaveFailed: the disk is full or cannot be written to; what was written of it is removed.
        """
        destination = Path(path).absolute()
        stage = destination.parent / f".{destination.name}.part-{uuid.uuid4().hex}"
        try:
            super().save(stage, **options)
            seal(stage)
            for file in [*_files(stage), *(p for p in stage.rglob("*") if p.is_dir()), stage]:
                _flush(file)
            self._publish_path(stage, destination)
            _flush(destination.parent)
        except (OSError, RuntimeError) as error:  # torch tells of a full disk in a RuntimeError
            raise SaveFailed(f"{destination} cannot be written: {str(error).splitlines()[0]}") from error
        finally:
            shutil.rmtree(stage, ignore_errors=True)
        return destination

    def restore(self, path: str | Path, components: Collection[str] | None = None) -> dict[str, Any]:
        """Verify the folder, load ``components`` (all by default) and return the manifest's metadata.

        Raises:
            InputError: see :func:`verify`; a component is missing or does not fit, by its first differing field.
        """
        metadata = verify(path)
        try:
            super().load(path, components=components)
        except CheckpointError as error:
            cause = error.__cause__
            if isinstance(cause, InputError):
                raise InputError(path, f"{cause.source}.{cause.field}", cause.cause) from None
            result = error.result
            missing = sorted(result.missing) if result else []
            bad = sorted(result.incompatible) if result else []
            field = (missing + bad or ["manifest.json"])[0]
            raise InputError(path, field, "is missing in the checkpoint" if missing else str(error)) from error
        return metadata


def metadata_of(task: str, action_size: int, iteration: int, steps: int, score: float) -> dict[str, Any]:
    """What the manifest says besides TorchRL's own entries; ``score`` decides which checkpoint is the best.

    It is :data:`NOT_JUDGED` where these weights were not evaluated.
    """
    return {
        "schema": SCHEMA,
        "egopose": __version__,
        "task": task,
        "action_size": action_size,
        "iteration": iteration,
        "steps": steps,
        "score": score,
    }


def verify(path: str | Path) -> dict[str, Any]:
    """Check schema and checksums of a checkpoint folder; returns the manifest's metadata.

    Raises:
        InputError: no checkpoint there, a newer schema, a file missing, added or altered.
    """
    folder = Path(path)
    if not (folder / "manifest.json").is_file():
        raise InputError(folder, "manifest.json", "is missing: this is no checkpoint")
    check_checkpoint_files(folder)
    manifest = safe_io.read_json(folder / "manifest.json", "manifest.json")
    try:
        metadata = dict(manifest["metadata"])
        schema = metadata["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(folder, "manifest.json", f"cannot be read ({error!r})") from None
    if not isinstance(schema, int) or schema > SCHEMA:
        raise InputError(folder, "schema", f"is {schema}, this version reads up to {SCHEMA}: install a newer egopose")
    check_files(folder)
    check_checkpoint_states(folder)
    try:
        Checkpoint.manifest(folder)
    except CheckpointError as error:
        raise InputError(folder, "manifest.json", str(error)) from None
    return metadata


def has_component(path: str | Path, name: str) -> bool:
    """Whether a checkpoint folder holds that component. Raises InputError: see :func:`verify`."""
    verify(path)
    return name in Checkpoint.manifest(path)["components"]


def require(metadata: Mapping[str, Any], path: str | Path, **expected: Any) -> None:
    """Fields of the manifest's metadata (``task``, ``action_size``) must equal what this run is made for.

    Raises:
        InputError: the first field that differs.
    """
    for field, want in expected.items():
        if metadata.get(field) != want:
            raise InputError(path, field, f"is {metadata.get(field)!r} where {want!r} is expected")


def read_json(path: str | Path, component: str) -> Any:
    """A JSON component (``config``, ``trainer_state``) without any object to load it into.

    Settings of a ``config`` come under their present names.

    Raises:
        InputError: see :func:`verify`; or there is no such component.
    """
    verify(path)
    records = Checkpoint.manifest(path)["components"]
    if component not in records:
        raise InputError(path, component, "is missing in the checkpoint")
    value = safe_io.read_json(Path(path) / records[component]["path"] / "value.json", component)
    safe_io.check_sizes(value, Path(path))
    return upgraded(value) if component == "config" else value


def rotation(run_dir: str | Path, keep_last: int) -> CheckpointRotation:
    """The run's checkpoints: the last ``keep_last`` and the one of the best score."""
    return CheckpointRotation(Path(run_dir) / FOLDER, keep_last=keep_last, keep_best=("score", "max"))


def find_checkpoint(path: str | Path, which: str = "latest") -> Path:
    """A whole checkpoint folder from a run directory (its ``latest`` or ``best``), or the folder ``path`` itself.

    In a run directory a damaged one is passed over, with a line on standard error, for the one before it. Of weights
    that come with the package, ``pretrained:NAME``, there is one.

    Raises:
        InputError: there is no such run directory, or it holds no checkpoint yet, or none that is whole.
    """
    if is_pretrained(path):
        return find_checkpoint(pretrained_run(str(path)))
    folder = Path(path)
    if (folder / "manifest.json").is_file():
        return folder
    if not folder.is_dir():
        raise InputError(folder, "run directory", "does not exist")
    if not (folder / FOLDER).is_dir():
        raise InputError(folder, FOLDER, "is missing: neither a run directory nor a checkpoint")
    candidates = _by_step(folder)
    if which == "best" and (best := rotation(folder, keep_last=1).best()) is not None:
        candidates = [best, *(c for c in candidates if c != best)]
    result, damaged = _first_whole(candidates)
    for error in damaged if result is not None else []:
        print(f"warning: {error}; taking {result}", file=sys.stderr, flush=True)
    if result is None:
        raise damaged[0] if damaged else InputError(folder / FOLDER, "checkpoint", "there is none yet")
    return result


def recover(run_dir: str | Path) -> Path | None:
    """Put in order what a process that was killed left in ``run_dir``; to be called by the only one that writes there.

    Half-written checkpoints are removed; damaged ones newer than the newest whole one are renamed to
    ``damaged-...``, with a line on standard error, so that they are neither counted nor written over.

    Returns:
        The newest whole checkpoint; None where no checkpoint was ever finished.

    Raises:
        InputError: there are checkpoints and none is whole; they are left as they are.
    """
    root = Path(run_dir) / FOLDER
    for left in sorted(root.glob(f".*{_PREFIX}*")):
        name, _, ending = left.name.lstrip(".").partition(".")
        if ending.startswith(("backup-", "delete-")) and not (root / name).exists() and _is_whole(left):
            os.replace(left, root / name)  # it was being replaced or dropped: still a checkpoint
        else:
            shutil.rmtree(left, ignore_errors=True)
    result, damaged = _first_whole(_by_step(Path(run_dir)))
    if result is None and damaged:
        raise damaged[0]
    for error in damaged:
        aside = Path(error.source).with_name(SET_ASIDE + Path(error.source).name)
        shutil.rmtree(aside, ignore_errors=True)
        os.replace(error.source, aside)
        print(f"warning: {error}; put aside as {aside.name}, going on from {result}", file=sys.stderr, flush=True)
    return result


def _by_step(run_dir: Path) -> list[Path]:
    """All checkpoint folders, damaged ones as well, the newest first."""
    result = [p for p in (run_dir / FOLDER).glob(f"{_PREFIX}*") if p.name.removeprefix(_PREFIX).isdigit()]
    return sorted(result, key=lambda p: int(p.name.removeprefix(_PREFIX)), reverse=True)


def _first_whole(candidates: list[Path]) -> tuple[Path | None, list[InputError]]:
    """The first that passes :func:`verify`, and what was wrong with those before it (``source`` is the folder)."""
    damaged = []
    for folder in candidates:
        try:
            verify(folder)
        except InputError as error:
            damaged.append(InputError(folder, error.field, error.cause))
        else:
            return folder, damaged
    return None, damaged


def _is_whole(folder: Path) -> bool:
    return _first_whole([folder])[0] is not None


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
