"""The memory of a process over time, recorded in a fixed size."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np

_STATM = Path("/proc/self/statm")
_MB = 1 / 2**20

# Samples kept; when there are more every other is forgotten, so that the rest reach over the whole time.
_KEPT = 512


class MemoryTrace:
    """Resident memory against time. It is known on Linux only; elsewhere all values are None."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []
        self._every, self._asked = 1, 0
        self._first: float | None = None

    def sample(self, seconds: float) -> None:
        """Look now, ``seconds`` into the run; to be called at even intervals."""
        self._asked += 1
        if not _STATM.is_file() or self._asked % self._every:
            return
        size = int(_STATM.read_text().split()[1]) * resource.getpagesize() * _MB
        self._first = self._first or size
        self._samples.append((seconds, size))
        if len(self._samples) > _KEPT:
            self._samples = self._samples[1::2]
            self._every *= 2

    def report(self) -> dict[str, float | None]:
        """``rss_start_mb`` at the first look, ``rss_mb`` at the last; ``rss_growth_mb`` over the last half of the time,
        ``rss_slope_mb_per_hour`` of a line through it.

        The first half is left out of these: caches fill and the allocator settles.
        """
        half = self._samples[len(self._samples) // 2 :]
        growth = slope = None
        if len(half) > 1:
            times, sizes = np.array(half).T
            growth, slope = float(sizes[-1] - sizes[0]), float(np.polyfit(times / 3600, sizes, 1)[0])
        return {
            "rss_start_mb": self._first,
            "rss_mb": half[-1][1] if half else None,
            "rss_growth_mb": growth,
            "rss_slope_mb_per_hour": slope,
        }
