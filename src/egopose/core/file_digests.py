"""SHA-256 of files, worked out once a process for as long as a file stays as it is."""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path

#: ns. File systems stamp changes a few ms apart: the times of a file that was changed this recently do not yet tell
#: whether it was changed again, so its digest is worked out anew.
_SETTLED_AFTER = 100_000_000
_MOST_KNOWN = 100_000

_known: dict[tuple[int, ...], str] = {}


def sha256_of(path: Path) -> str:
    """The file's SHA-256 in hexadecimal digits.

    A file is known again by device, inode, size, and the times of its last change and of its last change of status.
    Only writing to it through a memory map of some file systems (tmpfs) leaves all of these as they were.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        status = os.fstat(stream.fileno())
        identity = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        if (known := _known.get(identity)) is not None:
            return known
        begun = time.time_ns()
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if begun - max(status.st_mtime_ns, status.st_ctime_ns) > _SETTLED_AFTER:
        if len(_known) >= _MOST_KNOWN:
            _known.clear()
        _known[identity] = digest
    return digest
