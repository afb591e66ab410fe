"""Video in and MP4 out: frames are uint8 RGB ``[H, W, 3]``, times are seconds from the video's first frame.

OpenCV decodes. Where its build lacks a codec (AV1), PyAV does, if it is installed; both give the same frames and times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.vision import pyav
from egopose.vision.containers import Container, look_into

Frame = NDArray[np.uint8]

# Beyond any camera sold (8K is 7680 x 4320): a header that says more is broken or hostile.
MAX_SIDE = 8192
MAX_PIXELS = 7680 * 4320
MAX_FPS = 1000.0

# A pause longer than this (s) is no camera's: filling it with the frame before it could go on for ever.
MAX_GAP = 5.0

# Decoders keep up to 16 reference frames, and one more for each thread.
_DECODER_THREADS = 2

# Codecs that OpenCV turned out not to decode in this process: it need not be asked again, nor complain again.
_BEYOND_OPENCV: set[str] = set()


@dataclass(frozen=True)
class VideoInfo:
    """What a video's header says; ``frames`` is the header's word and may be wrong by a few."""

    width: int
    height: int
    fps: float
    frames: int


class VideoWriter:
    """Writes frames to an MP4 (``mp4v``), complete or not at all.

    The file is written under a temporary name beside ``path`` and renamed when the ``with`` block ends without an
    error, so a file of that name is always a whole video.

    Args:
        path: the MP4 to write; its folder is made.
        fps: frames per second.

    Raises:
        InputError: the encoder cannot write there, frames are not uint8 ``[H, W, 3]`` of one size, or there are none.
    """

    def __init__(self, path: str | PathLike[str], fps: float) -> None:
        self.path, self.fps, self.frames = Path(path), fps, 0
        self._partial = self.path.with_name(f".{self.path.stem}.partial.mp4")
        self._writer: cv2.VideoWriter | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, frame: Frame) -> None:
        """Append one RGB frame."""
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise InputError(self.path, "frame", f"expected uint8 [H, W, 3], got {frame.dtype} {list(frame.shape)}")
        if self._writer is None:
            self._open(frame.shape[1], frame.shape[0])
            self._shape = frame.shape
        if frame.shape != self._shape:
            raise InputError(self.path, "frame", f"size {frame.shape[:2]} differs from the first's {self._shape[:2]}")
        assert self._writer is not None
        self._writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        self.frames += 1

    def _open(self, width: int, height: int) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(self.path, "folder", f"cannot be made: {error.strerror}") from error
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._partial), cv2.CAP_FFMPEG, fourcc, self.fps, (width, height))
        if not self._writer.isOpened():
            raise InputError(
                self.path, "video", f"cannot open an mp4v encoder for {width} x {height} at {self.fps} fps"
            )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        if kind is not None:
            if self._writer is not None:
                self._partial.unlink(missing_ok=True)
            return
        if not self.frames:
            raise InputError(self.path, "video", "no frames were written")
        self._partial.replace(self.path)


def write_video(path: str | PathLike[str], frames: Iterable[Frame], fps: float) -> int:
    """Write RGB frames to an MP4; returns how many. Raises as :class:`VideoWriter`."""
    with VideoWriter(path, fps) as writer:
        for frame in frames:
            writer.write(frame)
    return writer.frames


@contextmanager
def _capture(path: str | PathLike[str]) -> Iterator[cv2.VideoCapture]:
    """OpenCV's capture, opened or not."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, _DECODER_THREADS])
    try:
        yield capture
    finally:
        capture.release()


def _sane(path: str | PathLike[str], width: float, height: float, fps: float, frames: float) -> VideoInfo:
    """The header's numbers. Raises InputError where they cannot be."""
    info = VideoInfo(int(width), int(height), float(fps), int(min(max(frames, 0), 2**62)))
    if not (0 < info.width <= MAX_SIDE and 0 < info.height <= MAX_SIDE and info.width * info.height <= MAX_PIXELS):
        cause = f"{info.width} x {info.height}; up to {MAX_SIDE} a side and {MAX_PIXELS} pixels can be read"
        raise InputError(path, "size", cause)
    if not 0 < info.fps <= MAX_FPS:
        raise InputError(path, "fps", f"{info.fps}; expected more than 0 and at most {MAX_FPS:g}")
    return info


