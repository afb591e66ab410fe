"""How a process's memory goes over time, in memory of a fixed size."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np

_STATM = Path("/proc/self/statm")
_MB = 1 / 2**20

# Samples kept; when there are more every other is forgotten, so that the rest reach over the whole time.
_KEPT = 512


class MemoryTrace:
    """Resident memory against time. Only Linux tells it (elsewhere all is None)."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []
        self._every, self._asked = 1, 0

    def sample(self, seconds: float) -> None:
        """Look now, ``seconds`` into the run; to be called at even intervals."""
        self._asked += 1
        if not _STATM.is_file() or self._asked % self._every:
            return
        self._samples.append((seconds, int(_STATM.read_text().split()[1]) * resource.getpagesize() * _MB))
        if len(self._samples) > _KEPT:
            self._samples = self._samples[1::2]
            self._every *= 2

    def report(self) -> dict[str, float | None]:
        """``rss_mb`` at the end, ``rss_growth_mb`` over the last half, ``rss_slope_mb_per_hour`` of a line through it.

        The first half is left out: caches fill and the allocator settles.
        """
        half = self._samples[len(self._samples) // 2 :]
        if len(half) < 2:
            return {"rss_mb": None, "rss_growth_mb": None, "rss_slope_mb_per_hour": None}
        times, sizes = np.array(half).T
        return {
            "rss_mb": float(sizes[-1]),
            "rss_growth_mb": float(sizes[-1] - sizes[0]),
            "rss_slope_mb_per_hour": float(np.polyfit(times / 3600, sizes, 1)[0]),
        }
