"""An untrained run that estimates from video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of
from egopose.core.config import from_mapping
from egopose.data.spans import Span
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.video_regression import seen_in, video_dataset
from egopose.models.regressor_settings import RegressorSettings
from egopose.pipeline.run import build_run
from egopose.training.regressor import build_regressor
from egopose.vision.encoders import build_encoder
from helpers.env_stand_in import group
from helpers.toy_problem import COLLECTOR, LOOP, LOOP_IN_ALGO, SETTINGS

FRAMES = 20


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory with untrained networks and regressor."""
    return make_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def crossed_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As :func:`run`, of a policy that reads states for a context."""
    return make_run(tmp_path_factory.mktemp("crossed_run"), cross_fit=2)


def make_run(folder: Path, cross_fit: int = 1) -> Path:
    """Write an untrained run to ``folder``."""
    config: dict[str, Any] = {
        "seed": 0,
        "task": {**group("task", "residual"), "horizon": 12, "minimum": 6},
        "reward": group("reward", "estimation"),
        "humanoid": group("humanoid", "default"),
        "sim": group("sim", "fast"),
        "vision": group("vision", "light"),
        "regressor": {**group("regressor", "fast"), "cross_fit": cross_fit},
        "model": {**group("model", "fast"), "hidden": [8]},
        "collector": {**COLLECTOR, "num_envs": 2},
        "algo": {**SETTINGS, "iterations": 1, "steps_per_iteration": 16},
        "training": {k: v for k, v in LOOP.items() if k not in LOOP_IN_ALGO},
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
    values |= {"causal": False, "lookahead": 10, "camera": {}, "sees": "flow", "worn": {}}
    return {"video": str(video), "checkpoint": str(checkpoint), **values, **changed}
