"""Checksums of a folder's files, kept beside them in ``checksums.json``: {file: SHA-256} over every other file."""

from __future__ import annotations

import json
from pathlib import Path

from egopose.core import safe_io
from egopose.core.errors import InputError
from egopose.core.file_digests import sha256_of

CHECKSUMS = "checksums.json"


def seal(folder: Path) -> None:
    """Write the checksums of all files of ``folder``, for :func:`check_files`."""
    (folder / CHECKSUMS).write_text(json.dumps(_checksums(folder), indent=1, sort_keys=True))


def check_files(folder: Path) -> None:
    """Compare every file of ``folder`` with the checksums written beside it; a file is read once a process.

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
    return {file.relative_to(folder).as_posix(): sha256_of(file) for file in _files(folder)}
