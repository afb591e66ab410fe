"""Where a stream's results go: the WebSocket, a file of the motion, a file of the forecasts."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.inference.stream import messages
from egopose.inference.stream.broadcast import Broadcast, ServerSettings
from egopose.inference.stream.forecast_recording import ForecastRecording
from egopose.inference.stream.forecasting import ForecastSink
from egopose.inference.stream.frame_sources import SourceSettings
from egopose.inference.stream.live_body import LivePose
from egopose.inference.stream.live_forecasts import ForecastSettings, LiveForecast
from egopose.inference.stream.loop import PoseSink, StatusSink
from egopose.inference.stream.recording import Recording


@dataclass(frozen=True)
class Sinks:
    """What a loop tells its results; ``port`` is the WebSocket's, None without one."""

    on_pose: PoseSink
    on_status: StatusSink
    on_forecast: ForecastSink
    port: int | None


def check_outputs(values: Mapping[str, Any]) -> ServerSettings:
    """The server's settings; raises InputError for what would be refused only once everything else is loaded."""
    for name, path in (("out", values["out"]), ("forecast.out", values["forecast"]["out"])):
        if path is not None and Path(str(path)).suffix != ".npz":
            raise InputError(str(path), name, "is written as .npz: give a name that ends so")
    return from_mapping(ServerSettings, values["server"], "conf/stream.yaml: server")


def open_outputs(
    values: Mapping[str, Any],
    humanoid: HumanoidModel,
    source: SourceSettings,
    forecast: ForecastSettings | None,
    stack: contextlib.ExitStack,
) -> Sinks:
    """The WebSocket and files that ``conf/stream.yaml``, resolved, asks for; closed by ``stack``.

    Raises:
        InputError: a file cannot be written, or the address not be listened at.
    """
    server = check_outputs(values)
    skeleton, fps = humanoid.skeleton, 1.0 / humanoid.control_dt
    recording, forecasts, broadcast = None, None, None
    if values["out"] is not None:
        recording = Recording(Path(str(values["out"])), skeleton, fps)
        stack.callback(recording.close)
    if forecast is not None and values["forecast"]["out"] is not None:
        forecasts = ForecastRecording(Path(str(values["forecast"]["out"])), skeleton, fps, forecast)
        stack.callback(forecasts.close)
    if server.port is not None:
        greeting = messages.hello(skeleton, fps, int(values["lookahead"]), source.label, forecast)
        broadcast = Broadcast(server, greeting)
        stack.callback(broadcast.close)
        print(f"ws://{server.host}:{broadcast.port}/json and /binary", file=sys.stderr, flush=True)
    broken = False

    def on_pose(pose: LivePose, delay_ms: float) -> None:
        if recording is not None:
            recording.pose(pose)
        if broadcast is not None and (kinds := broadcast.kinds):
            text = messages.frame_json(pose, fps, delay_ms) if False in kinds else None
            binary = messages.frame_binary(pose, fps, delay_ms) if True in kinds else None
            broadcast.send(text, binary)

    def on_status(status: dict[str, Any]) -> None:
        nonlocal broken
        if status["broken"] != broken:
            broken = status["broken"]
            what = "gives no picture, trying again" if broken else "is back"
            print(f"{source.label} {what}", file=sys.stderr, flush=True)
        if broadcast is not None:
            broadcast.send(messages.status({**status, "clients_dropped": broadcast.dropped}))

    def on_forecast(forecast: LiveForecast, delay_ms: float) -> None:
        if forecasts is not None:
            forecasts.forecast(forecast, delay_ms)
        if broadcast is not None and (kinds := broadcast.kinds):
            text = messages.forecast_json(forecast, fps, delay_ms) if False in kinds else None
            binary = messages.forecast_binary(forecast, fps, delay_ms) if True in kinds else None
            broadcast.send(text, binary)

    return Sinks(on_pose, on_status, on_forecast, None if broadcast is None else broadcast.port)
