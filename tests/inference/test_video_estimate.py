"""A video alone, through flow, regressor and policy, to files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers.video_run import FRAMES, run, settings

from egopose.core.errors import InputError
from egopose.inference.video import estimate_video
from egopose.motion.io import read_motion
from egopose.vision.video import probe_video, write_video

__all__ = ["run"]  # a fixture


def moving_picture(frames: int) -> list[np.ndarray]:
    texture = np.random.default_rng(0).integers(0, 255, (80, 200, 3)).astype(np.uint8)
    return [texture[:, 2 * t : 2 * t + 96] for t in range(frames)]


def test_a_video_becomes_a_motion_of_its_length(run: Path, tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    write_video(video, moving_picture(FRAMES), 30.0)
    try:
        out = estimate_video(settings(video, run))
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert out == tmp_path / "walk_estimate"
    motion = read_motion(out / "estimate.npz")
    assert len(motion) == FRAMES
    assert motion.fps == pytest.approx(30.0)
    np.testing.assert_allclose(motion.qpos[0, :2], 0, atol=1e-9)
    assert len(read_motion(out / "estimate.bvh")) == FRAMES
    with (out / "frames.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == FRAMES
    assert set(rows[0]) == {"frame", "value", "confidence", "triggered", "reset", "fallen"}
    shown = probe_video(out / "side_by_side.mp4")
    assert (shown.width, shown.height, shown.frames) == (3 * 64, 64, FRAMES)


def test_what_cannot_be_used_is_named(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        estimate_video(settings(tmp_path / "none.mp4", run))
    with pytest.raises(InputError, match="does not exist"):
        estimate_video(settings(tmp_path / "none.mp4", tmp_path / "no_run"))
    (tmp_path / "broken.mp4").write_bytes(b"\0" * 1000)
    with pytest.raises(InputError, match=r"broken\.mp4"):
        estimate_video(settings(tmp_path / "broken.mp4", run))
    still = tmp_path / "still.mp4"
    write_video(still, moving_picture(1), 30.0)
    with pytest.raises(InputError, match="at least 2"):
        estimate_video(settings(still, run))
