"""Pictures of a reconstruction: the film with the simulated body over it, and renderings of both bodies."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import mujoco
import numpy as np

from egopose.evaluation.scene_pictures import Moments, rows_of
from egopose.humanoid.surface_contacts import Surfaces
from egopose.inference.reconstruction import Reconstruction
from egopose.motion.rotations import Array
from egopose.scene.clip import box_poses
from egopose.scene.drawing import body_points, draw_bones, draw_box
from egopose.scene.projection import Projection
from egopose.scene.scene_file import Scene
from egopose.vision.rendering import SceneRenderer, label_frame
from egopose.vision.video import Frame

_KINEMATIC, _SIMULATED = (190, 190, 190), (70, 230, 110)
_ROUND = 1.5  # times the body's extent in the film: the cut around it
_ACROSS = 4  # moments beside each other
_DISTANCE, _ASIDE = 3.4, 1.3  # m from the camera to the body, and more for each m that the two bodies are apart
_APART = 1.5  # m: bodies further apart are looked at each by itself
_GREY = 120
_USUAL_VIEW = (90.0, -10.0)  # degrees: along y, as a scene's camera looks, and a little down


def moment_grids(found: Reconstruction, projection: Projection | None, moments: Moments, size: int) -> list[Frame]:
    """Pictures of a few moments each: a column a moment, rows as :func:`row_names` says.

    Args:
        found: what is shown.
        projection: to the film's pixels; None where nothing is known of a film.
        moments: frames of the film.
        size: px of a panel.

    Raises:
        RuntimeError: no OpenGL here.
    """
    rows = [] if projection is None else [film_panels(found, projection, moments, size)]
    with _Renderer(found, found.scene, size) as simulated, _Renderer(found, found.clip.scene, size) as kinematic:
        for renderer, motion, turn in (
            (simulated, found.motion, 0.0),
            (kinematic, found.clip.body, 0.0),
            (simulated, found.motion, 90.0),
        ):
            looks = {t: _USUAL_VIEW if projection is None else view_of(projection.at(t)) for t in moments.numbers}
            rows.append([renderer.draw(motion.qpos[t], look, t, turn) for t, look in looks.items()])
    named = [
        [label_frame(panel, f"{t} {name}") for t, panel in zip(moments.numbers, row, strict=True)]
        for name, row in zip(row_names(projection is not None), rows, strict=True)
    ]
    return [_grid([row[k : k + _ACROSS] for row in named]) for k in range(0, len(moments.numbers), _ACROSS)]


def row_names(film: bool) -> tuple[str, ...]:
    """What the rows of :func:`moment_grids` show, from above, with a film or without."""
    return (*(("film",) if film else ()), "simulated", "kinematic", "simulated, side")


def film_strip(found: Reconstruction, projection: Projection, moments: Moments, size: int) -> Frame:
    """The film's row alone."""
    panels = film_panels(found, projection, moments, size)
    return rows_of([label_frame(panel, str(t)) for t, panel in zip(moments.numbers, panels, strict=True)])


def film_panels(found: Reconstruction, projection: Projection, moments: Moments, size: int) -> list[Frame]:
    """Cuts of the film around the body: grey the kinematic body, green the simulated one, and the boxes."""
    bodies = [body_points(motion) for motion in (found.clip.body, found.motion)]
    out = []
    for t, frame in zip(moments.numbers, moments.frames, strict=True):
        seen = projection.at(t)
        places = [seen.pixels(points[t : t + 1])[0] for points, _ in bodies]
        low, high = places[0].min(axis=0), places[0].max(axis=0)
        scale = size / (_ROUND * float((high - low).max()))
        shift = size / 2 - scale * (low + high) / 2
        matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
        panel: Frame = np.asarray(
            cv2.warpAffine(frame, matrix, (size, size), flags=cv2.INTER_AREA, borderValue=(_GREY, _GREY, _GREY)),
            dtype=np.uint8,
        )
        cut = Projection(seen.matrix * scale, seen.origin * scale + shift)
        for box in found.scene.boxes:
            panel = draw_box(panel, box, cut, 0)
        for place, (_, parents), colour in zip(places, bodies, (_KINEMATIC, _SIMULATED), strict=True):
            panel = draw_bones(panel, place * scale + shift, parents, colour)
        out.append(panel)
    return out


def view_of(projection: Projection) -> tuple[float, float]:
    """Azimuth and elevation (degrees, as MuJoCo counts them) along which the film's camera looks in one frame."""
    right, down = (row / np.linalg.norm(row) for row in projection.matrix[0])
    x, y, z = np.cross(right, down)
    return float(np.rad2deg(np.arctan2(y, x))), float(np.rad2deg(np.arcsin(np.clip(z, -1.0, 1.0))))


class _Renderer:
    """Draws poses among the boxes of a scene."""

    def __init__(self, found: Reconstruction, scene: Scene, size: int) -> None:
        self._roots = found.motion.qpos[:, :3], found.clip.body.qpos[:, :3]
        self._inner = SceneRenderer(found.humanoid.mj_model, size, size)
        Surfaces(found.humanoid).place(self._inner.data, *box_poses(scene))
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FREE

    def __enter__(self) -> _Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self._inner.close()

    def draw(self, pose: Array, view: tuple[float, float], t: int, turn: float) -> Frame:
        """Bodies near each other are looked at from one place: how far they are apart is seen."""
        first, second = (root[t] for root in self._roots)
        apart = float(np.linalg.norm(first - second))
        near = apart < _APART
        azimuth, elevation = view
        self._view.lookat = (0.5 * (first + second) if near else pose[:3]) - [0, 0, 0.15]
        self._view.distance = _DISTANCE + (_ASIDE * apart if near else 0.0)
        self._view.azimuth, self._view.elevation = azimuth + turn, min(elevation, -5.0)
        return self._inner.render(pose, self._view)


def _grid(rows: Sequence[Sequence[Frame]]) -> Frame:
    """Rows below each other; the last moments' are filled up with blanks."""
    return np.concatenate([rows_of([*row, *[np.full_like(row[0], 250)] * (_ACROSS - len(row))]) for row in rows])
