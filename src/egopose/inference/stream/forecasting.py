"""Forecasts beside a live stream, on a thread of their own.

The rule: a forecast is due every so many control frames. Where the one before is not finished then, the due one is
skipped and counted; the next is due one period later. One moment at most is handed over, so that no queue can grow.
At ``pace=every``, where nothing is skipped, the stream waits instead.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.live_forecasts import LiveForecast, LiveFutures, Moment
from egopose.motion.rotations import Array

#: Told a forecast and how long it took from when it was due (ms), on the forecasts' thread.
ForecastSink = Callable[[LiveForecast, float], None]


class ForecastThread:
    """From the live loop's frames to forecasts.

    Args:
        futures: what rolls them out; the thread's alone from :meth:`start` on.
        every: control frames between forecasts.
        lookahead: frames that a pose is behind what was seen.
        latency: where times are kept.
        patient: wait where a forecast is not finished, and skip none.

    Attributes:
        every: see above.
        made: forecasts told.
        skipped: forecasts not begun because the one before was not finished.
    """

    def __init__(
        self, futures: LiveFutures, every: int, lookahead: int, latency: LatencyTable, patient: bool = False
    ) -> None:
        self.forecasts, self.latency = futures, latency
        self.made = self.skipped = 0
        self.every, self._patient = every, patient
        self._flow: deque[tuple[int, NDArray[np.float32]]] = deque(maxlen=futures.context + lookahead)
        self._due = 0
        self._changed = threading.Condition()
        self._moment: Moment | None = None
        self._closed = False
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None

    def start(self, sink: ForecastSink) -> None:
        """Begin to wait for moments; ``sink`` is told the forecasts."""
        self._thread = threading.Thread(target=self._work, args=(sink,), name="forecasts", daemon=True)
        self._thread.start()

    def see(self, frame: int, flow: NDArray[np.float32]) -> None:
        """Remember the flow ``[2, S, S]`` of a control frame. If frames are missing, the past starts again."""
        if self._flow and self._flow[-1][0] != frame - 1:
            self._flow.clear()
        self._flow.append((frame, flow))

    def offer(self, frame: int, qpos: Array, qvel: Array) -> None:
        """Begin a forecast at the body's state at ``frame`` where one is due and its past is known. Copies are taken.

        Raises:
            Exception: what ended the thread.
        """
        if self._error is not None:
            raise self._error
        first = frame - self.forecasts.context + 1
        if frame < self._due or not self._flow or self._flow[0][0] > first:
            return
        self._due = frame + self.every
        with self._changed:
            if self._patient:
                self._changed.wait_for(lambda: self._moment is None or self._closed)
            if self._moment is not None:
                self.skipped += 1
                return
            past = np.stack([flow for number, flow in self._flow if first <= number <= frame])
            self._moment = Moment(frame, qpos.copy(), qvel.copy(), past, time.perf_counter())
            self._changed.notify_all()

    def close(self) -> None:
        """Let the last forecast end.

        Raises:
            Exception: what ended the thread.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _work(self, sink: ForecastSink) -> None:
        try:
            while (moment := self._next()) is not None:
                self.latency.begin()
                forecast = self.forecasts.roll(moment, self.latency.lap)
                sink(forecast, 1e3 * (time.perf_counter() - moment.handed))
                self.latency.lap("forecast_output")
                self.latency.end(moment.handed)
                self.made += 1
                self._done()
        except Exception as error:  # told to the live loop, which ends with it
            self._error = error
            with self._changed:
                self._closed = True
            self._done()

    def _next(self) -> Moment | None:
        """The moment handed over; it stays in its place, which is taken until its forecast is done."""
        with self._changed:
            self._changed.wait_for(lambda: self._moment is not None or self._closed)
            return self._moment

    def _done(self) -> None:
        with self._changed:
            self._moment = None
            self._changed.notify_all()
