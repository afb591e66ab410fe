"""One process at a time writes to a store."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def store_lock(root: Path) -> Iterator[None]:
    """Hold the exclusive lock of the store in ``root``: the file ``<root>.lock`` beside it.

    Waits, and says so in one line on standard error, while another process holds it. The system releases it when its
    holder ends, however it ends; the empty file stays, since removing it would let two processes lock two files. A
    store in a folder that cannot be written to is read without a lock, and so is any on Windows, which has no flock.
    """
    if sys.platform == "win32" or (root.is_dir() and not os.access(root.parent, os.W_OK)):
        yield
        return

    root.parent.mkdir(parents=True, exist_ok=True)
    with root.with_name(root.name + ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"waiting: another process is at work on the store {root}", file=sys.stderr, flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
