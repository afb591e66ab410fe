"""A process beside the policy's: it reads the film while the libraries load, and draws the result while the body moves.

A film is decoded once. Flow and small pictures go to the caller; the wearer's panels of the side-by-side video wait in
a temporary file as JPEG, 1.4 MB a second of film.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.checkpoint.pretrained import is_pretrained, pretrained_run
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.former_names import upgraded
from egopose.core.runtime import end_with_parent
from egopose.core.safe_io import read_json
from egopose.motion.rotations import Array
from egopose.vision.film import FilmRow, film_rows
from egopose.vision.flow import FlowConfig
from egopose.vision.gl import choose_backend
from egopose.vision.head_film import HeadRow, WornCamera, film_camera, head_rows, telemetry_of
from egopose.vision.lens import Camera
from egopose.vision.side_by_side import middle_square, side_by_side
from egopose.vision.video import Frame, probe_video, write_video

#: Frames that go from process to process at a time.
_FRAMES = 16
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_AHEAD = 8  # frames whose panels may wait for their thread
_STOP = "stop"
#: What a video can be seen by: the run's own regressor of flow, or the head signal.
SEES = ("auto", "flow", "head_signal")

Advance = Callable[[int], None]
"""Is told how many more frames are done."""


@dataclass(frozen=True)
class FilmSettings:
    """What is made of a film.

    Args:
        video: the file.
        flow: how flow is computed.
        fps: the motion's rate.
        offset: s of the film to skip.
        camera: that took it.
        pictures: whether the body-part estimator's small pictures are wanted.
        panel: side of the wearer's panel, pixels.
        worn: how the camera is worn, if the head signal is read; None reads flow in a square.
    """

    video: Path
    flow: FlowConfig
    fps: float
    offset: float
    camera: Camera
    pictures: bool
    panel: int
    worn: WornCamera | None = None

    @classmethod
    def of(cls, values: Mapping[str, Any], source: Mapping[str, Any], fps: float) -> FilmSettings:
        """By ``conf/estimate.yaml`` (resolved) for a regressor with the groups ``vision`` and ``regressor``.

        Raises:
            InputError: a setting that cannot be.
        """
        camera = Camera.from_mapping(values["camera"], "camera")
        kernel = source["regressor"].get("kernel") or {}
        worn = worn_camera(values)
        flow, pictures = FlowConfig(**source["vision"]["flow"]), kernel.get("body_parts") is not None and worn is None
        video, offset = Path(str(values["video"])), float(values["offset"])
        return cls(video, flow, fps, offset, camera, pictures, int(values["size"]), worn)


def worn_camera(values: Mapping[str, Any]) -> WornCamera | None:
    """How the camera of ``conf/estimate.yaml`` (resolved) is worn, if its head signal is to be read.

    ``sees: auto`` reads it of a film. A video that this project rendered has a record beside it, and is seen by the
    run's own regressor, as is every video live (``causal``).

    Raises:
        InputError: a setting that cannot be.
    """
    worn = from_mapping(WornCamera, values["worn"], "conf/estimate.yaml: worn")
    sees = values["sees"]
    if sees not in SEES:
        raise InputError("conf/estimate.yaml", "sees", f"must be one of {', '.join(SEES)}, not {sees!r}")
    if sees == "auto":
        sees = "flow" if values["causal"] or was_rendered(Path(str(values["video"]))) else "head_signal"
    if sees == "head_signal" and values["causal"]:
        raise InputError("conf/estimate.yaml", "sees", "head_signal reads the whole film: causal=false, or sees=flow")
    return worn if sees == "head_signal" else None


def was_rendered(video: Path) -> bool:
    """Whether the record beside a video says that this project rendered it."""
    record = video.with_suffix(".json")
    try:
        return bool(read_json(record, "rendered").get("rendered")) if record.is_file() else False
    except (ValueError, AttributeError):
        return False


@dataclass(frozen=True)
class Drawing:
    """A side-by-side video to be drawn.

    Args:
        path: the MP4.
        model: the humanoid.
        coming: label of the motion whose poses come one by one; its panel is the first.
        known: label -> ``[T, nq]`` of the other motions.
        wearer: label of the wearer's panel.
    """

    path: Path
    model: mujoco.MjModel
    coming: str
    known: Mapping[str, Array]
    wearer: str


class FilmProcess:
    """Reads a film in a process of its own, and draws beside it; a context manager.

    Args:
        settings: see there. Reading begins at once.
    """

    def __init__(self, settings: FilmSettings) -> None:
        self.settings = settings
        # Spawned and not forked: neither OpenGL nor a parent's threads survive a fork.
        context = multiprocessing.get_context("spawn")
        self._answers, self._orders = context.Queue(), context.Queue()
        self._process = context.Process(target=_work, args=(settings, self._answers, self._orders), daemon=True)
        self._process.start()
        self._drawing, self._waiting = False, []  # type: bool, list[Array]

    def __enter__(self) -> FilmProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def rows(self, advance: Advance | None = None) -> list[Any]:
        """The film's rows, all of them; to be called once. They are head rows where the settings have ``worn``.

        Raises:
            InputError: as :func:`egopose.vision.film.film_rows`.
            RuntimeError: the process ended, for one for want of memory.
        """
        result: list[Any] = []
        while (rows := self._answer()) is not None:
            result += rows
            if advance is not None:
                advance(len(rows))
        return result

    def draw(self, drawing: Drawing) -> None:
        """Begin a drawing, when all rows were read; :meth:`add` its poses, then :meth:`finish` it."""
        self._orders.put(drawing)
        self._drawing = True

    def add(self, pose: Array) -> None:
        """The next pose ``[nq]`` of the motion that is coming."""
        self._waiting.append(pose)
        if len(self._waiting) == _FRAMES:
            self._send()

    def finish(self, advance: Advance | None = None) -> None:
        """Wait until the video is written.

        Args:
            advance: is also told of the frames that were drawn before.

        Raises:
            NoOpenGL: nothing can be drawn here.
            InputError: the video cannot be written.
            RuntimeError: the process ended.
        """
        self._send()
        self._orders.put(None)
        while (frames := self._answer()) is not None:
            if advance is not None:
                advance(frames)
        self._drawing = False

    def _send(self) -> None:
        if self._waiting:
            self._orders.put(np.stack(self._waiting))
            self._waiting = []

    def _answer(self) -> Any:
        """The process's next answer; an error is raised."""
        while True:
            try:
                answer = self._answers.get(timeout=1.0)
                break
            except queue.Empty:
                if not self._process.is_alive() and self._answers.empty():
                    self._drawing = False
                    raise RuntimeError(
                        f"the process that reads {self.settings.video} ended ({self._process.exitcode})"
                    ) from None
        if isinstance(answer, BaseException):
            self._drawing = False
            raise answer
        return answer

    def close(self) -> None:
        """End the process; a drawing that is not finished leaves no file."""
        if self._drawing:
            self._orders.put(_STOP)
            self._process.join(10.0)
        self._process.terminate()
        self._process.join()
        for one in (self._answers, self._orders):
            one.cancel_join_thread()
            one.close()


