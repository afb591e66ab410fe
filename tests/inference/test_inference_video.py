"""A video alone, through flow, regressor and policy, to files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from env_stand_in import group
from toy_problem import COLLECTOR, LOOP, SETTINGS

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.spans import Span
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.video import estimate_video
from egopose.inference.video_regression import seen_in, video_dataset
from egopose.models.regressor_settings import RegressorSettings
from egopose.motion.io import read_motion
from egopose.pipeline.run import build_run
from egopose.training.regressor import build_regressor
from egopose.vision.encoders import build_encoder
from egopose.vision.video import probe_video, write_video

FRAMES = 20


def moving_picture(frames: int) -> list[np.ndarray]:
    texture = np.random.default_rng(0).integers(0, 255, (80, 200, 3)).astype(np.uint8)
    return [texture[:, 2 * t : 2 * t + 96] for t in range(frames)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory with untrained networks and regressor."""
    folder = tmp_path_factory.mktemp("run")
    config: dict[str, Any] = {
        "seed": 0,
        "task": {**group("task", "residual"), "horizon": 12, "minimum": 6},
        "reward": group("reward", "estimation"),
        "humanoid": group("humanoid", "default"),
        "sim": group("sim", "fast"),
        "vision": group("vision", "light"),
        "regressor": group("regressor", "fast"),
        "model": {**group("model", "fast"), "hidden": [8]},
        "collector": {**COLLECTOR, "num_envs": 2},
        "algo": {**SETTINGS, "iterations": 1, "steps_per_iteration": 16},
        "training": {k: v for k, v in LOOP.items() if k not in ("iterations", "steps_per_iteration")},
    }
    torch.manual_seed(0)
    humanoid = build_humanoid(HumanoidConfig.from_mapping(config["humanoid"]), SimConfig(substeps=5))
    standing = torch.zeros(300, StateLayout(humanoid.mj_model.nu).size)
    standing[:, 0], standing[:, 1] = 0.95, 1.0
    encoder = build_encoder(config["vision"]["encoder"])
    trained_as = from_mapping(RegressorSettings, config["regressor"], "conf/regressor")
    regressor = build_regressor(encoder, standing, [Span(0, len(standing))], trained_as, encoder.features)
    size = standing.shape[1]
    weights = {"regressor": regressor, "config": {"state_size": size, **config}}
    RunCheckpoint(weights).save(folder / "regressor", metadata=metadata_of("regressor", size, 1, 0, 0.0))
    flow = np.zeros((FRAMES, 2, 32, 32), np.float16)
    seen = seen_in(humanoid, regressor.eval(), flow, config)
    dataset, _ = video_dataset(humanoid, seen, "nothing")
    made = build_run(config, folder, dataset)
    made.save()
    made.collector.shutdown()
    return folder


def settings(video: Path, checkpoint: Path, **changed: Any) -> dict[str, Any]:
    failsafe = {"mode": "value", "reset_threshold": 0.6, "fallen_height": 0.3}
    values = {"which": "latest", "out": None, "offset": 0.0, "size": 64, "failsafe": failsafe}
    values |= {"causal": False, "lookahead": 10, "camera": {}}
    return {"video": str(video), "checkpoint": str(checkpoint), **values, **changed}


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
