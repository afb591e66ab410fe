"""What goes over the wire, see docs/howto-stream.md: JSON text for all, or a binary message for each frame.

A binary frame is little-endian: ``4s`` magic, ``u2`` version, ``u2`` flags, ``u8`` frame, ``f8`` time (s), ``f4``
value, ``f4`` confidence (NaN where there are none), ``f4`` delay (ms), ``u4`` n, then n ``f4``: qpos.

A binary forecast: ``4s`` magic, ``u2`` version, ``u2`` flags, ``u8`` frame, ``f8`` time (s), ``f4`` delay (ms), ``i4``
fallen (-1 for none), ``u4`` H, ``u4`` n, ``u4`` m (0 where no bands are), then ``f4``: qpos ``[H, n]``, low ``[H, m]``,
high ``[H, m]``.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.inference.stream.live_body import LivePose
from egopose.inference.stream.live_forecasts import ForecastSettings, LiveForecast
from egopose.motion.io.native import skeleton_to_json
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

VERSION = 1
MAGIC = b"EGOP"
FLAG_RESET = 1
MAGIC_FORECAST = b"EGOF"
FLAG_DIVERGED = 1

_HEADER = struct.Struct("<4sHHQdfffI")
_FORECAST = struct.Struct("<4sHHQdfiIII")

# Of a forecast's numbers in text, m and rad: a tenth of a millimetre. It sends thousands.
_DECIMALS = 4


def hello(skeleton: Skeleton, fps: float, lookahead: int, source: str, forecast: ForecastSettings | None = None) -> str:
    """The first message: what the numbers of the others mean."""
    names = ("every", "horizon", "samples", "level")
    return json.dumps(
        {
            "type": "hello",
            "version": VERSION,
            "fps": fps,
            "lookahead": lookahead,
            "source": source,
            "forecast": None if forecast is None else {name: getattr(forecast, name) for name in names},
            "units": {"length": "m", "angle": "rad", "up": "z", "quaternion": "wxyz"},
            "skeleton": skeleton_to_json(skeleton),
        }
    )


def frame_json(pose: LivePose, fps: float, delay_ms: float) -> str:
    """A frame as text; numbers rounded to what a float32 holds."""
    return json.dumps(
        {
            "type": "frame",
            "frame": pose.frame,
            "time": round(pose.frame / fps, 6),
            "qpos": [float(f"{x:.7g}") for x in pose.qpos],
            "value": pose.value,
            "confidence": pose.confidence,
            "reset": pose.reset,
            "delay_ms": round(delay_ms, 3),
        }
    )


def frame_binary(pose: LivePose, fps: float, delay_ms: float) -> bytes:
    """A frame in bytes, see the module."""
    value, confidence = (math.nan if x is None else x for x in (pose.value, pose.confidence))
    flags = FLAG_RESET * pose.reset
    count = len(pose.qpos)
    head = _HEADER.pack(MAGIC, VERSION, flags, pose.frame, pose.frame / fps, value, confidence, delay_ms, count)
    return head + pose.qpos.astype("<f4").tobytes()


def read_frame_binary(message: bytes) -> dict[str, Any]:
    """The fields of a binary frame, ``qpos [n]`` float32 among them, for clients written in Python.

    Raises:
        InputError: it is none.
    """
    if len(message) < _HEADER.size or message[:4] != MAGIC:
        raise InputError("stream", "message", "not a binary frame")
    _, version, flags, frame, time, value, confidence, delay, count = _HEADER.unpack_from(message)
    if version != VERSION or len(message) != _HEADER.size + 4 * count:
        raise InputError("stream", "message", f"of version {version} with {len(message)} bytes: not understood")
    return {
        "frame": frame,
        "time": time,
        "value": value,
        "confidence": confidence,
        "reset": bool(flags & FLAG_RESET),
        "delay_ms": delay,
        "qpos": np.frombuffer(message, "<f4", count, _HEADER.size),
    }


def forecast_json(forecast: LiveForecast, fps: float, delay_ms: float) -> str:
    """A forecast as text: its mean future and its bands."""
    bands = (forecast.low, forecast.high) if len(forecast.low) else (None, None)
    low, high = (None if edge is None else _rounded(edge) for edge in bands)
    return json.dumps(
        {
            "type": "forecast",
            "frame": forecast.frame,
            "time": round(forecast.frame / fps, 6),
            "qpos": _rounded(forecast.qpos),
            "low": low,
            "high": high,
            "fallen": forecast.fallen,
            "diverged": forecast.diverged,
            "delay_ms": round(delay_ms, 3),
        }
    )


def _rounded(values: Array) -> list[Any]:
    return list(np.round(values, _DECIMALS).tolist())


def forecast_binary(forecast: LiveForecast, fps: float, delay_ms: float) -> bytes:
    """A forecast in bytes, see the module."""
    horizon, width = forecast.qpos.shape
    banded = forecast.low.shape[1] if len(forecast.low) else 0
    fallen = -1 if forecast.fallen is None else forecast.fallen
    flags, frame = FLAG_DIVERGED * forecast.diverged, forecast.frame
    head = _FORECAST.pack(MAGIC_FORECAST, VERSION, flags, frame, frame / fps, delay_ms, fallen, horizon, width, banded)
    return head + b"".join(part.astype("<f4").tobytes() for part in (forecast.qpos, forecast.low, forecast.high))


def read_forecast_binary(message: bytes) -> dict[str, Any]:
    """The fields of a binary forecast, ``qpos [H, n]``, ``low`` and ``high [H, m]`` (None without bands) among them.

    Raises:
        InputError: it is none.
    """
    if len(message) < _FORECAST.size or message[:4] != MAGIC_FORECAST:
        raise InputError("stream", "message", "not a binary forecast")
    _, version, flags, frame, time, delay, fallen, horizon, width, banded = _FORECAST.unpack_from(message)
    if version != VERSION or len(message) != _FORECAST.size + 4 * horizon * (width + 2 * banded):
        raise InputError("stream", "message", f"of version {version} with {len(message)} bytes: not understood")
    values = np.frombuffer(message, "<f4", offset=_FORECAST.size)
    qpos, low, high = np.split(values, [horizon * width, horizon * (width + banded)])
    return {
        "frame": frame,
        "time": time,
        "delay_ms": delay,
        "fallen": None if fallen < 0 else fallen,
        "diverged": bool(flags & FLAG_DIVERGED),
        "qpos": qpos.reshape(horizon, width),
        "low": low.reshape(horizon, banded) if banded else None,
        "high": high.reshape(horizon, banded) if banded else None,
    }


def status(values: dict[str, Any]) -> str:
    """Counts and latencies, once a second; ``end`` among ``values`` tells that no more frames follow."""
    return json.dumps({"type": "status", **values})
