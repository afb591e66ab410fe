"""Frames of a camera, a file or an address, each with its time.

What may stand for a source: a number (a camera of this machine), an address (``rtsp://``, ``http://`` and others of
:data:`SCHEMES`), else an MP4.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from egopose.errors import InputError
from egopose.inference.stream.newest import Captured, NewestFrame
from egopose.vision.video import MAX_PIXELS, MAX_SIDE, Frame, iter_frames, probe_video

#: Addresses that are opened. FFmpeg knows further ones that read files or run over other protocols.
SCHEMES = ("rtsp", "rtsps", "rtmp", "http", "https", "udp", "tcp", "srt")

_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"

# A play list found at an address may name further ones; only these are followed, and never a file.
_FOLLOWED = "http,https,tls,tcp,udp,rtp,rtsp,rtmp,srt,crypto"

_OPEN_TIMEOUT_MS, _READ_TIMEOUT_MS = 10_000, 5_000


@dataclass(frozen=True)
class SourceSettings:
    """Of ``conf/stream.yaml``.

    Args:
        source: see the module.
        pace: of a file: ``real_time``: a frame every 1/rate s, late ones are skipped as a camera's are; ``every``: each
            frame is used, as fast as can be.
        repeat: begin a file anew at its end.
        offset: s of a file to skip.

    Raises:
        InputError: an unknown pace, an address of an unknown kind.
    """

    source: str
    pace: str
    repeat: bool
    offset: float

    def __post_init__(self) -> None:
        if self.pace not in ("real_time", "every"):
            raise InputError("conf/stream.yaml", "pace", f"must be real_time or every, not {self.pace!r}")
        scheme, found, _ = self.source.partition("://")
        if found and scheme.lower() not in SCHEMES:
            raise InputError(self.source, "source", f"addresses begin with {', '.join(SCHEMES)}")

    @property
    def is_camera(self) -> bool:
        """A number."""
        return self.source.isdecimal()

    @property
    def is_file(self) -> bool:
        """Neither camera nor address."""
        return not self.is_camera and "://" not in self.source


def capture(settings: SourceSettings, rate: float, into: NewestFrame, stop: threading.Event) -> None:
    """Read a source to its end (or until ``stop``) into ``into``; to be run on a thread of its own.

    Args:
        settings: of the source.
        rate: control frames a second.
        into: closed at the end, with the error where one ended it.
        stop: ends it at the next frame.
    """
    try:
        if settings.is_file:
            _capture_file(settings, rate, into, stop)
        else:
            _capture_live(settings, into, stop)
    except InputError as error:
        into.close(error)
    else:
        into.close()


def check_source(settings: SourceSettings) -> None:
    """Raises InputError for a file that is no video, before anything else is loaded."""
    if settings.is_file:
        probe_video(settings.source)


def _capture_file(settings: SourceSettings, rate: float, into: NewestFrame, stop: threading.Event) -> None:
    # A camera does not come late and then all at once: where reading took too long, what follows is later by as much.
    hand_over: Callable[[Captured], None] = into.put if settings.pace == "real_time" else into.put_patiently
    start = time.perf_counter()
    for number, image in enumerate(_file_frames(settings, rate)):
        if settings.pace == "real_time":
            early = start + number / rate - time.perf_counter()
            start -= min(early, 0.0)
            stop.wait(max(early, 0.0))
        if stop.is_set():
            return
        hand_over(Captured(number / rate, time.perf_counter(), image))


def _file_frames(settings: SourceSettings, rate: float) -> Iterator[Frame]:
    while True:
        yield from iter_frames(settings.source, rate, settings.offset)
        if not settings.repeat:
            return


def _capture_live(settings: SourceSettings, into: NewestFrame, stop: threading.Event) -> None:
    field, device = ("camera", _open_camera) if settings.is_camera else ("address", _open_address)
    opened = device(settings.source)
    try:
        if not opened.isOpened():
            raise InputError(settings.source, field, "cannot be opened: nothing there, in use, or no video")
        seen = False
        while not stop.is_set():
            ok, picture = opened.read()
            arrived = time.perf_counter()
            if not ok:
                if not seen:
                    raise InputError(settings.source, field, "gives no picture")
                return
            into.put(Captured(arrived, arrived, _rgb(picture, settings.source)))
            seen = True
    finally:
        opened.release()


def _open_camera(number: str) -> cv2.VideoCapture:
    device = cv2.VideoCapture(int(number))
    # The driver's own queue would hold old frames back.
    device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return device


def _open_address(address: str) -> cv2.VideoCapture:
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_TIMEOUT_MS]
    # OpenCV takes FFmpeg's options from the environment alone, for files too: what a user has set there wins, and
    # nothing stays.
    given = os.environ.get(_OPTIONS)
    os.environ[_OPTIONS] = f"protocol_whitelist;{_FOLLOWED}" if given is None else given
    try:
        return cv2.VideoCapture(address, cv2.CAP_FFMPEG, limits)
    finally:
        if given is None:
            del os.environ[_OPTIONS]


def _rgb(picture: cv2.typing.MatLike, source: str) -> Frame:
    height, width = picture.shape[:2]
    if picture.ndim != 3 or picture.shape[2] != 3 or max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
        raise InputError(source, "size", f"a picture {list(picture.shape)}; expected colour, up to {MAX_SIDE} a side")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
