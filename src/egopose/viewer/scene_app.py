"""The scene of a film, seen over it and changed: boxes, contacts, and a button that writes the YAML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.inference.scene_stages import film_of, load_projection
from egopose.motion.io.native import read_native
from egopose.scene.drawing import body_points, draw_bones, draw_box
from egopose.scene.edits import add_box, remove_box, remove_contact, with_box, with_contact
from egopose.scene.projection import Projection
from egopose.scene.scene_file import EFFECTORS, FLOOR, Box, Contact, read_scene, write_scene
from egopose.viewer.auth_proxy import Address
from egopose.viewer.clip import Footage
from egopose.viewer.figure import Figure
from egopose.viewer.serving import furnish
from egopose.viewer.timeline import TimelineViewer
from egopose.viewer.video_panel import Pictures
from egopose.vision.video import probe_video

_BODY, _BOX, _CHOSEN = (70, 110, 220), (200, 160, 90), (240, 170, 40)
_NONE = "none"
_VALUES = ("x (m)", "y (m)", "height (m)", "length (m)", "width (m)", "yaw (degrees)")


class SceneViewer(TimelineViewer):
    """Serves until :meth:`close`; what was not saved then is lost.

    Args:
        folder: of the results of `egopose reconstruct prepare`.
        address: where browsers come in.
        video: the film, where it is no longer where it was.

    Attributes:
        scene: as it is now, saved or not.
        url: what to open.

    Raises:
        InputError: no results there, or a damaged file; the address cannot be listened at.
    """

    def __init__(self, folder: Path, address: Address, video: Path | None = None) -> None:
        self._folder = folder
        self.scene = read_scene(folder / "scene.yaml")
        self._body = read_native(folder / "body.npz")
        self._projection = load_projection(folder / "projection.npz")
        self._film = film_of(folder) if video is None else video
        self._width = 1 if self._film is None else probe_video(self._film).width
        points, self._parents = body_points(self._body)
        self._places = self._projection.pixels(points)
        self._boxes: dict[str, Any] = {}
        super().__init__(address)

    def _build(self) -> None:
        gui = self._server.gui
        furnish(self._server)
        if self._film is not None:
            self._pictures = Pictures(Footage(self._film, start=self.scene.begin), self._body.fps, len(self._body))
        self._figure = Figure(self._server.scene, "/world/body", self._body, _BODY, marks=True)
        x, y, z = self._body.qpos[0, :3].tolist()
        self._server.initial_camera.position = (x, y - 5.0, z + 1.0)
        self._server.initial_camera.look_at = (x, y, z - 0.5)
        self._add_timeline()
        self._load_timeline(len(self._body), self._body.fps)
        self._video = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="The film", visible=self._pictures is not None)
        with gui.add_folder("Boxes"):
            self._box: Any = gui.add_dropdown("Box", [_NONE])
            self._values: dict[str, Any] = {name: gui.add_number(name, 0.0, step=0.01) for name in _VALUES}
            self._add, self._remove = gui.add_button("Add a box"), gui.add_button("Remove this box")
        with gui.add_folder("Contacts"):
            self._table = gui.add_markdown("")
            self._row: Any = gui.add_dropdown("Row", ["new"])
            self._effector: Any = gui.add_dropdown("End effector", EFFECTORS)
            self._touches: Any = gui.add_dropdown("Touches", [FLOOR])
            self._first: Any = gui.add_number("First frame", 0, min=0, step=1)
            self._last: Any = gui.add_number("Last frame", 0, min=0, step=1)
            self._set, self._drop = gui.add_button("Set this row"), gui.add_button("Remove this row")
        self._save = gui.add_button("Save", color="green")
        self._said = gui.add_markdown("")

        for handle in self._values.values():
            self._on(handle, self.set_box)
        self._on(self._box, self._show_scene)
        self._on(self._row, self._show_row)
        actions = [(self._add, self.add_box), (self._remove, self.remove_box), (self._save, self.save)]
        actions += [(self._set, self.set_contact), (self._drop, self.remove_contact)]
        for button, action in actions:
            self._on_click(button, action)
        self._show_scene()

    def add_box(self) -> None:
        """A new box below the body."""
        self.scene, name = add_box(self.scene, self._body.qpos[self._player.frame(), :2])
        self._show_scene(name)

    def remove_box(self) -> None:
        """The chosen box goes."""
        if self._box.value != _NONE:
            self.scene = remove_box(self.scene, self._box.value)
            self._show_scene()

    def set_box(self) -> None:
        """The chosen box takes the values in the panel; what cannot be is told."""
        if self._box.value == _NONE:
            return
        x, y, height, length, width, yaw = (float(handle.value) for handle in self._values.values())
        place, size = (x, y), (length, width)
        self._try(
            lambda: with_box(
                self.scene, self._box.value, place=place, size=size, height=height, yaw=float(np.deg2rad(yaw))
            )
        )

    def set_contact(self) -> None:
        """The chosen row takes the values in the panel."""
        rows = [*self._row.options].index(self._row.value)
        self._try(
            lambda: with_contact(
                self.scene,
                rows,
                Contact(self._effector.value, self._touches.value, int(self._first.value), int(self._last.value)),
            )
        )

    def remove_contact(self) -> None:
        """The chosen row goes."""
        row = [*self._row.options].index(self._row.value)
        self._try(lambda: remove_contact(self.scene, row))

    def save(self) -> None:
        """Write the YAML."""
        path = self._folder / "scene.yaml"
        try:
            write_scene(self.scene, path)
        except OSError as error:
            self._said.content = f"not saved: {error}"
            return
        self._said.content = f"saved: {path}"

    def _try(self, change: Callable[[], Any]) -> None:
        try:
            self.scene = change()
        except InputError as error:
            self._said.content = f"{error.field}: {error.cause}"
            return
        self._said.content = "changed, not saved"
        self._show_scene()

    def _show_scene(self, chosen: str | None = None) -> None:
        """The scene in the panel and among the shapes."""
        names = [box.name for box in self.scene.boxes]
        name = chosen or self._box.value
        name = name if name in names else (names[0] if names else _NONE)
        self._box.options, self._box.value = tuple(names) or (_NONE,), name
        if name != _NONE:
            box = self.scene.box(name)
            (x, y), (length, width) = box.place or (0.0, 0.0), box.size
            numbers = (x, y, box.height or 0.0, length, width, float(np.rad2deg(box.yaw or 0.0)))
            for handle, number in zip(self._values.values(), numbers, strict=True):
                handle.value = round(number, 3)
        for shape in self._boxes.values():
            shape.remove()
        self._boxes = {box.name: self._shape(box, box.name == name) for box in self.scene.boxes if box.known}
        rows = [f"{c.first}-{c.last} {c.effector} on {c.touches}" for c in self.scene.contacts]
        kept = self._row.value
        # Rows may read alike; a dropdown's choices may not.
        self._row.options = (*(f"{k}: {row}" for k, row in enumerate(rows)), "new")
        self._row.value = kept if kept in self._row.options else "new"
        self._touches.options = (FLOOR, *names)
        head = "| frames | effector | touches |\n| --- | --- | --- |\n"
        lines = [f"| {c.first} to {c.last} | {c.effector} | {c.touches} |" for c in self.scene.contacts]
        self._table.content = head + "\n".join(lines)

    def _show_row(self) -> None:
        row = [*self._row.options].index(self._row.value)
        if row < len(self.scene.contacts):
            contact = self.scene.contacts[row]
            self._effector.value, self._touches.value = contact.effector, contact.touches
            self._first.value, self._last.value = contact.first, contact.last

    def _shape(self, box: Box, chosen: bool) -> Any:
        assert box.place is not None
        assert box.height is not None
        assert box.yaw is not None
        height = max(box.height, 0.005)
        return self._server.scene.add_box(
            f"/world/boxes/{box.name}",
            _CHOSEN if chosen else _BOX,
            (*box.size, height),
            opacity=0.6,
            wxyz=(float(np.cos(box.yaw / 2)), 0.0, 0.0, float(np.sin(box.yaw / 2))),
            position=(*box.place, height / 2),
        )

    def _draw(self, frame: int, slow: bool) -> None:
        with self._server.atomic():
            self._figure.show(frame)
        self._show_timeline(frame)
        picture = None if self._pictures is None else self._pictures.at(frame)
        if picture is not None:
            scale = picture.shape[1] / self._width
            small = Projection(self._projection.matrix * scale, self._projection.origin * scale)
            for box in self.scene.boxes:
                if box.known:
                    picture = draw_box(picture, box, small, frame)
            self._video.image = draw_bones(picture, self._places[frame] * scale, self._parents)


def is_scene_folder(path: Path) -> bool:
    """Whether a folder holds results of `egopose reconstruct prepare`."""
    return all((path / name).is_file() for name in ("scene.yaml", "body.npz", "projection.npz"))