def _has_picture(capture: cv2.VideoCapture) -> bool:
    """Whether OpenCV opened the file and found out how large its pictures are: of damaged ones it does not."""
    return capture.isOpened() and capture.get(cv2.CAP_PROP_FRAME_WIDTH) > 0


def _of_capture(path: str | PathLike[str], capture: cv2.VideoCapture) -> VideoInfo:
    keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT)
    return _sane(path, *(capture.get(key) for key in keys))


def probe_video(path: str | PathLike[str]) -> VideoInfo:
    """Size, rate and announced number of frames. Raises InputError as :func:`read_frames`."""
    container = look_into(path)
    if container.codec not in _BEYOND_OPENCV:
        with _capture(path) as capture:
            if _has_picture(capture):
                return _of_capture(path, capture)
    return next(_by_pyav(path, container))[2]


def _by_opencv(path: str | PathLike[str]) -> Iterator[tuple[float | None, Frame, VideoInfo]]:
    """Stamps (s), RGB frames and the header; none where OpenCV cannot decode."""
    with _capture(path) as capture:
        if not _has_picture(capture):
            return
        info = _of_capture(path, capture)
        while True:
            try:
                ok, bgr = capture.read()
            except cv2.error as error:
                raise InputError(path, "video", f"cannot be decoded: {' '.join(str(error).split())}"[:200]) from None
            if not ok:
                return
            rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
            yield capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0, rgb, info


def _by_pyav(path: str | PathLike[str], container: Container) -> Iterator[tuple[float | None, Frame, VideoInfo]]:
    """Like :func:`_by_opencv`, which decoded nothing. Raises InputError where PyAV cannot help, saying what would."""
    if container.decoded_everywhere:
        cause = f"damaged: no frame of this {container.kind} can be decoded ({container.codec_name})"
        raise InputError(path, "video", cause + (f"; {container.cut}" if container.cut else ""))
    convert = f"ffmpeg -i {Path(path).name} -c:v libx264 -crf 18 converted.mp4"
    if not pyav.there():
        cause = f"{container.codec_name} is a codec that this build of OpenCV does not decode"
        raise InputError(path, "video", f"{cause}: pip install 'egopose[video]', or convert it with {convert}")
    try:
        with pyav.opened(path, container.kind) as stream:
            width, height, fps, count = pyav.header(stream)
            info = _sane(path, width, height, fps, count)
            for stamp, frame in pyav.frames(stream):
                _BEYOND_OPENCV.add(container.codec)
                if frame.shape[:2] == (info.width, info.height):
                    info = VideoInfo(info.height, info.width, info.fps, info.frames)  # filmed upright
                yield stamp, frame, info
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "video", f"{container.codec_name}: {error}"[:200]) from error
    if container.codec not in _BEYOND_OPENCV:
        cause = (
            f"neither OpenCV nor PyAV decodes a frame of {container.codec_name}: damaged, or convert it with {convert}"
        )
        raise InputError(path, "video", cause)


def _decoded(path: str | PathLike[str]) -> Iterator[tuple[float | None, Frame, VideoInfo]]:
    """Frames by the first of the two that decodes any. Raises InputError where neither does."""
    container = look_into(path)
    if container.codec not in _BEYOND_OPENCV:
        one = None
        for one in _by_opencv(path):
            yield one
        if one is not None:
            return
    yield from _by_pyav(path, container)


