"""Pictures of a scene through a lens, by a sensor whose rows are exposed one after the other.

MuJoCo draws pinholes whose rows are exposed at once. A wide fisheye is put together from one or two of them. A rolling
shutter is drawn in bands of rows: each band shows the scene at its own middle's time, and within a band each row is
turned by the camera's angular velocity. So turns are right to the row, and what moves is right to the band.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.lens import Camera
from egopose.vision.places.scenery import FILM_CAMERA
from egopose.vision.rendering import SceneRenderer
from egopose.vision.video import Frame

# A single pinhole serves while it shows no more than this tangent to a side; beyond, two share the picture.
_WIDEST_TANGENT = 2.4
# Pinholes that are put together show a little more than is needed: rows turn against their band's middle.
_MARGIN = 1.04
# Of a fisheye: pixels of a pinhole for one of the picture's, in the middle. Off the axis a pinhole is sharper anyway.
_SHARPNESS = 0.8
# Widest lenses, degrees across and to the corner: two pinholes turned by a third of the width see no further.
_WIDEST = {"pinhole": 125.0, "fisheye": 140.0}

# Puts what moves in a scene where it is at a time (s).
Move = Callable[[mujoco.MjModel, mujoco.MjData, float], None]


@dataclass(frozen=True)
class Optics:
    """A lens and the part of its picture that is kept.

    Args:
        width, height: pixels of the picture that is kept.
        field_of_view: degrees across the width that is kept.
        lens: ``pinhole`` or ``fisheye`` (equidistant).
        crop: share of the sensor's width and height that is not kept, for stabilisation.

    Raises:
        InputError: a size or an angle that cannot be.
    """

    width: int
    height: int
    field_of_view: float
    lens: str = "pinhole"
    crop: float = 0.0

    def __post_init__(self) -> None:
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096):
            raise InputError("film", "size", f"{self.width} x {self.height}; 16 to 4096 pixels a side")
        if not 0.0 <= self.crop <= 0.5:
            raise InputError("film", "crop", f"{self.crop}; 0 to 0.5")
        widest = _WIDEST[self.camera.kind]
        if not 10.0 <= self.field_of_view <= widest:
            raise InputError(
                "film", "field_of_view", f"{self.field_of_view}; 10 to {widest:g} degrees of a {self.lens}"
            )
        if self._angle(np.hypot(*self._corner())) >= np.deg2rad(100.0):
            raise InputError("film", "field_of_view", f"{self.field_of_view}: the sensor's corners look behind; less")

    @property
    def camera(self) -> Camera:
        """The lens, of which the picture that is kept is the whole."""
        return Camera(self.field_of_view, self.lens)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return self.camera.focal_length(self.width)

    def _corner(self) -> tuple[float, float]:
        """Half the sensor's width and height, in focal lengths."""
        keep = 2 * self.focal * (1 - self.crop)
        return self.width / keep, self.height / keep

    def _angle(self, radius: Array | float) -> Array:
        return np.asarray(radius if self.lens == "fisheye" else np.arctan(radius), dtype=np.float64)

    def rays(self) -> Array:
        """Unit vectors ``[height, width, 3]`` that the pixels' middles look along, in camera axes."""
        u = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal
        v = (np.arange(self.height) + 0.5 - 0.5 * self.height) / self.focal
        return self._directions(*np.meshgrid(u, v))

    def _directions(self, x: Array, y: Array) -> Array:
        radius = np.hypot(x, y)
        angle = self._angle(radius)
        side = np.sin(angle) / np.maximum(radius, 1e-12)
        return np.stack([x * side, y * side, np.cos(angle)], axis=-1)

    def border(self, kept: bool) -> Array:
        """Unit vectors ``[16, 3]`` along the border of what is kept, or of the sensor."""
        across, down = np.array(self._corner()) * ((1 - self.crop) if kept else 1.0)
        t = np.linspace(-1.0, 1.0, 5)[:4]
        x = np.concatenate([t, np.ones(4), -t, -np.ones(4)])
        y = np.concatenate([-np.ones(4), t, np.ones(4), -t])
        return self._directions(across * x, down * y)

    def on_sensor(self, directions: Array) -> Array:
        """Where directions ``[..., 3]`` fall ``[..., 2]``: right and down, -1 to 1 from edge to edge of the sensor."""
        side = np.hypot(directions[..., 0], directions[..., 1])
        angle = np.arctan2(side, directions[..., 2])
        radius = angle if self.lens == "fisheye" else np.tan(np.minimum(angle, np.deg2rad(89.0)))
        flat = directions[..., :2] / np.maximum(side, 1e-12)[..., None] * radius[..., None]
        return np.asarray(flat / np.array(self._corner()), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Moment:
    """The scene at a time (s): pose ``[nq]``, camera's place ``[3]`` m, rotation ``[3, 3]`` to the world, and rad/s.

    The angular velocity ``[3]`` is in camera axes.
    """

    time: float
    qpos: Array
    position: Array
    rotation: Array
    angular_velocity: Array


@dataclass(frozen=True, eq=False)
class _View:
    """A pinhole: turn about the camera's y axis (rad), tangents of half its width and height, its size in pixels."""

    turn: float
    tangents: tuple[float, float]
    size: tuple[int, int]


class Shooter:
    """Takes pictures of a model's scene by its camera ``film``; a context manager.

    Args:
        model: of :func:`egopose.vision.places.scenery.scenery_model`.
        optics: of the camera.
        far: m, what lies further is not drawn.
        move: puts what moves in the scene where it is at a time (s).

    Raises:
        RuntimeError: no OpenGL here.
    """

    def __init__(self, model: mujoco.MjModel, optics: Optics, far: float, move: Move) -> None:
        self.optics, self._move = optics, move
        self._rays = optics.rays()
        self._plain = optics.lens == "pinhole" and optics.crop == 0.0
        self._views = _views(optics)
        sizes = [(optics.width, optics.height), *(view.size for view in self._views)]
        self._renderers: dict[tuple[int, int], SceneRenderer] = {}
        for size in sizes if self._plain else sizes[1:]:
            if size not in self._renderers:
                self._renderers[size] = SceneRenderer(model, *size, far=far)
        self._camera = model.camera(FILM_CAMERA).id

    def __enter__(self) -> Shooter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for renderer in self._renderers.values():
            renderer.close()

    def shoot(self, moments: Sequence[Moment], readout: float = 0.0, image_rotation: Array | None = None) -> Frame:
        """A picture ``[height, width, 3]``.

        Args:
            moments: of the bands of the sensor's rows, from its top; one for a shutter that does not roll.
            readout: s from the first row's exposure to the last's.
            image_rotation: ``[3, 3]`` from the kept picture's axes to the camera's, of stabilisation; None is none.
        """
        optics = self.optics
        if self._plain and len(moments) == 1 and readout == 0.0 and image_rotation is None:
            tangent = np.tan(np.deg2rad(0.5 * optics.field_of_view)) * optics.height / optics.width
            renderer = self._aimed(moments[0], (optics.width, optics.height), 0.0, float(tangent))
            return renderer.render_rows(moments[0].qpos, FILM_CAMERA, 0, optics.height).copy()
        rays = self._rays if image_rotation is None else self._rays @ image_rotation.T
        # Of the sensor's rows: 0 to 1 from its upper edge to its lower.
        row = 0.5 + 0.5 * optics.on_sensor(rays)[..., 1]
        band = np.clip((row * len(moments)).astype(int), 0, len(moments) - 1)
        picture = np.zeros((optics.height, optics.width, 3), np.uint8)
        for i, moment in enumerate(moments):
            mine = band == i
            lines = np.flatnonzero(mine.any(axis=1))
            if not len(lines):
                continue
            part = slice(int(lines[0]), int(lines[-1]) + 1)
            late = (row[part] - (i + 0.5) / len(moments)) * readout
            turned = rays[part] + late[..., None] * np.cross(moment.angular_velocity, rays[part])
            self._fill(picture[part], mine[part], turned, moment)
        return picture

    def _fill(self, picture: Frame, mine: NDArray[np.bool_], rays: Array, moment: Moment) -> None:
        """Draw those pixels of a part of the picture that are ``mine``, from each view that sees them."""
        for k, view in enumerate(self._views):
            shown = mine if len(self._views) == 1 else mine & ((rays[..., 0] >= 0) == (k == 1))
            if not shown.any():
                continue
            c, s = np.cos(view.turn), np.sin(view.turn)
            ahead = np.maximum(c * rays[..., 2] + s * rays[..., 0], 1e-3)
            (width, height), (across, down) = view.size, view.tangents
            x = 0.5 * width * (1 + (c * rays[..., 0] - s * rays[..., 2]) / (ahead * across)) - 0.5
            y = 0.5 * height * (1 + rays[..., 1] / (ahead * down)) - 0.5
            top = int(np.clip(np.floor(y[shown].min()) - 1, 0, height - 2))
            bottom = int(np.clip(np.ceil(y[shown].max()) + 2, top + 2, height))
            renderer = self._aimed(moment, view.size, view.turn, down)
            drawn = renderer.render_rows(moment.qpos, FILM_CAMERA, top, bottom)
            seen = cv2.remap(
                np.ascontiguousarray(drawn),
                x.astype(np.float32),
                (y - top).astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            picture[shown] = seen[shown]

    def _aimed(self, moment: Moment, size: tuple[int, int], turn: float, tangent: float) -> SceneRenderer:
        """The renderer of a size, its camera where the moment has it, turned right by ``turn``."""
        renderer = self._renderers[size]
        c, s = np.cos(turn), np.sin(turn)
        about = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        # MuJoCo's camera has y up and z behind.
        axes = moment.rotation @ about * np.array([1.0, -1.0, -1.0])
        mujoco.mju_mat2Quat(renderer.model.cam_quat[self._camera], np.ascontiguousarray(axes).ravel())
        renderer.model.cam_pos[self._camera] = moment.position
        renderer.model.cam_fovy[self._camera] = np.rad2deg(2 * np.arctan(tangent))
        self._move(renderer.model, renderer.data, moment.time)
        return renderer


def _views(optics: Optics) -> tuple[_View, ...]:
    """The pinholes that together see all of the sensor, about as sharp in the middle as the picture that is kept."""
    # The border bulges between its sixteen points by less than the margin.
    border = optics.border(kept=False)
    single = np.abs(border[:, :2]) / np.maximum(border[:, 2:], 1e-3)
    if single.max() <= _WIDEST_TANGENT:
        return (_view(0.0, single, optics),)
    across = float(np.arccos(np.clip(border[np.abs(border[:, 1]).argmin(), 2], -1, 1)))
    views = []
    for turn in (-0.55 * across, 0.55 * across):
        c, s = np.cos(turn), np.sin(turn)
        middle = np.array([[0.0, y, np.sqrt(1 - y * y)] for y in (border[:, 1].min(), border[:, 1].max())])
        mine = np.concatenate([border[border[:, 0] * turn >= 0], middle])
        ahead = np.maximum(c * mine[:, 2] + s * mine[:, 0], 0.05)
        flat = np.stack([np.abs(c * mine[:, 0] - s * mine[:, 2]) / ahead, np.abs(mine[:, 1]) / ahead], axis=1)
        views.append(_view(turn, flat, optics))
    return tuple(views)


def _view(turn: float, flat: Array, optics: Optics) -> _View:
    wide, high = _MARGIN * flat.max(0)
    focal = optics.focal * (_SHARPNESS if optics.lens == "fisheye" else 1.0)
    size = (int(np.ceil(2 * wide * focal)), int(np.ceil(2 * high * focal)))
    return _View(turn, (float(wide), float(high)), size)
