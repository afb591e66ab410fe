"""Dense optical flow of a video: OpenCV's DIS (Kroeger et al., ECCV 2016), made small for storing.

Flow is in units of the image's width per frame: a point that crosses the whole picture between two frames moved by 1.
It does not depend on the resolution. Channel 0 points right, channel 1 down.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.vision.video import Frame

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


@dataclass(frozen=True)
class FlowConfig:
    """How flow is computed and stored.

    Args:
        preset: of DIS: ``ultrafast``, ``fast`` or ``medium``.
        working_size: side in pixels of the grey square on which DIS runs.
        stored_size: side of the stored flow, a divisor of ``working_size``.
        workers: threads; DIS releases the interpreter's lock.

    Raises:
        InputError: a value that cannot be.
    """

    preset: str
    working_size: int
    stored_size: int
    workers: int = 2

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise InputError("vision.flow", "preset", f"{self.preset!r}; there are {', '.join(PRESETS)}")
        # DIS needs a pyramid of 8-pixel patches.
        if self.working_size < 32:
            raise InputError("vision.flow", "working_size", f"{self.working_size}; at least 32 pixels")
        if self.stored_size < 1 or self.working_size % self.stored_size:
            cause = f"{self.stored_size}; must divide the working size {self.working_size}"
            raise InputError("vision.flow", "stored_size", cause)
        if self.workers < 1:
            raise InputError("vision.flow", "workers", f"{self.workers}; at least 1")


def centred_square(frame: Frame, size: int) -> NDArray[np.uint8]:
    """The centred square of an RGB frame ``[H, W, 3]``, area-averaged to ``[size, size, 3]`` uint8."""
    height, width = frame.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = frame[top : top + side, left : left + side]
    if side == size:
        return square
    # Enlarging by area would give blocks.
    interpolation = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    return cv2.resize(square, (size, size), interpolation=interpolation).astype(np.uint8, copy=False)


def grey_square(frame: Frame, size: int) -> NDArray[np.uint8]:
    """:func:`centred_square` in grey, ``[size, size]`` uint8; shrinking first leaves less to turn grey."""
    return cv2.cvtColor(centred_square(frame, size), cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)


class FlowEstimator:
    """DIS between two grey squares; safe to share among threads, each gets its own DIS."""

    def __init__(self, config: FlowConfig) -> None:
        self.config = config
        self._local = threading.local()

    def __call__(self, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.float16]:
        """Flow ``[2, S, S]`` float16 from ``before`` to ``after``, both ``[W, W]`` uint8 (W working, S stored size)."""
        if not hasattr(self._local, "dis"):
            self._local.dis = cv2.DISOpticalFlow.create(PRESETS[self.config.preset])
        dense = self._local.dis.calc(before, after, None)
        stored = self.config.stored_size
        if stored != self.config.working_size:
            dense = cv2.resize(dense, (stored, stored), interpolation=cv2.INTER_AREA)
        return (dense.transpose(2, 0, 1) / self.config.working_size).astype(np.float16)


def flow_of_frames(frames: Iterable[Frame], config: FlowConfig) -> Iterator[NDArray[np.float16]]:
    """Flow ``[2, S, S]`` of each frame of a video, in order; frame t's is from t-1 to t, the first's is zero.

    Reading runs ahead of the flow by a few frames only, so a video of any length takes little memory.
    """
    estimator = FlowEstimator(config)

    def flow(before: Future[NDArray[np.uint8]], after: Future[NDArray[np.uint8]]) -> NDArray[np.float16]:
        # Both were handed to the pool earlier and threads take jobs in order: this waits, but never for ever.
        return estimator(before.result(), after.result())

    pending: deque[Future[NDArray[np.float16]]] = deque()
    with ThreadPoolExecutor(config.workers) as pool:
        before: Future[NDArray[np.uint8]] | None = None
        for frame in frames:
            after = pool.submit(grey_square, frame, config.working_size)
            if before is None:
                yield np.zeros((2, config.stored_size, config.stored_size), np.float16)
            else:
                pending.append(pool.submit(flow, before, after))
            before = after
            if len(pending) > 4 * config.workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def flow_image(flow: NDArray[np.floating], full_scale: float = 0.05, size: int = 224) -> Frame:
    """Flow ``[2, S, S]`` as a colour picture ``[size, size, 3]``: hue is direction, brightness speed.

    Args:
        flow: in image widths per frame.
        full_scale: speed shown at full brightness.
        size: side of the picture.
    """
    across, down = np.asarray(flow, dtype=np.float32)
    magnitude, angle = cv2.cartToPolar(across, down)
    value = np.clip(np.asarray(magnitude) / full_scale, 0, 1) * 255
    hsv = np.stack([np.asarray(angle) * (90 / np.pi), np.full_like(value, 255), value], axis=-1).astype(np.uint8)
    rgb = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    return cv2.resize(rgb, (size, size), interpolation=cv2.INTER_NEAREST).astype(np.uint8, copy=False)
