"""From an MP4 to visual features, beside decoding the video alone."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.vision.encoders import build_encoder
from egopose.vision.features import encode, extract_flow
from egopose.vision.flow import FlowConfig
from egopose.vision.video import VideoWriter

_FRAMES = 600  # 20 s at 30 Hz: starting the threads no longer weighs


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """MP4 -> frames -> optical flow -> encoder, in frames/s, beside OpenCV's decoder on the same file.

    The video is a textured plane that a camera pans and rolls over, of the size the configuration renders. The encoder
    has not been trained: its weights' values cost nothing.

    Args:
        overrides: of the training configuration (``vision=resnet18``).
        rounds: of decoding, flow and encoding in turn; the median counts.

    Returns:
        ``ratio`` (the median round's frames/s of the whole way over those of decoding), ``frames_per_s`` (whole way),
        ``decode_frames_per_s``, ``flow_frames_per_s`` (MP4 to stored flow), ``encode_frames_per_s`` (stored flow to
        features), ``frames``, ``size`` (pixels), ``vision`` (the encoder), ``flow_workers``, ``encode_threads``,
        ``rounds``.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    config = compose_config("train", overrides)
    vision = config["vision"]
    size, flow_config = int(vision["video"]["size"]), FlowConfig(**vision["flow"])
    encoder, batch = build_encoder(vision["encoder"]), int(vision["encode_batch"])
    threads = int(config["collector"]["update_threads"])
    torch.set_num_threads(threads)
    decode, flow_rates, encode_rates, whole = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pan.mp4"
        write_pan(path, size, _FRAMES, float(vision["video"]["fps"]))
        encode(encoder, extract_flow(path, flow_config, count=min(batch, _FRAMES)), batch)
        for _ in range(rounds):
            decoding, frames = _timed(lambda: _decode(path))
            flowing, flow = _timed(lambda: extract_flow(path, flow_config))
            encoding, features = _timed(lambda flow=flow: encode(encoder, flow, batch))  # type: ignore[misc]
            if not frames == len(flow) == len(features):
                raise InputError(path, "frames", f"{frames} decoded, {len(flow)} of flow, {len(features)} of features")
            decode.append(frames / decoding)
            flow_rates.append(frames / flowing)
            encode_rates.append(frames / encoding)
            whole.append(frames / (flowing + encoding))
    return {
        "ratio": statistics.median(a / b for a, b in zip(whole, decode, strict=True)),
        "frames_per_s": statistics.median(whole),
        "decode_frames_per_s": statistics.median(decode),
        "flow_frames_per_s": statistics.median(flow_rates),
        "encode_frames_per_s": statistics.median(encode_rates),
        "frames": _FRAMES,
        "size": size,
        "vision": str(vision["encoder"]["kind"]),
        "flow_workers": flow_config.workers,
        "encode_threads": threads,
        "rounds": rounds,
    }


def write_pan(path: Path, size: int, frames: int, fps: float) -> None:
    """A video ``[frames, size, size]`` of a camera that pans and rolls over a plane of blurred noise."""
    generator = np.random.default_rng(0)
    noise = generator.integers(0, 256, (4 * size, 4 * size, 3), dtype=np.uint8)
    plane = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), size / 40), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    middle = 2 * size
    with VideoWriter(path, fps) as video:
        for t in np.arange(frames) / fps:
            turn = cv2.getRotationMatrix2D((middle, middle), 10 * np.sin(2 * t), 1.0)
            turn[:, 2] += [size * np.sin(1.3 * t) - 1.5 * size, 0.5 * size * np.sin(3.1 * t) - 1.5 * size]
            video.write(cv2.warpAffine(plane, turn, (size, size)).astype(np.uint8, copy=False))


def _decode(path: Path) -> int:
    capture, frames = cv2.VideoCapture(str(path)), 0
    while capture.read()[0]:
        frames += 1
    capture.release()
    return frames


def _timed(act: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = act()
    return time.perf_counter() - start, result
