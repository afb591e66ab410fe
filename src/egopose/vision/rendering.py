"""Pictures of a motion: the wearer's own view from a camera on the head, and the view from beside.

Rendering is MuJoCo's, without shadows and multisampling: on a CPU these cost eight times the rest.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from types import TracebackType

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array
from egopose.vision.corruption import Corruption
from egopose.vision.gl import open_context
from egopose.vision.mounts import WEARER_CAMERA, camera_orientations
from egopose.vision.rooms import Room, RoomConfig, draw_room, furnish
from egopose.vision.surfaces import Range
from egopose.vision.video import Frame, write_video

# Distances of the near and far clipping planes: nearer than the hands come to the eyes, further than any room.
_NEAR, _FAR = 0.03, 60.0
# Of the spheres and capsules in the view from beside: two thirds of MuJoCo's own, which the pixels do not tell apart.
_SLICES, _STACKS = 18, 10
# Frames of the view from beside that may wait in each panel's thread.
_AHEAD = 3
# The body's reach above its root, for the ceiling.
_REACH = 1.2


@dataclass(frozen=True)
class CameraConfig:
    """How cameras are worn, in degrees and seconds (``conf/vision/rendered.yaml``): ranges a take draws from."""

    field_of_view: Range
    pitch_down: Range
    roll: Range
    yaw: Range
    shake: Range
    shake_time: float


@dataclass(frozen=True)
class WearerCamera:
    """One take's camera: field of view (degrees), mounting yaw, pitch down, roll (rad), and its play (rad, s)."""

    field_of_view: float
    yaw: float
    pitch_down: float
    roll: float
    shake: float
    shake_time: float

    @staticmethod
    def draw(rng: np.random.Generator, config: CameraConfig) -> WearerCamera:
        """A camera from the config's ranges."""
        yaw, pitch, roll, shake = (
            float(np.deg2rad(rng.uniform(*r))) for r in (config.yaw, config.pitch_down, config.roll, config.shake)
        )
        return WearerCamera(float(rng.uniform(*config.field_of_view)), yaw, pitch, roll, shake, config.shake_time)

    def angles(self, rng: np.random.Generator, count: int, fps: float) -> Array:
        """``[count, 3]`` yaw, pitch down, roll (rad) of each frame: the mounting and its play, correlated in time."""
        keep = float(np.exp(-1.0 / (self.shake_time * fps)))
        noise = rng.normal(scale=self.shake, size=(count, 3))
        for t in range(1, count):
            noise[t] = keep * noise[t - 1] + np.sqrt(1 - keep**2) * noise[t]
        return np.array([self.yaw, self.pitch_down, self.roll]) + noise


def worn_camera(take_seed: int, count: int, fps: float, config: CameraConfig) -> tuple[WearerCamera, Array]:
    """A take's camera, and yaw, pitch down, roll (rad) of each of its ``count`` frames ``[count, 3]``."""
    rng = np.random.default_rng([take_seed, 2])
    worn = WearerCamera.draw(rng, config)
    return worn, worn.angles(rng, count, fps)


