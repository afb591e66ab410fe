"""Checkpoints: a folder of memory-mapped tensors and JSON, without pickle, that refuses what does not match.

The layout is TorchRL's ``torchrl.checkpoint.Checkpoint`` in its directory format (so ``torchrl.render.load_checkpoint``
and TorchRL's own tools read it), with SHA-256 checksums added::

    manifest.json        TorchRL's: versions, components; our schema, task and counters under "metadata"
    checksums.json       {file: sha256} over every other file
    components/NNNN-policy/{state.json, state/*.memmap} ...

Components: ``policy critic policy_optimizer value_optimizer transforms rng simulation trainer_state config``.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from egopose.core import safe_io
from egopose.core.errors import InputError

CHECKSUMS = "checksums.json"


def seal(folder: Path) -> None:
    """Write the checksums of all files of ``folder``, for :func:`check_files`."""
    (folder / CHECKSUMS).write_text(json.dumps(_checksums(folder), indent=1, sort_keys=True))


def check_files(folder: Path) -> None:
    """Compare every file of ``folder`` with the checksums written beside it.

    Raises:
        InputError: a file is missing, added or altered.
    """
    expected = safe_io.read_json(folder / CHECKSUMS, CHECKSUMS)
    if not isinstance(expected, dict):
        raise InputError(folder, CHECKSUMS, "cannot be read: is no object")
    result = _checksums(folder)
    for name in sorted(set(expected) | set(result)):
        if name not in result:
            raise InputError(folder, name, "is missing: the checkpoint is damaged")
        if name not in expected:
            raise InputError(folder, name, "does not belong to the checkpoint")
        if expected[name] != result[name]:
            raise InputError(folder, name, "does not match its checksum: the checkpoint is damaged")


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file() and p.name != CHECKSUMS)


def _checksums(folder: Path) -> dict[str, str]:
    out = {}
    for file in _files(folder):
        with file.open("rb") as stream:
            out[file.relative_to(folder).as_posix()] = hashlib.file_digest(stream, "sha256").hexdigest()
    return out
