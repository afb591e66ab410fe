"""A reconstruction in the viewer: what is in the scene and the panel, and all of it in a headless Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.jump import jumping, scene_at, write_folder
from helpers.waiting import wait_until
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("viser", reason="viser is not installed: pip install 'egopose[view]'")

from egopose.core.errors import InputError
from egopose.inference.scene_stages import load_projection, save_projection
from egopose.motion import rotations as rot
from egopose.scene.projection import Projection, camera_poses
from egopose.view import command_line
from egopose.viewer.reconstruction_app import ReconstructionViewer
from egopose.viewer.scene_app import SceneViewer
from egopose.viewer.session import open_viewer

TOKEN = "0123456789abcdef"
IN_AIR = 36


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("made") / "leap", jumping(), scene_at(0.3), film=True)


@pytest.fixture
def viewer(folder: Path) -> Iterator[ReconstructionViewer]:
    shown = open_viewer([str(folder)], None, 0.0, "127.0.0.1", 0, TOKEN)
    assert isinstance(shown, ReconstructionViewer)
    yield shown
    shown.close()


def test_bodies_boxes_and_camera_stand_in_the_scene(viewer: ReconstructionViewer) -> None:
    viewer._asked.put(lambda: viewer._scrub(IN_AIR))
    wait_until(lambda: f"frame {IN_AIR} of" in viewer._status.content, "the frame is shown")
    root = jumping().qpos[IN_AIR, :3]
    np.testing.assert_allclose(viewer._world.position, [-root[0], -root[1], 0.0], atol=1e-6)
    solid, other = (figure._mesh.vertices.mean(axis=0) for figure in (viewer._simulated, viewer._kinematic))
    assert other[0] - solid[0] == pytest.approx(0.1 * IN_AIR / 60, abs=1e-4)
    assert [shape.dimensions[2] for shape in viewer._boxes] == pytest.approx([0.3, 0.5])
    assert not any(shape.visible for shape in viewer._guesses)
    # The projection of the clip looks along y, and 40 px are a metre.
    ahead = rot.rotate(np.array(viewer._eye.wxyz), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-6)
    assert viewer._eye.position[1] < -2.0
    assert len(viewer._path.points) == len(jumping()) - 1


def test_contacts_wanted_and_found_are_told(viewer: ReconstructionViewer) -> None:
    assert "| right foot | step | step |" in viewer._contact_table(20)
    assert "| right foot | - | - |" in viewer._contact_table(IN_AIR)


def test_what_is_asked_for_is_hidden_and_shown(viewer: ReconstructionViewer) -> None:
    viewer._layers["boxes of the first guess"].value = True
    viewer._layers["camera"].value = viewer._layers["kinematic body"].value = False
    viewer._follow.value = False
    viewer._asked.put(lambda: viewer._scrub(5))
    wait_until(lambda: not viewer._eye.visible, "the camera is hidden")
    assert not viewer._kinematic._mesh.visible
    assert all(shape.visible for shape in viewer._guesses)
    np.testing.assert_allclose(viewer._world.position, 0.0)


def test_discs_lie_on_the_box(viewer: ReconstructionViewer) -> None:
    viewer._asked.put(lambda: viewer._scrub(20))
    wait_until(lambda: "frame 20 of" in viewer._status.content, "the frame is shown")
    touch = viewer._simulated._touch
    assert touch is not None
    on = touch._discs.batched_scales > 0
    assert on.sum() >= 2
    np.testing.assert_allclose(touch._discs.batched_positions[on, 2], 0.3, atol=0.01)


def test_both_bodies_are_drawn_over_the_film(viewer: ReconstructionViewer) -> None:
    def drawn() -> bool:
        picture = np.asarray(viewer._video.image).astype(int)
        green = (picture[..., 1] > 150) & (picture[..., 0] < 140)
        return picture.shape[0] > 2 and green.sum() > 20

    wait_until(drawn, "the film with the body over it")


def test_the_scene_can_still_be_changed(folder: Path) -> None:
    assert command_line().parse_args([str(folder), "--scene"]).scene
    shown = open_viewer([str(folder)], None, 0.0, "127.0.0.1", 0, TOKEN, scene=True)
    try:
        assert isinstance(shown, SceneViewer)
    finally:
        shown.close()


def test_what_does_not_fit_is_told(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, jumping(), scene_at(0.3))
    with pytest.raises(InputError, match="by itself"):
        open_viewer([str(folder), str(folder)], None, 0.0, "127.0.0.1", 0, TOKEN)
    short = load_projection(folder / "projection.npz")
    save_projection(Projection(short.matrix[1:], short.origin[1:]), folder / "projection.npz")
    with pytest.raises(InputError, match="60 frames; the clip has 61"):
        open_viewer([str(folder)], None, 0.0, "127.0.0.1", 0, TOKEN)


def test_in_a_browser_it_loads_and_scrubs(viewer: ReconstructionViewer, page: Any) -> None:
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(viewer.url)
    page.wait_for_selector("canvas")
    page.wait_for_selector("text=/^frame 0 of 61/")
    frame = page.locator("input.mantine-NumberInput-input").first
    frame.click()
    page.keyboard.press("Control+A")
    page.keyboard.type(str(IN_AIR))
    page.wait_for_selector(f"text=/^frame {IN_AIR} of 61/")
    for text in ("The film", "should touch", "Vertical force of the ground, body weights", "Height of the root, m"):
        page.get_by_text(text, exact=True).first.wait_for()
    assert not faults


@given(
    azimuth=st.floats(-3.0, 3.0),
    pitch=st.floats(-1.0, 1.0),
    distance=st.floats(1.0, 30.0),
    focal=st.floats(200.0, 3000.0),
)
def test_the_camera_is_found_where_it_stood(azimuth: float, pitch: float, distance: float, focal: float) -> None:
    ahead = np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    down = np.cross(ahead, right)
    body = np.array([[0.3, -0.7, 0.9]])
    projection = Projection(focal / distance * np.stack([right, down])[None], np.array([[5.0, 6.0]]))
    places, axes = camera_poses(projection, body, focal)
    np.testing.assert_allclose(places[0], body[0] - distance * ahead, atol=1e-6)
    np.testing.assert_allclose(axes[0], np.stack([right, down, ahead]), atol=1e-9)
