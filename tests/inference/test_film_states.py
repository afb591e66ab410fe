"""How a video is seen, and a film through its head signal to files."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.mocap import default_humanoid
from helpers.video_run import crossed_run, run, settings

from egopose.core.errors import InputError
from egopose.inference.film_process import foreseen_film, worn_camera
from egopose.inference.film_states import read_states
from egopose.inference.video import estimate_video
from egopose.models.pose_regression import integrated_path
from egopose.motion.io import read_motion
from egopose.vision.head_film import HeadRow, WornCamera
from egopose.vision.lens import Camera
from egopose.vision.video import write_video

__all__ = ["crossed_run", "run"]  # fixtures

FRAMES = 60


def moving_picture(frames: int) -> list[np.ndarray]:
    texture = np.random.default_rng(0).integers(0, 255, (80, 200, 3)).astype(np.uint8)
    return [texture[:, t : t + 96] for t in range(frames)]


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    write_video(path, moving_picture(FRAMES), 30.0)
    return path


def seen_by(video: Path, **changed: Any) -> str:
    return "flow" if worn_camera({**settings(video, video), "sees": "auto", **changed}) is None else "head_signal"


def test_auto_reads_films_by_their_head_signal_and_rendered_videos_by_flow(tmp_path: Path) -> None:
    video, record = tmp_path / "walk.mp4", tmp_path / "walk.json"
    assert seen_by(video) == "head_signal"
    assert seen_by(video, causal=True) == "flow"
    assert seen_by(video, sees="flow") == "flow"
    record.write_text(json.dumps({"rendered": True}))
    assert seen_by(video) == "flow"
    assert seen_by(video, sees="head_signal") == "head_signal"
    for other in ({"rendered": False}, {}, [1, 2]):
        record.write_text(json.dumps(other))
        assert seen_by(video) == "head_signal"
    record.write_text("{broken")
    assert seen_by(video) == "head_signal"


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"sees": "stars"}, r"sees.*auto, flow, head_signal"),
        ({"sees": "head_signal", "causal": True}, r"sees.*causal=false"),
        ({"worn": {"mount": "knee"}}, r"mount.*head, chest, held"),
        ({"worn": {"pitch_down": 95}}, r"pitch_down.*-60 to 90"),
        ({"worn": {"height": 0.1}}, r"height.*0\.3 to 3"),
        ({"worn": {"height": "tall"}}, "height"),
        ({"worn": {"hat": True}}, "hat"),
    ],
)
def test_settings_that_cannot_be_are_named(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        seen_by(tmp_path / "walk.mp4", **changed)


def rows(count: int) -> list[HeadRow]:
    return [HeadRow(k / 30, 1 / 30, np.zeros((2, 14, 24), np.float32), 65.0) for k in range(count)]


def test_a_still_film_is_of_one_who_stands_and_says_what_is_guessed(film: Path) -> None:
    found = read_states(default_humanoid(), rows(45), film, Camera(), WornCamera())
    assert found.states.shape[0] == len(found.signal) == 45
    assert found.states.dtype == torch.float32
    path = integrated_path(found.states.numpy(), 30.0)
    assert np.abs(path[:, :2]).max() < 0.1
    assert np.abs(path[:, 2]).max() < np.deg2rad(5.0)
    (note,) = found.notes
    assert "65 degrees" in note
    assert "camera.field_of_view" in note
    assert found.height == pytest.approx(1.75, abs=0.01)
    known = read_states(default_humanoid(), rows(45), film, Camera(field_of_view=90.0), WornCamera("chest", height=1.2))
    assert (known.notes, known.height) == ((), 1.2)
    with pytest.raises(InputError, match="at least 2"):
        read_states(default_humanoid(), rows(1), film, Camera(), WornCamera())


def test_a_film_becomes_a_motion_and_is_told_whether_it_is_followed(
    crossed_run: Path, film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = settings(film, crossed_run, sees="auto", worn={"pitch_down": 25}, out=str(tmp_path / "out"))
    foreseen = foreseen_film(values)
    assert foreseen is not None
    assert foreseen.settings.worn == WornCamera(pitch_down=25.0)
    try:
        out = estimate_video(values, foreseen)
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert len(read_motion(out / "estimate.npz")) == FRAMES
    with (out / "frames.csv").open() as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == FRAMES
    added = {"follows_film", "film_turning", "film_speed", "film_bob", "film_seen", "film_rigid"}
    assert added < set(table[0])
    assert all(0 <= float(row[name]) <= 1 for row in table for name in added)
    told = capsys.readouterr().out
    mean = np.mean([float(row["follows_film"]) for row in table])
    assert "note: the camera's field of view is not known" in told
    assert "follows the film: " in told
    assert f"({mean:.2f})" in told


def test_a_policy_that_reads_flows_own_context_says_what_helps(run: Path, film: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sees=flow"):
        estimate_video(settings(film, run, sees="head_signal", out=str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()
