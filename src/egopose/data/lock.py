"""One process at a time writes to a store."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def store_lock(root: Path) -> Iterator[None]:
    """Hold the exclusive lock of the store in ``root``: the file ``<root>.lock`` beside it.

    Waits, and says so in one line on standard error, while another process holds it. The system releases it when its
    holder ends, however it ends. A store in a folder that cannot be written to is read without a lock.
    """
    if root.is_dir() and not os.access(root.parent, os.W_OK):
        yield
        return

    root.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(root.with_name(root.name + ".lock"))
    try:
        held = lock.acquire(blocking=False)
    except Timeout:
        print(f"waiting: another process is at work on the store {root}", file=sys.stderr, flush=True)
        held = lock.acquire()
    with held:
        yield
