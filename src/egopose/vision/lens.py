"""A real camera: how its lens bends the picture, how its shutter rolls, how fast it took frames.

Flow of such a camera is brought to what the rendered videos have, a pinhole whose rows are all exposed at once:
pictures are rectified before the flow, and the flow is divided by the time that really passed between its two rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.motion.rotations import Array, to_matrix
from egopose.vision.video import Frame

LENSES = ("pinhole", "fisheye")
STABILISED = ("undo", "ignore")
# Where the search for the angle of a radius ends: nearly 90 degrees, which no flat picture can show.
_WIDEST = np.deg2rad(85.0)
_MOST_COEFFICIENTS = {"pinhole": 5, "fisheye": 4}

_Maps = Callable[[Array], tuple[NDArray[np.float32], NDArray[np.float32]]]


@dataclass(frozen=True)
class Camera:
    """One take's camera (``camera`` of a take; ``conf/data/own.yaml`` gives sources of the numbers).

    Args:
        field_of_view: degrees across the whole width of the frame; None leaves the picture as it is.
        lens: ``pinhole`` (or a camera's *linear* mode) or ``fisheye``: equidistant, radius = f * angle. None takes the
            file's word, else a pinhole.
        distortion: OpenCV's coefficients: ``k1 k2 p1 p2 k3`` of a pinhole, ``k1 k2 k3 k4`` of a fisheye.
        view: degrees across the square picture that flow sees; less where the lens sees less.
        readout: s from the exposure of the first row to that of the last; None takes the file's word, else 0.
        fps: frames/s at which the camera took the video; None believes the file's time stamps.
        stabilised: ``undo`` what the camera steadied, by its file's word, or ``ignore`` it.

    Raises:
        InputError: a value that cannot be; names it.
    """

    field_of_view: float | None = None
    lens: str | None = None
    distortion: tuple[float, ...] = ()
    view: float = 102.5
    readout: float | None = None
    fps: float | None = None
    stabilised: str = "undo"

    def __post_init__(self) -> None:
        if self.lens is not None and self.lens not in LENSES:
            raise InputError("camera", "lens", f"{self.lens!r}; there are {', '.join(LENSES)}")
        if self.stabilised not in STABILISED:
            raise InputError("camera", "stabilised", f"{self.stabilised!r}; there are {', '.join(STABILISED)}")
        widest = 170.0 if self.kind == "pinhole" else 220.0
        if self.field_of_view is not None and not 1.0 <= self.field_of_view <= widest:
            raise InputError(
                "camera", "field_of_view", f"{self.field_of_view} degrees; a {self.kind} has 1 to {widest:g}"
            )
        if self.field_of_view is None and (self.kind != "pinhole" or self.distortion):
            raise InputError("camera", "field_of_view", "is missing: without it the lens cannot be undone")
        if len(self.distortion) > _MOST_COEFFICIENTS[self.kind] or not np.isfinite(self.distortion).all():
            cause = f"at most {_MOST_COEFFICIENTS[self.kind]} finite numbers for a {self.kind}"
            raise InputError("camera", "distortion", cause)
        if not 1.0 <= self.view <= 170.0:
            raise InputError("camera", "view", f"{self.view} degrees; 1 to 170")
        if not 0.0 <= self.delay <= 0.1:
            raise InputError("camera", "readout", f"{self.readout} s; 0 to 0.1 (is it in milliseconds?)")
        if self.fps is not None and not 1.0 <= self.fps <= 1000.0:
            raise InputError("camera", "fps", f"{self.fps}; 1 to 1000")

    @property
    def kind(self) -> str:
        """The lens that is undone: :attr:`lens`, a pinhole where nothing is known."""
        return self.lens or "pinhole"

    @property
    def delay(self) -> float:
        """s from the first row to the last: :attr:`readout`, 0 where nothing is known."""
        return self.readout or 0.0

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any] | None, source: str) -> Camera:
        """From a take's ``camera``; None is a camera of which nothing is known.

        Raises:
            InputError: an unknown setting or a value that cannot be; names ``source``.
        """
        try:
            return from_mapping(cls, values or {}, source)
        except InputError as error:
            raise InputError(source, error.field, error.cause) from None

    def radius(self, angle: Array) -> Array:
        """Distance from the picture's middle, in focal lengths, of a ray at ``angle`` (rad) from the axis."""
        k = np.zeros(5)
        k[: len(self.distortion)] = self.distortion
        if self.kind == "fisheye":
            return angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
        t = np.tan(angle)
        return t * (1 + k[0] * t**2 + k[1] * t**4 + k[4] * t**6)

    def focal_length(self, width: int) -> float:
        """In pixels, of a frame ``width`` pixels wide, whose middle the axis meets."""
        assert self.field_of_view is not None
        return 0.5 * width / float(self.radius(np.array(np.deg2rad(0.5 * self.field_of_view))))

    def seen_view(self, width: int, height: int) -> float:
        """Degrees across the square that flow sees: :attr:`view`, or what the lens shows to the nearest edge."""
        angles = np.linspace(0.0, _WIDEST, 2000)
        nearest = 0.5 * min(width, height) / self.focal_length(width)
        inside = self.radius(angles) <= nearest
        edge = angles[-1] if inside.all() else angles[int(np.argmin(inside)) - 1]
        return float(min(self.view, np.rad2deg(2 * edge)))

    def rectifier(self, width: int, height: int, size: int) -> Callable[[Frame], Frame]:
        """What turns a frame ``[height, width, 3]`` into a pinhole's square ``[2 size, 2 size, 3]``.

        Raises:
            InputError: the distortion folds the picture: its coefficients are not of this lens.
        """
        if self.field_of_view is None:
            return lambda frame: frame
        shrink, maps = self._maps(width, height, size)
        still = maps(np.eye(3))
        return lambda frame: _sampled(shrink(frame), *still)

    def turning_rectifier(
        self, width: int, height: int, size: int
    ) -> Callable[[Frame, Array], tuple[Frame, NDArray[np.bool_]]]:
        """As :meth:`rectifier`, for pictures that were turned against the camera.

        Returns:
            A function of a frame and how it is turned, ``[4]`` from picture to camera axes. It gives the square as the
            camera saw it, and ``[2 size, 2 size]`` where the frame has a picture of it. Elsewhere its edge goes on.

        Raises:
            InputError: without a field of view no picture can be turned; or as :meth:`rectifier`.
        """
        if self.field_of_view is None:
            cause = "is missing: without it a steadied picture cannot be turned back; camera.stabilised=ignore goes on"
            raise InputError("camera", "field_of_view", cause)
        shrink, maps = self._maps(width, height, size)

        def rectify(frame: Frame, turn: Array) -> tuple[Frame, NDArray[np.bool_]]:
            small = shrink(frame)
            across, down = maps(to_matrix(turn))
            return _sampled(small, across, down), _inside(small, across, down)

        return rectify

    def wide_view(self, width: int, height: int, most: float) -> tuple[float, float]:
        """Degrees across and down the pinhole picture that shows the most of a frame, at most ``most`` either way."""
        focal, angles = self.focal_length(width), np.linspace(0.0, _WIDEST, 2000)
        radii = self.radius(angles)
        halves = [angles[int(np.argmin(radii <= 0.5 * side / focal)) - 1] for side in (width, height)]
        return tuple(float(min(np.rad2deg(2 * half), most)) for half in halves)  # type: ignore[return-value]

    def wide_rectifier(
        self, width: int, height: int, across: int, most: float
    ) -> Callable[[Frame, Array | None], tuple[Frame, NDArray[np.bool_] | None]]:
        """What turns a frame into a pinhole's picture ``across`` pixels wide that shows the most of it.

        Args:
            width, height: of frames, pixels.
            across: pixels of the result's width; its height follows from :meth:`wide_view`.
            most: degrees, see :meth:`wide_view`.

        Returns:
            A function of a frame and how it is turned against the camera (:meth:`turning_rectifier`) or None. It gives
            the picture, and where the frame has a picture of it (None: everywhere).

        Raises:
            InputError: as :meth:`rectifier`.
        """
        wide, high = (np.tan(np.deg2rad(0.5 * view)) for view in self.wide_view(width, height, most))
        down = max(round(across * float(high / wide)), 8)
        view = 0.5 * across / float(wide)
        shrink, maps = self._maps_to(width, height, (across, down), view, across / width)
        still = maps(np.eye(3))

        def rectify(frame: Frame, turn: Array | None) -> tuple[Frame, NDArray[np.bool_] | None]:
            small = shrink(frame)
            if turn is None:
                return _sampled(small, *still), None
            places = maps(to_matrix(turn))
            return _sampled(small, *places), _inside(small, *places)

        return rectify

    def _maps(self, width: int, height: int, size: int) -> tuple[Callable[[Frame], Frame], _Maps]:
        """What shrinks a frame, and from which places of the shrunk one the square of a turned camera is sampled."""
        side = 2 * size
        focal = 0.5 * side / float(np.tan(np.deg2rad(0.5 * self.seen_view(width, height))))
        return self._maps_to(width, height, (side, side), focal, side / min(width, height))

    def _maps_to(
        self, width: int, height: int, size: tuple[int, int], focal: float, scale: float
    ) -> tuple[Callable[[Frame], Frame], _Maps]:
        """As :meth:`_maps`, for a pinhole of ``size`` (across, down) and focal length ``focal``, in pixels."""
        assert self.field_of_view is not None
        if not (np.diff(self.radius(np.linspace(0.0, np.deg2rad(0.5 * self.field_of_view), 200))) > 0).all():
            raise InputError("camera", "distortion", "folds the picture over: not the coefficients of this lens")
        # Shrunk first: a picture of many pixels sampled at few points would flicker.
        scale = min(1.0, scale)
        small = (max(round(width * scale), 1), max(round(height * scale), 1))
        own_focal = self.focal_length(width) * small[0] / width
        own = np.array([[own_focal, 0, 0.5 * (small[0] - 1)], [0, own_focal, 0.5 * (small[1] - 1)], [0, 0, 1.0]])
        picture = np.array([[focal, 0, 0.5 * (size[0] - 1)], [0, focal, 0.5 * (size[1] - 1)], [0, 0, 1.0]])
        coefficients = np.zeros(4 if self.kind == "fisheye" else 5)
        coefficients[: len(self.distortion)] = self.distortion
        undistort = cv2.fisheye.initUndistortRectifyMap if self.kind == "fisheye" else cv2.initUndistortRectifyMap

        def shrink(frame: Frame) -> Frame:
            if scale == 1.0:
                return frame
            return cv2.resize(frame, small, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

        def maps(turn: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            across, down = undistort(own, coefficients, turn, picture, size, cv2.CV_32FC1)
            return np.asarray(across, np.float32), np.asarray(down, np.float32)

        return shrink, maps


def _inside(frame: Frame, across: NDArray[np.float32], down: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which places lie in the frame."""
    rows, columns = frame.shape[:2]
    return (across >= -0.5) & (across <= columns - 0.5) & (down >= -0.5) & (down <= rows - 0.5)


def _sampled(frame: Frame, across: NDArray[np.float32], down: NDArray[np.float32]) -> Frame:
    return cv2.remap(frame, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(
        np.uint8, copy=False
    )


def undo_rolling_shutter(flow: NDArray[np.floating], readout: float, interval: float) -> NDArray[np.float16]:
    """Flow ``[..., 2, S, S]`` as if all rows had been exposed at once, to first order.

    A point that moved down by v of the picture's height was seen v * readout later than its frame's stamp says: its
    motion took interval + v * readout, not interval.

    Args:
        flow: channel 1 down, in picture widths (the picture is square) per ``interval``.
        readout: s from the picture's first row to its last.
        interval: s between the two frames.
    """
    wide = np.asarray(flow, dtype=np.float64)
    # More than half an interval of delay is no turn of a head but a faulty vector.
    delay = np.clip(wide[..., 1:, :, :] * readout / interval, -0.5, 0.5)
    return (wide / (1.0 + delay)).astype(np.float16)
