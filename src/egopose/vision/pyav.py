"""Frames by PyAV (the extra ``video``), for codecs that this build of OpenCV lacks: AV1 above all.

PyAV brings its own FFmpeg with dav1d. It is asked only where OpenCV decodes nothing, under the same limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The demuxer of each container: FFmpeg is not left to guess another from the content.
_FORMATS = {"MP4": "mov,mp4,m4a,3gp,3g2,mj2", "AVI": "avi", "Matroska": "matroska,webm"}
_THREADS = 2


def there() -> bool:
    """Whether PyAV is installed."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


@contextmanager
def opened(path: str | PathLike[str], kind: str) -> Iterator[Any]:
    """The first video stream of a file.

    Raises:
        ValueError: it cannot be opened, has no video, or its codec is unknown; mostly FFmpeg's words.
    """
    import av

    try:
        container = av.open(str(path), format=_FORMATS[kind].split(",")[0], metadata_errors="replace")
    except (av.error.FFmpegError, OSError) as error:
        raise ValueError(str(error)) from error
    with container:
        if not container.streams.video:
            raise ValueError("no video stream")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise ValueError("a codec that PyAV does not decode either")
        stream.codec_context.thread_count = _THREADS
        yield stream


def header(stream: Any) -> tuple[int, int, float, int]:
    """Width, height, frames/s, number of frames as the header has them."""
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    seconds = float((stream.duration or 0) * (stream.time_base or 0)) or (stream.container.duration or 0) / 1e6
    frames = stream.frames or round(seconds * rate)
    return stream.width or 0, stream.height or 0, rate, frames


def frames(stream: Any) -> Iterator[tuple[float | None, NDArray[np.uint8]]]:
    """Time stamp (s, None where there is none) and RGB picture of each frame; damaged packets are passed over."""
    import av

    for packet in stream.container.demux(stream):
        try:
            decoded = packet.decode()
        except av.error.FFmpegError:
            continue
        for frame in decoded:
            picture = frame.to_ndarray(format="rgb24")
            if turns := round(frame.rotation / 90) % 4:
                picture = np.ascontiguousarray(np.rot90(picture, turns))
            yield (None if frame.time is None else float(frame.time)), picture
