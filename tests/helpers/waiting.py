"""Waiting for something to happen and not for a time to pass."""

from __future__ import annotations

import time
from collections.abc import Callable

#: s; only a test that fails waits for so long. A busy machine takes ten times as long as an idle one.
PATIENCE = 300.0


def wait_until(condition: Callable[[], object], what: str, meanwhile: Callable[[], object] = lambda: None) -> None:
    """Return once ``condition`` holds, or fail naming ``what``; ``meanwhile`` is called between two looks."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"never happened: {what}"
        meanwhile()
        time.sleep(0.01)