class SceneRenderer:
    """Renders poses of a compiled model; a context manager that gives its OpenGL back.

    Args:
        model: any MuJoCo model; it is copied.
        width, height: of the pictures, pixels.
        far: m, what lies further is not drawn.

    Raises:
        RuntimeError: no OpenGL here; the message says what to install.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, far: float = _FAR) -> None:
        self.model = copy.copy(model)
        visual = self.model.vis
        visual.global_.offwidth, visual.global_.offheight = max(width, 64), max(height, 64)
        visual.quality.offsamples = 0
        visual.quality.shadowsize = 0
        visual.map.znear, visual.map.zfar = _NEAR / self.model.stat.extent, far / self.model.stat.extent
        self.data = mujoco.MjData(self.model)
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 200)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._options = mujoco.MjvOption()
        self._gl = open_context(width, height)
        self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the context; a second call does nothing."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def render(self, qpos: Array, camera: str | mujoco.MjvCamera) -> Frame:
        """The picture ``[height, width, 3]`` of pose ``qpos [nq]`` by a camera of the model or a free one.

        Raises:
            ValueError: qpos is of another length; after :meth:`close`.
            KeyError: the model has no camera of that name.
        """
        self._draw(qpos, camera)
        return np.flipud(self._pixels).copy()

    def render_rows(self, qpos: Array, camera: str, top: int, bottom: int) -> Frame:
        """Rows ``top`` to ``bottom`` (not included) of :meth:`render`'s picture, for about their share of its time.

        Raises as :meth:`render`.
        """
        self._draw(qpos, camera, (top, bottom))
        return np.flipud(self._pixels[: bottom - top])

    def segment(self, qpos: Array, camera: str | mujoco.MjvCamera) -> NDArray[np.int32]:
        """Which geom each pixel of :meth:`render`'s picture shows: its id ``[height, width]``, -1 for none.

        Raises as :meth:`render`.
        """
        flags = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        self._scene.flags[flags] = 1
        try:
            self._draw(qpos, camera)
        finally:
            self._scene.flags[flags] = 0
        # A pixel's colour is 1 + the number of what it shows in the scene, which is not the geom's in the model.
        shown = self._pixels.astype(np.int64) @ (1, 1 << 8, 1 << 16)
        ids = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                ids[geom.segid + 1] = geom.objid
        return np.flipud(ids[np.minimum(shown, len(ids) - 1)]).copy()

    def _draw(self, qpos: Array, camera: str | mujoco.MjvCamera, rows: tuple[int, int] | None = None) -> None:
        if self._gl is None:
            raise ValueError("the renderer is closed")
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        if isinstance(camera, str):
            view = mujoco.MjvCamera()
            view.type = mujoco.mjtCamera.mjCAMERA_FIXED
            view.fixedcamid = self.model.camera(camera).id
        else:
            view = camera
        self._gl.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self.data, self._options, None, view, every, self._scene)
        if rows is None:
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
            return
        height, width = self._pixels.shape[:2]
        for eye in self._scene.camera:
            low, high = eye.frustum_bottom, eye.frustum_top
            eye.frustum_width = 0.5 * (high - low) * width / height
            eye.frustum_top = high - (high - low) * rows[0] / height
            eye.frustum_bottom = high - (high - low) * rows[1] / height
        part = mujoco.MjrRect(0, 0, width, rows[1] - rows[0])
        mujoco.mjr_render(part, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels[: rows[1] - rows[0]], None, part, self._context)


def furnished_model(model_xml: str, room: Room, config: RoomConfig) -> mujoco.MjModel:
    """The humanoid in a room, as its wearer sees it: dressed, the own head out of sight.

    Raises:
        ValueError: the model has no camera ``head``.
    """
    spec = mujoco.MjSpec.from_string(model_xml)
    mount = spec.camera(WEARER_CAMERA)
    if mount is None:
        raise ValueError(f"the model has no camera {WEARER_CAMERA!r}")
    furnish(spec, room, config)
    for geom in mount.parent.geoms:
        # Seen from inside, one's own head is nothing but an obstacle.
        geom.material, geom.rgba = "", [0, 0, 0, 0]
    return spec.compile()


def wearer_frames(
    model_xml: str,
    qpos: Array,
    *,
    room_seed: int,
    take_seed: int,
    room: RoomConfig,
    camera: CameraConfig,
    size: int,
    fps: float,
    corruption: Corruption | None = None,
) -> Iterator[Frame]:
    """What the wearer's head camera sees, frame by frame.

    Args:
        model_xml: the humanoid's MJCF with a camera ``head`` on its head.
        qpos: ``[T, nq]`` at ``fps``.
        room_seed: which room (:func:`egopose.vision.rooms.room_seed`).
        take_seed: how the camera is worn and shakes.
        room, camera: ranges.
        size: side of the square pictures, pixels.
        fps: frames per second.
        corruption: what is wrong with the video.

    Raises:
        ValueError: no frames, or the model has no camera ``head`` or another number of coordinates.
        RuntimeError: no OpenGL here.
    """
    if len(qpos) == 0:
        raise ValueError("a motion without frames cannot be rendered")
    model = furnished_model(model_xml, draw_room(room_seed, qpos[:, :2], float(qpos[:, 2].max()) + _REACH, room), room)
    if qpos.shape[1] != model.nq:
        raise ValueError(f"qpos has {qpos.shape[1]} coordinates, the model {model.nq}")
    worn, angles = worn_camera(take_seed, len(qpos), fps, camera)
    shown = np.arange(len(qpos))
    if corruption is not None:
        wrong = corruption.generator(take_seed)
        angles, shown = angles + corruption.angles(wrong, len(qpos), fps), corruption.shown(wrong, len(qpos))
    orientations = camera_orientations(model, angles)
    with SceneRenderer(model, size, size) as renderer:
        index = model.camera(WEARER_CAMERA).id
        renderer.model.cam_fovy[index] = worn.field_of_view
        for frame in shown:
            renderer.model.cam_quat[index] = orientations[frame]
            yield renderer.render(qpos[frame], WEARER_CAMERA)


def render_wearer_video(
    model_xml: str,
    qpos: Array,
    path: str | PathLike[str],
    *,
    room_seed: int,
    take_seed: int,
    room: RoomConfig,
    camera: CameraConfig,
    size: int,
    fps: float,
    corruption: Corruption | None = None,
) -> None:
    """Write :func:`wearer_frames` to an MP4, whole or not at all. Raises as it and as ``VideoWriter``."""
    frames = wearer_frames(
        model_xml,
        qpos,
        room_seed=room_seed,
        take_seed=take_seed,
        room=room,
        camera=camera,
        size=size,
        fps=fps,
        corruption=corruption,
    )
    write_video(path, frames, fps)


def side_view_frames(
    model: mujoco.MjModel, motions: Sequence[Iterable[Array]], labels: Sequence[str], size: int, azimuth: float = 120.0
) -> Iterator[Frame]:
    """Motions beside each other, each followed by a camera that keeps its root in the middle.

    Args:
        model: the humanoid with its floor.
        motions: one or more ``[T, nq]``, or their rows as they come; the shortest decides the length.
        labels: one a motion, written into its panel.
        size: side of a panel, pixels; a frame is ``[size, size * len(motions), 3]``.
        azimuth: from where the cameras look, degrees about z.

    Raises:
        RuntimeError: no OpenGL here.
    """
    coarse = copy.copy(model)
    coarse.vis.quality.numslices, coarse.vis.quality.numstacks = _SLICES, _STACKS
    with ExitStack() as stack:
        views = [stack.enter_context(closing(_SideView(coarse, label, size, azimuth))) for label in labels]
        pending: deque[list[Future[Frame]]] = deque()
        for poses in zip(*motions, strict=False):
            pending.append([view.draw(pose) for view, pose in zip(views, poses, strict=True)])
            if len(pending) > _AHEAD:
                yield np.concatenate([panel.result() for panel in pending.popleft()], axis=1)
        while pending:
            yield np.concatenate([panel.result() for panel in pending.popleft()], axis=1)


class _SideView:
    """One panel of :func:`side_view_frames`, drawn in a thread of its own: an OpenGL context belongs to a thread."""

    def __init__(self, model: mujoco.MjModel, label: str, size: int, azimuth: float) -> None:
        self._label, self._view = label, mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._view.distance, self._view.elevation, self._view.azimuth = 3.2, -12.0, azimuth
        self._thread = ThreadPoolExecutor(1)
        self._renderer = self._thread.submit(SceneRenderer, model, size, size).result()

    def draw(self, pose: Array) -> Future[Frame]:
        return self._thread.submit(self._draw, pose)

    def _draw(self, pose: Array) -> Frame:
        self._view.lookat = [pose[0], pose[1], 0.85]
        return label_frame(self._renderer.render(pose, self._view), self._label)

    def close(self) -> None:
        self._thread.submit(self._renderer.close).result()
        self._thread.shutdown()


def label_frame(frame: Frame, label: str) -> Frame:
    """A copy of the frame with a line of text at its upper left, readable on any ground."""
    frame = frame.copy()
    on_black, kept = _label_marks(label, frame.shape[0], frame.shape[1])
    marked = frame[: kept.shape[0], : kept.shape[1]]
    marked[...] = on_black + (marked * kept >> 8).astype(np.uint8)
    return frame


@lru_cache(maxsize=16)
def _label_marks(label: str, height: int, width: int) -> tuple[Frame, NDArray[np.uint16]]:
    """The corner of a picture that a label touches: the label on black, and the share of the ground that shows through,
    of 256. Writing it anew into every frame takes a fifth of the time that rendering does."""
    black, white = (_written(np.full((height, width, 3), ground, np.uint8), label) for ground in (0, 255))
    kept = np.round((white.astype(float) - black) * (256 / 255)).astype(np.uint16)
    rows, columns = (int(np.flatnonzero((kept < 256).any(axes)).max(initial=-1)) + 1 for axes in ((1, 2), (0, 2)))
    return black[:rows, :columns], kept[:rows, :columns].copy()


def _written(frame: Frame, label: str) -> Frame:
    """The frame with a line of text at its upper left."""
    scale = frame.shape[0] / 480
    x, y, size = int(10 * scale) + 2, int(30 * scale) + 4, max(scale, 0.4)
    # The outline is the text itself, shifted: a thicker stroke is also wider in OpenCV 5, and ends elsewhere.
    marks = [(dx, dy, (0, 0, 0)) for dx in (-1, 1) for dy in (-1, 1)] + [(0, 0, (255, 255, 255))]
    for dx, dy, colour in marks:
        cv2.putText(frame, label, (x + dx, y + dy), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
    return frame