def read_frames(path: str | PathLike[str], taken_at: float | None = None) -> Iterator[tuple[float, Frame]]:
    """Decode a video: ``(seconds since its first frame, RGB frame)`` in order.

    The times are the file's own presentation stamps, so videos of a varying rate come out right. Where a stamp does
    not advance (some recorders leave them out) the header's rate takes its place.

    Args:
        path: MP4, QuickTime, AVI, Matroska or WebM.
        taken_at: frames/s at which the camera took them, where the stamps are known to be wrong (slow motion).

    Raises:
        InputError: missing, empty or damaged file, no video in it, a codec that nothing installed decodes (named, with
            what helps), a size or rate that cannot be, frames of different sizes, a pause of over :data:`MAX_GAP`.
    """
    first = last = None
    for count, (stamp, frame, info) in enumerate(_decoded(path)):
        if first is None or last is None:
            first, time = stamp or 0.0, 0.0
        elif taken_at is not None:
            time = count / taken_at
        else:
            time = stamp - first if stamp is not None and stamp - first > last else last + 1.0 / info.fps
            if time - last > MAX_GAP:
                cause = f"no frame from {last:.3f} to {time:.3f} s: a pause of over {MAX_GAP:g} s, or damaged stamps"
                raise InputError(path, "time stamps", cause)
        last = time
        if frame.shape != (info.height, info.width, 3):
            raise InputError(path, "size", f"a frame of {frame.shape[1]} x {frame.shape[0]} among others: damaged")
        yield time, frame


def iter_frames(
    path: str | PathLike[str],
    fps: float = 30.0,
    offset: float = 0.0,
    count: int | None = None,
    taken_at: float | None = None,
) -> Iterator[Frame]:
    """The video's frames at the motion's times, see :func:`timed_frames`, whose errors it raises."""
    return (frame for _, frame in timed_frames(path, fps, offset, count, taken_at))


def timed_frames(
    path: str | PathLike[str],
    fps: float = 30.0,
    offset: float = 0.0,
    count: int | None = None,
    taken_at: float | None = None,
) -> Iterator[tuple[float, Frame]]:
    """The video's frames at the motion's times, each with the time (s) of its own stamp.

    Frame k is the one nearest to video time ``k / fps + offset``.

    Args:
        path: the video.
        fps: the motion's rate.
        offset: sync offset in seconds: what the motion shows at time t, the video shows at t + offset.
        count: number of motion frames; None takes every one until the video ends.
        taken_at: frames/s at which the camera took them, see :func:`read_frames`.

    Raises:
        InputError: as :func:`read_frames`; and when the motion starts before the video or ends after it by more than
            one video frame, saying by how much.
    """
    if not fps > 0:
        raise InputError(path, "fps", f"must be positive, got {fps}")
    emitted = 0
    # Half a frame of the motion of tolerance: a stamp of 33.33 ms beside a time of 33.34 ms is the same instant.
    if offset < -0.5 / fps:
        raise InputError(path, "sync_offset", f"the motion starts {-offset:.3f} s before the video: cut its beginning")
    previous: tuple[float, Frame] | None = None
    interval = 1.0 / fps
    for time, frame in read_frames(path, taken_at):
        if previous is not None:
            interval = time - previous[0]
            middle = 0.5 * (previous[0] + time)
            while emitted / fps + offset <= middle and (count is None or emitted < count):
                yield previous
                emitted += 1
        if count is not None and emitted >= count:
            return
        previous = (time, frame)
    assert previous is not None
    end = previous[0]
    while emitted / fps + offset <= end + 0.5 * interval and (count is None or emitted < count):
        yield previous
        emitted += 1
    if emitted == 0:
        raise InputError(path, "sync_offset", f"{offset:.3f} s lies behind the video's end at {end:.3f} s")
    missing = 0 if count is None else count - emitted
    if missing > max(interval * fps, 1.0):
        raise InputError(
            path,
            "length",
            f"the video ends {missing / fps:.3f} s before the motion: cut the motion's end or the offset",
        )
    for _ in range(missing):
        yield previous
