"""One pass over a film: its frames at a motion's times, the flow between them, and small pictures of them.

This module imports nothing of torch, so that a process that only reads films starts at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from egopose.vision.flow import FlowConfig, centred_square, flow_of_frames
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import Frame, iter_frames, probe_video

#: Side in pixels of the small pictures that the body-part estimator looks at.
PICTURE = 64
#: Flow ``[2, S, S]`` float16 of a frame and its small picture ``[64, 64, 3]``, None where none is asked for.
FilmRow = tuple[NDArray[np.float16], NDArray[np.uint8] | None]


def frames_at(
    path: str | PathLike[str],
    working_size: int,
    fps: float,
    offset: float = 0.0,
    count: int | None = None,
    camera: Camera | None = None,
    watch: Callable[[Frame], None] | None = None,
) -> Iterator[Frame]:
    """Frames at the motion's times, without what the lens does to them.

    Args:
        path, fps, offset, count: see :func:`egopose.vision.video.iter_frames`.
        working_size: side of the square that flow sees.
        camera: to be undone; None for none.
        watch: is shown each frame as it was filmed.

    Raises as :func:`egopose.vision.video.iter_frames`.
    """
    known = Camera() if camera is None else camera
    # The middle row, which stands for the frame, is exposed half a readout after its stamp.
    frames = iter_frames(path, fps, offset - 0.5 * known.delay, count, known.fps)
    if watch is not None:
        frames = _watched(frames, watch)
    if known.field_of_view is None:
        return frames
    info = probe_video(path)
    return map(known.rectifier(info.width, info.height, working_size), frames)


def film_rows(
    path: str | PathLike[str],
    config: FlowConfig,
    fps: float,
    offset: float = 0.0,
    count: int | None = None,
    camera: Camera | None = None,
    pictures: bool = False,
    watch: Callable[[Frame], None] | None = None,
) -> Iterator[FilmRow]:
    """Flow and small picture of each frame, in order; reading runs ahead by a few frames only.

    Args:
        path, fps, offset, count, camera, watch: see :func:`frames_at`.
        config: of the flow.
        pictures: also make small pictures.

    Raises as :func:`frames_at`.
    """
    frames = frames_at(path, config.working_size, fps, offset, count, camera, watch)
    small: deque[NDArray[np.uint8]] = deque()
    if pictures:
        frames = _watched(frames, lambda frame: small.append(small_picture(frame)))
    for flow in flow_of_frames(frames, config):
        if camera is not None and camera.delay:
            flow = undo_rolling_shutter(flow, camera.delay, 1.0 / fps)
        yield flow, small.popleft() if small else None


def small_picture(frame: Frame) -> NDArray[np.uint8]:
    """The centred square of an RGB frame ``[H, W, 3]``, area-averaged to what the body-part estimator looks at."""
    # A copy also of a frame of that size: pictures are kept, and a reader's buffer may not be.
    return centred_square(frame, PICTURE).copy()


def _watched(frames: Iterator[Frame], watch: Callable[[Frame], None]) -> Iterator[Frame]:
    for frame in frames:
        watch(frame)
        yield frame
