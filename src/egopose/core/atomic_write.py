"""Small files that are there whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """A file to write bytes into; it takes the place of ``path`` when the block ends without an error.

    Raises:
        OSError: the disk is full, or the folder cannot be written to; nothing is left beside ``path``.
    """
    part = path.with_name(f".{path.name}.part-{uuid.uuid4().hex}")
    try:
        with part.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_text_whole(path: Path, text: str) -> None:
    """Write beside ``path``, flush to the disk, rename: whenever the process ends, the old text is there or the new.

    Raises:
        OSError: the disk is full, or the folder cannot be written to; nothing is left beside ``path``.
    """
    with written_whole(path) as stream:
        stream.write(text.encode())
