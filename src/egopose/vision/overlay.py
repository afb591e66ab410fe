"""Several bodies in one picture: one solid, the others translucent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing

import mujoco
import numpy as np

from egopose.motion.rotations import Array
from egopose.vision.rendering import SceneRenderer, label_frame
from egopose.vision.video import Frame

Colour = tuple[float, float, float, float]


class OverlayRenderer(SceneRenderer):
    """Renders a body with up to ``overlays`` coloured copies of it in other poses; see :class:`SceneRenderer`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, overlays: int) -> None:
        super().__init__(model, width, height)
        self._scene = mujoco.MjvScene(self.model, maxgeom=(overlays + 1) * self.model.ngeom + 200)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._ghost = mujoco.MjData(self.model)

    def render_with(self, qpos: Array, overlays: Sequence[tuple[Array, Colour]], camera: mujoco.MjvCamera) -> Frame:
        """The picture ``[height, width, 3]`` of ``qpos [nq]`` and the overlays' poses in their colours (rgba)."""
        if self._gl is None:
            raise ValueError("the renderer is closed")
        self._pose(self.data, qpos)
        mujoco.mj_camlight(self.model, self.data)
        self._gl.make_current()
        options, every = self._options, mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self.data, options, None, camera, every, self._scene)
        for pose, colour in overlays:
            self._pose(self._ghost, pose)
            first = self._scene.ngeom
            moving = mujoco.mjtCatBit.mjCAT_DYNAMIC
            mujoco.mjv_addGeoms(self.model, self._ghost, options, mujoco.MjvPerturb(), moving, self._scene)
            for geom in self._scene.geoms[first : self._scene.ngeom]:
                geom.rgba[:] = colour
                geom.matid = -1
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
        return np.flipud(self._pixels).copy()

    def _pose(self, data: mujoco.MjData, qpos: Array) -> None:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)


def overlay_frames(
    model: mujoco.MjModel,
    solid: Array,
    overlays: Sequence[tuple[Array, Colour]],
    label: str,
    size: int,
    azimuth: float = 120.0,
) -> Iterator[Frame]:
    """A motion ``[T, nq]`` with translucent ones around it, from a camera that follows its root.

    Args:
        model: the humanoid with its floor.
        solid: ``[T, nq]``.
        overlays: motions ``[T, nq]``, each with its colour (rgba).
        label: written into the picture.
        size: side of the picture, pixels.
        azimuth: from where the camera looks, degrees about z.

    Raises:
        RuntimeError: no OpenGL here.
    """
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.distance, view.elevation, view.azimuth = 3.6, -12.0, azimuth
    with closing(OverlayRenderer(model, size, size, len(overlays))) as renderer:
        for t, pose in enumerate(solid):
            view.lookat = [pose[0], pose[1], 0.85]
            around = [(motion[t], colour) for motion, colour in overlays]
            yield label_frame(renderer.render_with(pose, around, view), label)
