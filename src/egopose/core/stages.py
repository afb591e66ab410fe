"""Stages of a long command whose results stay: what is there and still fits is not made again.

A stage's files appear when it has ended, then a card with a fingerprint of what went in and the SHA-256 of each file.
A stage whose card fits and whose files are as it left them is done.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.core.file_digests import sha256_of
from egopose.core.safe_io import read_json

_CARDS = "stages"


class StageFolder:
    """A folder of stages' results.

    Args:
        folder: made where it is missing.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / _CARDS).mkdir(parents=True, exist_ok=True)

    def done(self, name: str, inputs: Mapping[str, Any]) -> bool:
        """Whether the stage was made from these inputs and its files are as it left them."""
        card = self._card(name)
        return card is not None and card["inputs"] == fingerprint(inputs) and not self.altered(name)

    def altered(self, name: str) -> bool:
        """Whether a file of the stage is missing or not as the stage left it; False for a stage never made."""
        card = self._card(name)
        if card is None:
            return False
        files = {self.folder / file: digest for file, digest in card["files"].items()}
        return any(not path.is_file() or sha256_of(path) != digest for path, digest in files.items())

    def make(self, name: str, inputs: Mapping[str, Any], write: Callable[[Path], None]) -> None:
        """Run ``write``, which leaves its files in the folder it is given; they come here when it has ended.

        Raises:
            whatever ``write`` raises: the stage then is as it was before.
        """
        part = self.folder / f".{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            write(part)
            files = sorted(path.name for path in part.iterdir())
            digests = {file: sha256_of(part / file) for file in files}
            self._path(name).unlink(missing_ok=True)
            for file in files:
                os.replace(part / file, self.folder / file)
            write_text_whole(self._path(name), json.dumps({"inputs": fingerprint(inputs), "files": digests}, indent=1))
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def digest(self, file: str) -> str:
        """SHA-256 of a file in the folder, for the inputs of a later stage."""
        return sha256_of(self.folder / file)

    def _path(self, name: str) -> Path:
        return self.folder / _CARDS / f"{name}.json"

    def _card(self, name: str) -> dict[str, Any] | None:
        try:
            card = read_json(self._path(name), "stage")
        except InputError:  # none, or damaged: the stage is made again
            return None
        fits = isinstance(card, dict) and isinstance(card.get("inputs"), str) and isinstance(card.get("files"), dict)
        inside = fits and all(isinstance(d, str) and Path(f).name == f for f, d in card["files"].items())
        return card if inside else None


def fingerprint(inputs: Mapping[str, Any]) -> str:
    """SHA-256 of plain values, the same for the same values."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=str).encode()).hexdigest()
