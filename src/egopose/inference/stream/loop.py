"""The live loop: one thread reads the source, this one does the rest, frame by frame, and never falls behind.

The rule for late frames: only the newest frame waits (:class:`NewestFrame`). A skipped frame has no flow of its own.
The control frames between two used frames share the flow between these evenly, so the body stays in step with time. If
more than ``bridge`` frames are missing, the rest are skipped.

Forecasts have a thread of their own (:class:`ForecastThread`), which is handed copies and never waited for.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from egopose.inference.causal import CausalRegression
from egopose.inference.stream.clock import ControlClock
from egopose.inference.stream.forecasting import ForecastSink, ForecastThread
from egopose.inference.stream.frame_features import FrameFeatures
from egopose.inference.stream.frame_sources import SourceSettings, capture
from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.live_body import LiveBody, LivePose
from egopose.inference.stream.memory import MemoryTrace
from egopose.inference.stream.newest_frame import Captured, NewestFrame

#: In the order in which a frame passes them.
STAGES = ("flow", "encoder", "context", "policy", "planner", "physics", "output")

#: Told a pose and how late it is (ms, from its last frame's arrival).
PoseSink = Callable[[LivePose, float], None]
#: Told the status once a second.
StatusSink = Callable[[dict[str, Any]], None]

_STATUS_EVERY = 1.0  # s
_STATUS_FRAMES = 300  # whose latencies a status tells


@dataclass(frozen=True)
class LoopSettings:
    """Of ``conf/stream.yaml``.

    Args:
        seconds: stop after this long; None for the source's end.
        bridge: control frames without a picture that are filled in at most.
        plan_until: s from a picture's arrival at which a planner must stop; None for never.
    """

    seconds: float | None
    bridge: int
    plan_until: float | None = None


@dataclass
class Counts:
    """Of frames.

    Attributes:
        used: pictures that were estimated from.
        surplus: pictures of a camera quicker than the control rate.
        bridged: control frames without a picture, filled in.
        lost: control frames jumped over.
        poses: given out.
        resets: of them, placed anew by the fail-safe.
    """

    used: int = 0
    surplus: int = 0
    bridged: int = 0
    lost: int = 0
    poses: int = 0
    resets: int = 0


class LiveLoop:
    """One stream from its first frame to its last.

    Args:
        source: what to read.
        sight: frames to visual features.
        regression: visual features to what the policy needs.
        body: the humanoid.
        latency: where times are kept; the table that ``body`` tells its laps.
        rate: control frames a second.
        settings: see :class:`LoopSettings`.
        forecasts: beside it, or None.
    """

    def __init__(
        self,
        source: SourceSettings,
        sight: FrameFeatures,
        regression: CausalRegression,
        body: LiveBody,
        latency: LatencyTable,
        rate: float,
        settings: LoopSettings,
        forecasts: ForecastThread | None = None,
    ) -> None:
        self._source, self._sight, self._regression, self._body = source, sight, regression, body
        self._settings, self._forecasts = settings, forecasts
        self._newest, self._clock = NewestFrame(), ControlClock(rate)
        self.latency, self.memory, self.counts = latency, MemoryTrace(), Counts()
        self._frame = -1
        self._began = self._told = time.perf_counter()

    def run(
        self,
        on_pose: PoseSink,
        on_status: StatusSink,
        stop: threading.Event | None = None,
        on_forecast: ForecastSink = lambda forecast, delay_ms: None,
    ) -> dict[str, Any]:
        """Until the source ends, the time is over, or ``stop`` is set (by another thread).

        Args:
            on_pose, on_status: told on the thread that calls.
            stop: see above.
            on_forecast: told on the forecasts' thread, for the last time before this returns.

        Returns:
            The last status, see :meth:`status`.

        Raises:
            InputError: the source cannot be read.
        """
        stop = stop or threading.Event()
        arguments = (self._source, self._newest, stop)
        reader = threading.Thread(target=capture, args=arguments, name="capture", daemon=True)
        reader.start()
        if self._forecasts is not None:
            self._forecasts.start(on_forecast)
        self._began = self._told = time.perf_counter()
        try:
            while not stop.is_set() and not self._over():
                captured = self._newest.take(_STATUS_EVERY)
                if captured is not None:
                    self._use(captured, on_pose)
                elif self._newest.ended:
                    self._drain(on_pose)
                    break
                self._tell(on_status)
        finally:
            stop.set()
            self._newest.close()
            # A camera that hangs in its driver must not keep the program: the thread ends with it.
            reader.join(timeout=2.0)
            if self._forecasts is not None:
                self._forecasts.close()
        return self.status()

    def status(self, last: int | None = None) -> dict[str, Any]:
        """``seconds`` since the start, the counts, those of :attr:`LiveBody.plans`, ``dropped`` (late pictures),
        ``reconnects`` and ``broken`` of the source, ``forecasts`` and ``forecasts_skipped``, ``fps`` (pictures used a
        second), ``stages`` (of the ``last`` frames, see :meth:`LatencyTable.percentiles_ms`) and memory (see
        :meth:`MemoryTrace.report`)."""
        seconds = time.perf_counter() - self._began
        beside = self._forecasts
        stages = self.latency.percentiles_ms(last)
        if beside is not None:
            stages |= beside.latency.percentiles_ms(None if last is None else max(last // beside.every, 1))
        return {
            "seconds": seconds,
            **vars(self.counts),
            **self._body.plans,
            "dropped": self._newest.dropped,
            "reconnects": self._newest.reconnects,
            "broken": self._newest.broken,
            "forecasts": 0 if beside is None else beside.made,
            "forecasts_skipped": 0 if beside is None else beside.skipped,
            "fps": self.counts.used / max(seconds, 1e-9),
            "stages": stages,
            **self.memory.report(),
        }

    def _over(self) -> bool:
        limit = self._settings.seconds
        return limit is not None and time.perf_counter() - self._began >= limit

    def _use(self, captured: Captured, on_pose: PoseSink) -> None:
        intervals = self._clock.intervals(captured.time)
        if not intervals:
            self.counts.surplus += 1
            return
        steps = min(intervals, self._settings.bridge + 1)
        self.counts.used += 1
        self.counts.bridged += steps - 1
        self.counts.lost += intervals - steps
        self._frame += intervals - steps
        latency = self.latency
        latency.begin()
        flow = self._sight.flow(captured.image, captured.time)
        latency.lap("flow")
        features = self._sight.features(flow)
        latency.lap("encoder")
        until = self._settings.plan_until
        deadline = math.inf if until is None else captured.arrived + until
        for _ in range(steps):
            self._frame += 1
            if self._forecasts is not None:
                self._forecasts.see(self._frame, flow)
            seen = self._regression.push(self._frame, features)
            latency.lap("context")
            if seen is not None:
                self._give(self._body.advance(seen, deadline), on_pose, 1e3 * (time.perf_counter() - captured.arrived))
                latency.lap("output")
        latency.end(captured.arrived)

    def _drain(self, on_pose: PoseSink) -> None:
        for seen in self._regression.drain():
            self._give(self._body.advance(seen), on_pose, 0.0)

    def _give(self, pose: LivePose, on_pose: PoseSink, delay_ms: float) -> None:
        self.counts.poses += 1
        self.counts.resets += pose.reset
        if self._forecasts is not None:
            self._forecasts.offer(pose.frame, *self._body.state())
        on_pose(pose, delay_ms)

    def _tell(self, on_status: StatusSink) -> None:
        now = time.perf_counter()
        if now - self._told >= _STATUS_EVERY:
            self._told = now
            self.memory.sample(now - self._began)
            on_status(self.status(_STATUS_FRAMES))