def foreseen_film(values: Mapping[str, Any]) -> FilmProcess | None:
    """Begin to read the film of ``conf/estimate.yaml`` (resolved) before the checkpoint's checksums can be looked at.

    What is foreseen is what the files of the run's regressor say, and the caller compares
    :attr:`FilmProcess.settings` with what the whole checkpoint says. None where nothing can be foreseen.
    """
    try:
        name = str(values["checkpoint"])
        folder = pretrained_run(name) if is_pretrained(name) else Path(name)
        run = folder if (folder / "regressor").is_dir() else folder.resolve().parents[1]
        (file,) = run.glob("regressor/components/*-config/value.json")
        source = upgraded(read_json(file, "config"))
        settings = FilmSettings.of(values, source, float(source["vision"]["video"]["fps"]))
        probe_video(settings.video)
    except (InputError, OSError, LookupError, TypeError, ValueError):
        return None  # what is wrong is told by those who read the checkpoint and the film
    return FilmProcess(settings)


def _work(settings: FilmSettings, answers: Any, orders: Any) -> None:
    """What the process does: it reads, then waits for a drawing."""
    end_with_parent()
    # Software OpenGL draws in the thread that asks: two panels are two threads already.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    # OpenCV's own threads share out a picture and wait for each other busily: DIS costs twice as much with two.
    cv2.setNumThreads(1)
    opengl = threading.Thread(target=_find_opengl, daemon=True)
    opengl.start()
    try:
        with _Panels(settings.panel) as panels:
            rows = _rows(settings, panels.keep)
            while some := list(islice(rows, _FRAMES)):
                answers.put(some)
            answers.put(None)
            drawing = orders.get()
            opengl.join()
            motions: dict[str, Iterable[Array]] = {drawing.coming: _poses(orders), **drawing.known}
            frames = side_by_side(drawing.model, motions, panels.frames(), drawing.wearer, settings.panel)
            write_video(drawing.path, _told(frames, answers), settings.fps)
            answers.put(None)
    except _Stopped:
        pass
    except InputError as error:
        answers.put(error)
    except Exception as error:
        answers.put(RuntimeError(f"{type(error).__name__}: {error}"))


