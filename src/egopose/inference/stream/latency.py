"""What each stage of a frame costs, and its percentiles, in memory of a fixed size."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

PERCENTILES = (50, 95, 99)


class LatencyTable:
    """Seconds a stage and frame, of the last ``capacity`` frames.

    Between :meth:`begin` and :meth:`end` each :meth:`lap` adds the time since the lap before to its stage.

    Args:
        stages: names.
        capacity: frames remembered; all of the memory is taken at once.
        totals: names of the sum of the stages, and of the time from a frame's arrival to its end.
    """

    def __init__(self, stages: Sequence[str], capacity: int, totals: tuple[str, str] = ("compute", "delay")) -> None:
        self.stages = (*stages, *totals)
        self._column = {name: i for i, name in enumerate(self.stages)}
        self._rows = np.full((capacity, len(self.stages)), np.nan, dtype=np.float32)
        self._row = np.zeros(len(self.stages))
        self._last = 0.0
        #: Frames recorded, those forgotten included.
        self.frames = 0

    def begin(self) -> None:
        """A frame begins."""
        self._row[:] = 0.0
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """All since the last call belongs to ``stage``."""
        now = time.perf_counter()
        self._row[self._column[stage]] += now - self._last
        self._last = now

    def end(self, arrived: float) -> None:
        """The frame is done; its delay is counted from ``arrived`` (s, ``time.perf_counter``)."""
        self._row[-2] = self._row[:-2].sum()
        self._row[-1] = self._last - arrived
        self._rows[self.frames % len(self._rows)] = self._row
        self.frames += 1

    def percentiles_ms(self, last: int | None = None) -> dict[str, dict[str, float]]:
        """``{stage: {"p50_ms": ..., "p95_ms": ..., "p99_ms": ...}}`` of the ``last`` frames; empty without any.

        None for all that are remembered: of an hour that takes as long as several frames.
        """
        count = min(self.frames, len(self._rows) if last is None else min(last, len(self._rows)))
        if not count:
            return {}
        rows = self._rows[np.arange(self.frames - count, self.frames) % len(self._rows)]
        table = 1e3 * np.percentile(rows, PERCENTILES, axis=0)
        names = [f"p{p}_ms" for p in PERCENTILES]
        return {
            stage: dict(zip(names, column.tolist(), strict=True))
            for stage, column in zip(self.stages, table.T, strict=True)
        }
