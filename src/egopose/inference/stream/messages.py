"""What goes over the wire, see docs/howto-stream.md: JSON text for all, or a binary message for each frame.

A binary frame is little-endian: ``4s`` magic, ``u2`` version, ``u2`` flags, ``u8`` frame, ``f8`` time (s), ``f4``
value, ``f4`` confidence (NaN where there are none), ``f4`` delay (ms), ``u4`` n, then n ``f4``: qpos.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np

from egopose.errors import InputError
from egopose.inference.stream.body import LivePose
from egopose.motion.io.native import skeleton_to_json
from egopose.motion.skeleton import Skeleton

VERSION = 1
MAGIC = b"EGOP"
FLAG_RESET = 1

_HEADER = struct.Struct("<4sHHQdfffI")


def hello(skeleton: Skeleton, fps: float, lookahead: int, source: str) -> str:
    """The first message: what the numbers of the others mean."""
    return json.dumps(
        {
            "type": "hello",
            "version": VERSION,
            "fps": fps,
            "lookahead": lookahead,
            "source": source,
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


def status(values: dict[str, Any]) -> str:
    """Counts and latencies, once a second; ``end`` among ``values`` tells that no more frames follow."""
    return json.dumps({"type": "status", **values})