def _rows(settings: FilmSettings, watch: Callable[[Frame], None]) -> Iterator[FilmRow | HeadRow]:
    """The rows that the settings ask for."""
    video, fps, offset = settings.video, settings.fps, settings.offset
    if settings.worn is None:
        yield from film_rows(
            video, settings.flow, fps, offset, camera=settings.camera, pictures=settings.pictures, watch=watch
        )
        return
    telemetry = telemetry_of(video, settings.worn)
    camera, _ = film_camera(video, settings.camera, telemetry)
    yield from head_rows(video, fps, offset, camera, telemetry, watch)


class _Stopped(Exception):
    """Nobody wants the drawing any more."""


def _poses(orders: Any) -> Iterator[Array]:
    while (rows := orders.get()) is not None:
        if isinstance(rows, str):
            raise _Stopped
        yield from rows


def _told(frames: Iterator[Frame], answers: Any) -> Iterator[Frame]:
    for number, frame in enumerate(frames, 1):
        yield frame
        if number % _FRAMES == 0:
            answers.put(_FRAMES)


def _find_opengl() -> None:
    """Have the back end found while the film is read; where there is none, drawing tells."""
    try:
        choose_backend()
    except InputError:
        return


class _Panels:
    """The wearer's panels, in a temporary file; shrunk and packed in a thread of their own.

    Args:
        size: side of a panel, pixels.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._lengths: list[int] = []
        self._pending: deque[Future[NDArray[np.uint8]]] = deque()

    def __enter__(self) -> _Panels:
        self._file, self._thread = tempfile.TemporaryFile(), ThreadPoolExecutor(1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown()
        self._file.close()

    def keep(self, frame: Frame) -> None:
        """The panel of the next frame ``[H, W, 3]``."""
        self._pending.append(self._thread.submit(self._packed, frame))
        self._write(_AHEAD)

    def _packed(self, frame: Frame) -> NDArray[np.uint8]:
        # Colours in OpenCV's order or not: they are unpacked as they were packed.
        packed, data = cv2.imencode(".jpg", middle_square(frame, self._size), _JPEG)
        if not packed:
            raise InputError("size", "size", f"a panel of {self._size} pixels cannot be packed")
        return np.asarray(data, dtype=np.uint8)

    def _write(self, waiting: int) -> None:
        while len(self._pending) > waiting:
            data = self._pending.popleft().result().tobytes()
            self._file.write(data)
            self._lengths.append(len(data))

    def frames(self) -> Iterator[Frame]:
        """The panels ``[size, size, 3]`` in order."""
        self._write(0)
        self._file.seek(0)
        for length in self._lengths:
            data = np.frombuffer(self._file.read(length), np.uint8)
            yield np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
