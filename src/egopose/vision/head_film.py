"""From a film to a head signal: frames, as the camera saw them, to flow, and flow with telemetry to the signal.

Reading needs nothing of torch, so a process that only reads films can do it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.vision.flow import PRESETS
from egopose.vision.head_signal import HeadSignal, signal_of_flow
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.mounts import MOUNTS
from egopose.vision.telemetry import (
    Telemetry,
    angular_velocity_at,
    camera_from_telemetry,
    down_at,
    image_rotation,
    read_aria_trajectory,
    read_imu_csv,
    read_telemetry,
    require_undoable,
)
from egopose.vision.video import Frame, probe_video, timed_frames

#: Pixels across the picture that flow is computed of, and cells across the flow that is kept.
_ACROSS, _CELLS = 320, 24
#: Degrees of the pinhole picture, at most: beyond it a flat picture is mostly edge.
_MOST_VIEW = 105.0
#: Degrees across a frame of which nothing is known: a phone's main camera filming video has 60 to 70.
UNKNOWN_VIEW = 65.0
#: Threads that rectify and compute flow beside the one that decodes.
_WORKERS = 2
#: Share of a cell that the film must show for the cell to count.
_SHOWN = 0.99

#: A rectified frame in grey, and where the film shows it (None: everywhere).
_Seen = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]


@dataclass(frozen=True)
class WornCamera:
    """How the camera of a film is worn (``worn`` of ``conf/estimate.yaml``).

    Args:
        mount: ``head``, ``chest`` or ``held``.
        pitch_down: degrees below the horizon on average; None finds it in the telemetry or in the film.
        height: m above the floor while standing; None takes the humanoid's own of that mount.
        telemetry: a file of measurements beside the film: a table of an IMU or Aria's trajectory; None for the film's.

    Raises:
        InputError: a value that cannot be; names it.
    """

    mount: str = "head"
    pitch_down: float | None = None
    height: float | None = None
    telemetry: str | None = None

    def __post_init__(self) -> None:
        if self.mount not in MOUNTS:
            raise InputError("worn", "mount", f"{self.mount!r}; there are {', '.join(MOUNTS)}")
        if self.pitch_down is not None and not -60 <= self.pitch_down <= 90:
            raise InputError("worn", "pitch_down", f"{self.pitch_down} degrees; -60 to 90")
        if self.height is not None and not 0.3 <= self.height <= 3.0:
            raise InputError("worn", "height", f"{self.height} m; 0.3 to 3")


@dataclass(frozen=True)
class HeadRow:
    """What is kept of a frame.

    Args:
        time: s of the video, of the frame's stamp.
        interval: s since the frame before that differs.
        flow: ``[2, H, W]`` float32, picture widths from that frame to this one; NaN where the film shows nothing.
        view: degrees across the picture.
    """

    time: float
    interval: float
    flow: NDArray[np.float32]
    view: float


def telemetry_of(video: str | PathLike[str], worn: WornCamera) -> Telemetry | None:
    """The film's own telemetry, or the file's that is named.

    Raises:
        InputError: the file cannot be read, or is none of the kinds known.
    """
    own = read_telemetry(video)
    if worn.telemetry is None:
        return own
    path = Path(worn.telemetry)
    with_trajectory = "trajectory" in path.name.lower()
    given = read_aria_trajectory(path) if with_trajectory else read_imu_csv(path)
    if own is None:
        return given
    # What the file says of lens and shutter stays true.
    kept = {
        name: getattr(own, name) for name in ("field_of_view", "lens", "readout", "stabilised", "image_orientation")
    }
    return replace(given, **kept)


def film_camera(video: str | PathLike[str], camera: Camera, telemetry: Telemetry | None) -> tuple[Camera, bool]:
    """The camera with what telemetry tells, and whether its field of view is only a guess.

    Raises:
        InputError: the picture was steadied and nothing undoes it.
    """
    if telemetry is not None:
        if camera.stabilised != "ignore":
            require_undoable(telemetry, video)
        camera = camera_from_telemetry(telemetry, camera)
    guessed = camera.field_of_view is None
    return (replace(camera, field_of_view=UNKNOWN_VIEW) if guessed else camera), guessed


def head_rows(
    video: str | PathLike[str],
    fps: float,
    offset: float,
    camera: Camera,
    telemetry: Telemetry | None,
    watch: Callable[[Frame], None] | None = None,
    count: int | None = None,
) -> Iterator[HeadRow]:
    """A row for each frame of the motion.

    Args:
        video: the film.
        fps: of the motion.
        offset: s of the film to skip.
        camera: of :func:`film_camera`.
        telemetry: undoes what the camera steadied, unless ``camera.stabilised`` ignores it.
        watch: is shown each frame as it was filmed.
        count: frames; None for all.

    Raises:
        InputError: as :func:`egopose.vision.video.read_frames`; a lens that folds the picture.
    """
    info = probe_video(video)
    across, _ = camera.wide_view(info.width, info.height, _MOST_VIEW)
    rectify = camera.wide_rectifier(info.width, info.height, _ACROSS, _MOST_VIEW)
    undo = telemetry is not None and telemetry.image_orientation is not None and camera.stabilised != "ignore"
    own = threading.local()

    def seen(time: float, frame: Frame) -> _Seen:
        turn = None
        if undo and telemetry is not None:
            turned = image_rotation(telemetry, np.array([time]))
            turn = None if turned is None else turned[0]
        picture, shown = rectify(frame, turn)
        return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False), shown

    def row(time: float, interval: float, before: Future[_Seen] | None, now: Future[_Seen]) -> HeadRow:
        # Both were handed to the pool earlier and threads take jobs in order: this waits, but never for ever.
        grey, shown = now.result()
        if before is None:
            return HeadRow(time, interval, _cells(np.zeros((*grey.shape, 2), np.float32), shown), across)
        if not hasattr(own, "dis"):
            own.dis = cv2.DISOpticalFlow.create(PRESETS["medium"])
        past, once = before.result()
        both = shown if once is None or shown is None else shown & once
        flow = _cells(np.asarray(own.dis.calc(past, grey, None)), both)
        # Widths of the picture a readout, as if the picture were square.
        high = grey.shape[0] / grey.shape[1]
        plain = undo_rolling_shutter(flow, camera.delay / high, interval) if camera.delay else flow
        return HeadRow(time, interval, plain.astype(np.float32), across)

    last: tuple[float, Future[_Seen]] | None = None
    pending: deque[Future[HeadRow]] = deque()
    with ThreadPoolExecutor(_WORKERS) as pool:
        for time, frame in timed_frames(video, fps, offset - 0.5 * camera.delay, count, camera.fps):
            if watch is not None:
                watch(frame)
            if last is not None and time <= last[0]:
                pending.append(pending[-1])  # the film has fewer frames: the last one's motion goes on
            else:
                now = pool.submit(seen, time, frame)
                interval = 1.0 / fps if last is None else time - last[0]
                pending.append(pool.submit(row, time, interval, None if last is None else last[1], now))
                last = (time, now)
            if len(pending) > 4 * _WORKERS:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _cells(dense: NDArray[np.floating], shown: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """Dense flow ``[H, W, 2]`` in pixels -> means of cells ``[2, h, w]`` in widths; NaN where not all is shown."""
    height, width = dense.shape[:2]
    size = (_CELLS, max(round(_CELLS * height / width), 2))
    mean = cv2.resize(np.asarray(dense, np.float32), size, interpolation=cv2.INTER_AREA) / width
    if shown is not None:
        share = cv2.resize(shown.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mean[share < _SHOWN] = np.nan
    return np.asarray(mean.transpose(2, 0, 1), dtype=np.float32)


def head_signal_of_rows(
    rows: Sequence[HeadRow], camera: Camera, telemetry: Telemetry | None, worn: WornCamera
) -> HeadSignal:
    """The signal of a film that was read.

    Args:
        rows: of :func:`head_rows`, at least one.
        camera: of :func:`film_camera`.
        telemetry: tells turning and the vertical where it can.
        worn: see there.

    Raises:
        InputError: the telemetry does not cover the film.
    """
    times, intervals = np.array([row.time for row in rows]), np.array([row.interval for row in rows])
    down = turning = None
    if telemetry is not None and (telemetry.gyroscope is not None or telemetry.trajectory is not None):
        turning = angular_velocity_at(telemetry, times, float(np.median(intervals)))
        if telemetry.gravity is not None or telemetry.trajectory is not None or telemetry.accelerometer is not None:
            down = down_at(telemetry, times)
    pitch = None if worn.pitch_down is None else float(np.deg2rad(worn.pitch_down))
    steadied = telemetry is not None and bool(telemetry.stabilised) and camera.stabilised == "ignore"
    flow = np.stack([row.flow for row in rows])
    return signal_of_flow(flow, rows[0].view, intervals, down, turning, pitch, steadied)


def read_head_signal(
    video: str | PathLike[str], fps: float, camera: Camera, worn: WornCamera, offset: float = 0.0
) -> HeadSignal:
    """The head signal of a film at the motion's rate, in one call.

    Raises:
        InputError: as :func:`telemetry_of`, :func:`film_camera` and :func:`head_rows`.
    """
    telemetry = telemetry_of(video, worn)
    known, _ = film_camera(video, camera, telemetry)
    return head_signal_of_rows(list(head_rows(video, fps, offset, known, telemetry)), known, telemetry, worn)
