"""A film read in another process: the same rows, what goes wrong with it, and drawings that nobody finishes."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers.video_run import run, settings

from egopose.core.errors import InputError
from egopose.inference.film_process import Drawing, FilmProcess, FilmSettings, foreseen_film
from egopose.vision.features import extract_flow
from egopose.vision.film import small_picture
from egopose.vision.flow import FlowConfig
from egopose.vision.gl import choose_backend
from egopose.vision.lens import Camera
from egopose.vision.video import iter_frames, probe_video, read_frames, write_video

__all__ = ["run"]  # a fixture

FLOW = FlowConfig("ultrafast", 32, 8, 1)
CAMERA = Camera(readout=0.01)
FRAMES = 21
XML = """<mujoco><worldbody><geom type="plane" size="5 5 1" rgba=".2 .2 .8 1"/><light pos="0 0 4"/>
<body name="Hips" pos="0 0 1"><freejoint/><geom size=".3" rgba="1 0 0 1"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "pan.mp4"
    texture = np.random.default_rng(0).integers(0, 255, (80, 200, 3)).astype(np.uint8)
    write_video(path, [texture[:, 2 * t : 2 * t + 96] for t in range(FRAMES)], 30.0)
    return path


def wanted(video: Path, **changed: Any) -> FilmSettings:
    values = {"fps": 30.0, "offset": 0.1, "camera": CAMERA, "pictures": True, "panel": 64}
    return FilmSettings(video, FLOW, **{**values, **changed})


def test_rows_are_those_of_one_process_and_all_are_told(film: Path) -> None:
    told: list[int] = []
    with FilmProcess(wanted(film)) as process:
        rows = process.rows(told.append)
    flow = extract_flow(film, FLOW, 30.0, 0.1, camera=CAMERA)
    np.testing.assert_array_equal(np.stack([row[0] for row in rows]), flow)
    pictures = [small_picture(frame) for frame in iter_frames(film, 30.0, 0.1 - 0.005)]
    np.testing.assert_array_equal(np.stack([row[1] for row in rows]), np.stack(pictures))  # type: ignore[arg-type]
    assert sum(told) == len(rows) == FRAMES - 3


def test_a_film_that_cannot_be_read_is_told_as_ever(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"\0" * 1000)
    with FilmProcess(wanted(broken)) as process, pytest.raises(InputError, match=r"broken\.mp4"):
        process.rows()


def test_a_process_that_is_killed_does_not_leave_the_caller_waiting(film: Path) -> None:
    with FilmProcess(wanted(film)) as process:
        os.kill(process._process.pid, signal.SIGKILL)  # type: ignore[arg-type]
        with pytest.raises(RuntimeError, match=r"pan\.mp4 ended"):
            process.rows()


def test_a_drawing_shows_the_film_beside_the_bodies_or_leaves_nothing(film: Path, tmp_path: Path) -> None:
    try:
        choose_backend()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    model = mujoco.MjModel.from_xml_string(XML)
    pose = np.array([0, 0, 0.9, 1, 0, 0, 0.0])
    known = {"PoseReg": np.tile(pose, (FRAMES, 1))}
    told: list[int] = []
    with FilmProcess(wanted(film, offset=0.0)) as process:
        for _ in process.rows():
            pass
        process.draw(Drawing(tmp_path / "whole.mp4", model, "estimate", known, "seen"))
        for _ in range(FRAMES):
            process.add(pose)
        process.finish(told.append)
    shown = probe_video(tmp_path / "whole.mp4")
    assert (shown.width, shown.height, shown.frames) == (3 * 64, 64, FRAMES)
    assert sum(told) == 16  # the rest comes with the end
    last = [frame for _, frame in read_frames(tmp_path / "whole.mp4")][-1].astype(int)
    source = [frame for _, frame in read_frames(film)][-1].astype(int)
    below = last[32:, 128:].mean((0, 1))  # under the label
    np.testing.assert_allclose(below, source[40:, 8:88].mean((0, 1)), atol=6)

    with FilmProcess(wanted(film, offset=0.0)) as process:
        process.rows()
        process.draw(Drawing(tmp_path / "half.mp4", model, "estimate", known, "seen"))
        for _ in range(FRAMES - 1):
            process.add(pose)
    assert not process._process.is_alive()
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mp4"]


def test_a_film_is_foreseen_as_the_checkpoint_will_have_it(run: Path, film: Path, tmp_path: Path) -> None:
    values = settings(film, run)
    foreseen = foreseen_film(values)
    assert foreseen is not None
    with foreseen:
        assert foreseen.settings.video == film
        assert not foreseen.settings.pictures
        assert (foreseen.settings.fps, foreseen.settings.panel) == (30.0, 64)
        assert foreseen.settings.flow == FlowConfig("medium", 128, 32, 2)
    assert foreseen_film(settings(film, tmp_path)) is None
    assert foreseen_film(settings(tmp_path / "none.mp4", run)) is None
    assert foreseen_film({**values, "camera": {"field_of_view": 500}}) is None
