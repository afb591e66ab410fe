"""Frames of a camera, a file or an address, each with its time.

What may stand for a source: a number (a camera of this machine), an address (``rtsp://``, ``http://`` and others of
:data:`SCHEMES`), else an MP4.

Times: a file's frames have its own stamps (or are counted at ``fps`` where those are known to be wrong). A live
source's have the time they arrived at, set to whole periods of its rate where that is known (:class:`PictureTimes`).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from egopose.core.errors import InputError
from egopose.inference.stream.newest_frame import Captured, NewestFrame
from egopose.vision.video import MAX_PIXELS, MAX_SIDE, Frame, probe_video, read_frames

#: Addresses that are opened. FFmpeg knows further ones that read files or run over other protocols.
SCHEMES = ("rtsp", "rtsps", "rtmp", "http", "https", "udp", "tcp", "srt")

_CONFIG = "conf/stream.yaml"
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"

# A play list found at an address may name further ones; only these are followed, and never a file.
_FOLLOWED = "http,https,tls,tcp,udp,rtp,rtsp,rtmp,srt,crypto"

_OPEN_TIMEOUT_MS, _READ_TIMEOUT_MS = 10_000, 5_000

# Rates that cameras have. What a stream announces beyond them is the clock of its stamps (90,000) or nothing (0).
_RATES = (5.0, 240.0)


@dataclass(frozen=True)
class ReconnectSettings:
    """``reconnect`` of ``conf/stream.yaml``: what happens when a camera or an address gives no more pictures.

    It is opened again after ``first`` seconds. Each further trial waits twice as long, ``longest`` at most, until
    pictures come. After ``give_up`` seconds without a picture the stream ends with an error.

    Args:
        first, longest: s between trials.
        give_up: s; None for never, 0 for at once.

    Raises:
        InputError: a time that cannot be.
    """

    first: float
    longest: float
    give_up: float | None

    def __post_init__(self) -> None:
        if not 0 < self.first <= self.longest:
            raise InputError(_CONFIG, "reconnect.first", "must be more than 0 s and at most reconnect.longest")
        if self.give_up is not None and self.give_up < 0:
            raise InputError(_CONFIG, "reconnect.give_up", f"{self.give_up} s; null for never to give up")


@dataclass(frozen=True)
class SourceSettings:
    """Of ``conf/stream.yaml``.

    Args:
        source: see the module.
        pace: of a file: ``real_time``: frames come when their stamps say, late ones are skipped as a camera's are;
            ``every``: each frame is used, as fast as can be.
        repeat: begin a file anew at its end.
        offset: s of a file to skip.
        reconnect: see :class:`ReconnectSettings`.
        fps: frames/s at which the camera takes them; None for what the file or device says.

    Raises:
        InputError: an unknown pace, an address of an unknown kind.
    """

    source: str
    pace: str
    repeat: bool
    offset: float
    reconnect: ReconnectSettings
    fps: float | None = None

    def __post_init__(self) -> None:
        if self.pace not in ("real_time", "every"):
            raise InputError(_CONFIG, "pace", f"must be real_time or every, not {self.pace!r}")
        scheme, result, _ = self.source.partition("://")
        if result and scheme.lower() not in SCHEMES:
            raise InputError(self.label, "source", f"addresses begin with {', '.join(SCHEMES)}")

    @property
    def is_camera(self) -> bool:
        """A number."""
        return self.source.isdecimal()

    @property
    def is_file(self) -> bool:
        """Neither camera nor address."""
        return not self.is_camera and "://" not in self.source

    @property
    def label(self) -> str:
        """The source as others may read it: without the password, or whatever follows ``?``, of an address."""
        if "://" not in self.source:
            return self.source
        scheme, _, rest = self.source.partition("://")
        return f"{scheme}://{rest.split('?')[0].rpartition('@')[2]}"


class PictureTimes:
    """When a live source's pictures were taken, from when they arrived.

    Arrival wavers by several ms, which would make flow waver with it. At a known rate pictures lie whole periods apart:
    as many as have passed, one at least.

    Args:
        fps: pictures/s; None where that is not known, and times of arrival are kept.
    """

    def __init__(self, fps: float | None) -> None:
        self._fps = fps
        self._last: float | None = None

    def stamp(self, arrived: float) -> float:
        """Seconds; only differences count."""
        if self._fps is None or self._last is None:
            self._last = arrived
        else:
            self._last += max(1, round((arrived - self._last) * self._fps)) / self._fps
        return self._last


def capture(settings: SourceSettings, into: NewestFrame, stop: threading.Event) -> None:
    """Read a source to its end (or until ``stop``) into ``into``; to be run on a thread of its own.

    Args:
        settings: of the source.
        into: closed at the end, with the error where one ended it.
        stop: ends it at the next frame.
    """
    try:
        if settings.is_file:
            _capture_file(settings, into, stop)
        else:
            _capture_live(settings, into, stop)
    except InputError as error:
        into.close(error)
    else:
        into.close()


def check_source(settings: SourceSettings) -> None:
    """Raises InputError for a file that is no video or a camera that is not there, before anything else is loaded."""
    if settings.is_file:
        probe_video(settings.source)
    if settings.is_camera and (there := _cameras()) is not None and int(settings.source) not in there:
        raise InputError(settings.source, "camera", _camera_advice("is not there", there))


def _capture_file(settings: SourceSettings, into: NewestFrame, stop: threading.Event) -> None:
    # A camera does not come late and then all at once: where reading took too long, what follows is later by as much.
    hand_over: Callable[[Captured], None] = into.put if settings.pace == "real_time" else into.put_patiently
    start = time.perf_counter()
    for stamp, image in _file_frames(settings):
        if settings.pace == "real_time":
            early = start + stamp - time.perf_counter()
            start -= min(early, 0.0)
            stop.wait(max(early, 0.0))
        if stop.is_set():
            return
        hand_over(Captured(stamp, time.perf_counter(), image))


def _file_frames(settings: SourceSettings) -> Iterator[tuple[float, Frame]]:
    """Frames with seconds since the first; each time round goes on one period after the one before."""
    period = 1.0 / (settings.fps or probe_video(settings.source).fps)
    begun = 0.0
    while True:
        first = last = None
        for stamp, image in read_frames(settings.source, settings.fps):
            if stamp < settings.offset - 0.5 * period:
                continue
            first = stamp if first is None else first
            last = begun + stamp - first
            yield last, image
        if last is None:
            raise InputError(settings.source, "offset", f"{settings.offset:.3f} s lies behind the video's end")
        if not settings.repeat:
            return
        begun = last + period


def _capture_live(settings: SourceSettings, into: NewestFrame, stop: threading.Event) -> None:
    """Pictures until the source ends; a source that breaks off is opened again, see :class:`ReconnectSettings`."""
    rule, seen = settings.reconnect, False
    wait, broken_since = rule.first, time.perf_counter()
    while not stop.is_set():
        before = into.given
        ended = _read_live(settings, into, stop)
        seen = seen or into.given > before
        if ended or stop.is_set():
            return
        if not seen:
            raise _no_picture(settings)
        now = time.perf_counter()
        if into.given > before:
            wait, broken_since = rule.first, now
        if rule.give_up is not None and now - broken_since >= rule.give_up:
            cause = f"broke off, and no picture came in {rule.give_up:g} s: see that it sends, then start again"
            raise InputError(settings.label, _field(settings), f"{cause} (reconnect.give_up=null waits for ever)")
        into.broken = True
        stop.wait(wait)
        wait = min(2 * wait, rule.longest)


def _read_live(settings: SourceSettings, into: NewestFrame, stop: threading.Event) -> bool:
    """Open the source and read until nothing comes; True where that is its end and not a break."""
    opened = _open_camera(settings) if settings.is_camera else _open_address(settings.source)
    try:
        if not opened.isOpened():
            return False
        # An address that announces its number of frames is a file: it ends and is not opened again.
        finite = not settings.is_camera and opened.get(cv2.CAP_PROP_FRAME_COUNT) > 0
        announced = opened.get(cv2.CAP_PROP_FPS)
        times = PictureTimes(settings.fps or (announced if _RATES[0] <= announced <= _RATES[1] else None))
        given = 0
        while not stop.is_set():
            ok, picture = opened.read()
            arrived = time.perf_counter()
            if not ok:
                return finite and given > 0
            into.put(Captured(times.stamp(arrived), arrived, _rgb(picture, settings.label)))
            into.reconnects += into.broken
            into.broken = False
            given += 1
        return True
    finally:
        opened.release()


def _open_camera(settings: SourceSettings) -> cv2.VideoCapture:
    device = cv2.VideoCapture(int(settings.source))
    # The driver's own queue would hold old frames back.
    device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    if settings.fps is not None:
        device.set(cv2.CAP_PROP_FPS, settings.fps)
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


def _field(settings: SourceSettings) -> str:
    return "camera" if settings.is_camera else "address"


def _no_picture(settings: SourceSettings) -> InputError:
    """The source never gave one; says what to look at."""
    if settings.is_camera:
        return InputError(settings.source, "camera", _camera_advice("cannot be opened", _cameras()))
    where = urlsplit(settings.source).netloc.rpartition("@")[2]
    cause = (
        f"cannot be opened, or gives no picture: is {where} up and sending, name and password right? "
        f"`ffplay '{settings.label}'` shows what comes"
    )
    return InputError(settings.label, "address", cause)


def _cameras() -> list[int] | None:
    """Numbers of this machine's cameras; None where they cannot be listed (anywhere but Linux)."""
    if not Path("/proc").is_dir():
        return None
    names = [path.name.removeprefix("video") for path in Path("/dev").glob("video*")]
    return sorted(int(name) for name in names if name.isdecimal())


def _camera_advice(what: str, there: list[int] | None) -> str:
    if there is None:
        return f"{what}: try other numbers (0, 1, ...), close programs that use it, allow this one the camera"
    if not there:
        return f"{what}: this machine has no camera at all; plug one in, or give a video file or an address"
    return f"{what}: this machine has {', '.join(map(str, there))}; choose one (source=N), close programs that use it"


def _rgb(picture: cv2.typing.MatLike, source: str) -> Frame:
    height, width = picture.shape[:2]
    if picture.ndim != 3 or picture.shape[2] != 3 or max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
        raise InputError(source, "size", f"a picture {list(picture.shape)}; expected colour, up to {MAX_SIDE} a side")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
