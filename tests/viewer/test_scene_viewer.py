"""The scene's viewer: changes reach the scene and the file, and what cannot be is told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.waiting import wait_until
from helpers.walking import walking

pytest.importorskip("viser", reason="viser is not installed: pip install 'egopose[view]'")

from egopose.inference.scene_stages import save_projection
from egopose.motion.io.native import write_native
from egopose.scene.projection import Projection
from egopose.scene.scene_file import Box, Contact, Scene, read_scene, write_scene
from egopose.viewer.scene_app import SceneViewer, is_scene_folder
from egopose.viewer.session import open_viewer
from egopose.vision.video import write_video

TOKEN = "0123456789abcdef"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    body = walking()
    write_native(body, tmp_path / "body.npz")
    frames = len(body)
    matrix = np.tile(np.array([[20.0, 0, 0], [0, 0, -20.0]]), (frames, 1, 1))
    save_projection(Projection(matrix, np.tile([32.0, 40.0], (frames, 1))), tmp_path / "projection.npz")
    write_video(tmp_path / "film.mp4", np.zeros((frames, 48, 64, 3), np.uint8), 30.0)
    scene = Scene(
        boxes=(Box("step", (0.6, 0.6), (0.5, 0.0), 0.3, 0.0), Box("somewhere", (1.0, 1.0))),
        contacts=(Contact("left_foot", "step", 3, 8),),
    )
    write_scene(scene, tmp_path / "scene.yaml")
    return tmp_path


@pytest.fixture
def viewer(folder: Path) -> Iterator[SceneViewer]:
    assert is_scene_folder(folder)
    shown = open_viewer([str(folder)], folder / "film.mp4", 0.0, "127.0.0.1", 0, TOKEN)
    assert isinstance(shown, SceneViewer)
    yield shown
    shown.close()


def test_a_box_is_changed_and_saved(viewer: SceneViewer, folder: Path) -> None:
    assert viewer._box.value == "step"
    viewer._values["height (m)"].value = 0.45
    viewer._values["yaw (degrees)"].value = 90.0
    viewer.set_box()
    assert viewer.scene.box("step").height == 0.45
    assert viewer.scene.box("step").yaw == pytest.approx(np.pi / 2)
    assert read_scene(folder / "scene.yaml").box("step").height == 0.3
    viewer.save()
    assert read_scene(folder / "scene.yaml") == viewer.scene


def test_what_cannot_be_is_told_and_changes_nothing(viewer: SceneViewer) -> None:
    before = viewer.scene
    viewer._values["length (m)"].value = -1.0
    viewer.set_box()
    assert viewer.scene is before
    assert "size" in viewer._said.content


def test_boxes_and_contacts_come_and_go(viewer: SceneViewer) -> None:
    viewer.add_box()
    assert viewer._box.value == "box1"
    viewer._touches.value, viewer._first.value, viewer._last.value = "box1", 10, 14
    viewer.set_contact()
    assert viewer.scene.contacts[-1] == Contact("right_foot", "box1", 10, 14)
    viewer._box.value = "box1"
    viewer.remove_box()
    assert [box.name for box in viewer.scene.boxes] == ["step", "somewhere"]
    assert viewer.scene.contacts[-1].touches == "floor"
    viewer._row.value = viewer._row.options[0]
    viewer.remove_contact()
    assert [contact.effector for contact in viewer.scene.contacts] == ["right_foot"]


def test_boxes_are_drawn_over_the_film(viewer: SceneViewer) -> None:
    wait_until(lambda: np.asarray(viewer._video.image).any(), "a picture with a box in it")
