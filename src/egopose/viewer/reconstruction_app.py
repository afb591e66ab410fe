"""A reconstruction in the browser: the simulated body among its boxes, what acts on it, the camera and the film."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.inference.reconstruction import read_reconstruction
from egopose.inference.scene_stages import film_of, load_projection
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.scene.clip import BODIES, wanted_contacts
from egopose.scene.drawing import body_points, draw_bones, draw_box
from egopose.scene.projection import Projection, camera_poses
from egopose.scene.scene_file import FLOOR, Box
from egopose.scene.upright import focal_length
from egopose.viewer.auth_proxy import Address
from egopose.viewer.charts import Chart
from egopose.viewer.clip import Footage
from egopose.viewer.figure import Color, Figure
from egopose.viewer.serving import furnish, tile
from egopose.viewer.timeline import TimelineViewer
from egopose.viewer.video_panel import Pictures
from egopose.vision.video import Frame, VideoInfo, probe_video

_SIMULATED: Color = (70, 110, 220)
_KINEMATIC: Color = (150, 150, 150)
_BOX: Color = (200, 160, 90)
_CAMERA: Color = (60, 60, 60)
_LINE, _FADED = (70, 230, 110), (190, 190, 190)
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2")
_FRUSTUM = 0.25  # m, of the camera's shape


class ReconstructionViewer(TimelineViewer):
    """Serves until :meth:`close`.

    Args:
        folder: of a reconstruction.
        humanoid: that was simulated, without boxes.
        address: where browsers come in.
        video: the film, where it is no longer where it was.
        simulated: another simulated motion of the clip; None for ``plan.npz``.

    Raises:
        InputError: a file is missing or damaged, the controls do not lead through the states, or the address cannot be
            listened at.
    """

    def __init__(
        self,
        folder: Path,
        humanoid: HumanoidModel,
        address: Address,
        video: Path | None = None,
        simulated: Path | None = None,
    ) -> None:
        self._found = found = read_reconstruction(folder, humanoid, simulated)
        self._projection = load_projection(folder / "projection.npz")
        if len(self._projection.origin) != len(found.motion):
            cause = f"{len(self._projection.origin)} frames; the clip has {len(found.motion)}"
            raise InputError(folder / "projection.npz", "origin", cause)
        self._film = film_of(folder) if video is None else video
        self._info: VideoInfo | None = None if self._film is None else probe_video(self._film)
        self._bodies = [
            (self._projection.pixels(points), parents)
            for points, parents in (body_points(motion) for motion in (found.clip.body, found.motion))
        ]
        self._wanted = wanted_contacts(found.scene, found.humanoid, len(found.motion))
        self._touching = found.forces.any_at_frame(found.forces.touching)
        super().__init__(address)

    def _build(self) -> None:
        found, scene = self._found, self._server.scene
        self._world, self._floor = furnish(self._server)
        if self._film is not None:
            self._pictures = Pictures(Footage(self._film, start=found.scene.begin), found.motion.fps, len(found.motion))
        self._simulated = Figure(scene, "/world/simulated", found.motion, _SIMULATED, marks=True)
        self._kinematic = Figure(scene, "/world/kinematic", found.clip.body, _KINEMATIC, 0.35)
        self._boxes = [self._add_box(f"/world/boxes/{box.name}", box, 1.0) for box in found.scene.boxes]
        self._guesses = [self._add_box(f"/world/guesses/{box.name}", box, 0.25) for box in found.clip.scene.boxes]
        self._camera_path()
        z = float(found.motion.qpos[0, 2])
        self._server.initial_camera.position = (3.0, -4.0, z + 1.0)
        self._server.initial_camera.look_at = (0.0, 0.0, z - 0.3)
        self._panel()
        self._load_timeline(len(found.motion), found.motion.fps)
        self._charts()

    def _panel(self) -> None:
        gui = self._server.gui
        self._add_timeline()
        self._speed: Any = gui.add_dropdown("Speed", _SPEEDS, initial_value="1")
        self._status = gui.add_markdown("")
        self._video = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="The film", visible=self._pictures is not None)
        self._contacts = gui.add_markdown("")
        self._force = Chart(gui, "Vertical force of the ground, body weights")
        self._height = Chart(gui, "Height of the root, m")
        names = ("kinematic body", "boxes of the first guess", "contacts and torques", "camera")
        with gui.add_folder("Show", expand_by_default=False):
            self._layers = {name: gui.add_checkbox(name, name != "boxes of the first guess") for name in names}
            self._follow = gui.add_checkbox("follow", True)
            self._again = gui.add_checkbox("loop", True)
        self._on(self._speed, lambda: setattr(self._player, "speed", float(self._speed.value)))
        self._on(self._again, lambda: setattr(self._player, "loop", self._again.value))
        for box in (*self._layers.values(), self._follow):
            self._on(box, lambda: None)  # drawn anew

    def _add_box(self, name: str, box: Box, opacity: float) -> Any:
        assert box.place is not None
        assert box.height is not None
        height, yaw = max(box.height, 0.005), box.yaw or 0.0
        return self._server.scene.add_box(
            name,
            _BOX,
            (*box.size, height),
            opacity=None if opacity >= 1 else opacity,
            wxyz=(float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))),
            position=(*box.place, height / 2),
        )

    def _camera_path(self) -> None:
        """Where the film's camera stood, if it looked straight at the body."""
        size = (1280, 720) if self._info is None else (self._info.width, self._info.height)
        focal = focal_length(size, self._found.scene.camera.field_of_view)
        self._places, axes = camera_poses(self._projection, self._found.clip.body.qpos[:, :3], focal)
        self._turns = rot.from_scipy(Rotation.from_matrix(axes.transpose(0, 2, 1)), (len(axes),))
        angle = 2 * float(np.arctan(0.5 * size[1] / focal))
        self._eye: Any = self._server.scene.add_camera_frustum(
            "/world/camera", angle, size[0] / size[1], scale=_FRUSTUM, color=_CAMERA
        )
        pairs = np.stack([self._places[:-1], self._places[1:]], axis=1).astype(np.float32)
        self._path: Any = self._server.scene.add_line_segments("/world/path", pairs, _CAMERA)

    def _charts(self) -> None:
        found, forces = self._found, self._found.forces
        upward = forces.per_frame(forces.force[..., 2].sum(axis=2)) / forces.weight
        lines: dict[str, tuple[Array, str]] = {"all": (upward.sum(axis=1), "#888")}
        for side, colour in (("Right", "#d55e00"), ("Left", "#0072b2")):
            lines[f"{side.lower()} foot"] = (upward[:, found.humanoid.skeleton.index(f"{side}Foot")], colour)
        self._force.set(lines, found.motion.fps)
        heights = {"simulated": (found.motion.qpos[:, 2], "#466edc"), "kinematic": (found.clip.body.qpos[:, 2], "#999")}
        self._height.set(heights, found.motion.fps)

    def _draw(self, frame: int, slow: bool) -> None:
        layer = {name: box.value for name, box in self._layers.items()}
        with self._server.atomic():
            self._simulated.show(frame, marks=layer["contacts and torques"])
            self._kinematic.show(frame, layer["kinematic body"])
            root = self._simulated.root(frame) if self._follow.value else np.zeros(3)
            self._world.position = (-root[0], -root[1], 0.0)
            self._floor.position = tile(root)
            for shape in self._guesses:
                shape.visible = layer["boxes of the first guess"]
            self._eye.position, self._eye.wxyz = self._places[frame], self._turns[frame]
            self._eye.visible = self._path.visible = layer["camera"]
        self._show_film(frame)
        if slow:
            self._show_timeline(frame)
            self._status.content = self._line(frame)
            self._contacts.content = self._contact_table(frame)
            for chart in (self._force, self._height):
                chart.at(frame)

    def _show_film(self, frame: int) -> None:
        picture = None if self._pictures is None else self._pictures.at(frame)
        if picture is None:
            return
        assert self._info is not None
        self._eye.image = picture
        self._video.image = self._over(picture, frame, picture.shape[1] / self._info.width)

    def _over(self, picture: Frame, frame: int, scale: float) -> Frame:
        """The picture with boxes, the kinematic body and the simulated one over it."""
        small = Projection(self._projection.matrix * scale, self._projection.origin * scale)
        for box in self._found.scene.boxes:
            picture = draw_box(picture, box, small, frame)
        for (places, parents), colour in zip(self._bodies, (_FADED, _LINE), strict=True):
            picture = draw_bones(picture, places[frame] * scale, parents, colour)
        return picture

    def _line(self, frame: int) -> str:
        motion, body = self._found.motion, self._found.clip.body
        apart = float(np.linalg.norm(motion.qpos[frame, :3] - body.qpos[frame, :3]))
        parts = [f"frame {frame} of {len(motion)}, {frame / motion.fps:.2f} s", "blue: simulated", "grey: kinematic"]
        parts.append(f"roots {apart:.2f} m apart")
        parts += [f"film: {self._pictures.fault}"] if self._pictures is not None and self._pictures.fault else []
        return "; ".join(parts)

    def _contact_table(self, frame: int) -> str:
        """What end effectors should touch by the scene, and what they touch."""
        surfaces = [FLOOR, *(box.name for box in self._found.scene.boxes)]
        lines = ["| effector | should touch | touches |", "| --- | --- | --- |"]
        for effector, body in BODIES.items():
            row = self._found.humanoid.skeleton.index(body)
            said = [
                ", ".join(name for name, on in zip(surfaces, flags[frame, row], strict=True) if on) or "-"
                for flags in (self._wanted, self._touching)
            ]
            lines.append(f"| {effector.replace('_', ' ')} | {said[0]} | {said[1]} |")
        return "\n".join(lines)
