"""An untrained run in memory and a moving picture, for the tests of live estimation."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from egopose.benchmarks.stream import untrained_on
from egopose.data.preparation import humanoid_of
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.stream.build import Trained
from egopose.vision.video import write_video
from helpers.env_stand_in import group


@cache
def run_config(model: str, task: str, cross_fit: int = 1, smoothing: float = 0.0) -> dict[str, Any]:
    settings = group("task", task)
    return {
        "task": {**settings, "action": {**settings["action"], "smoothing": smoothing}},
        "reward": group("reward", "estimation"),
        "humanoid": group("humanoid", "default"),
        "sim": group("sim", "fast"),
        "vision": group("vision", "light"),
        "regressor": {**group("regressor", "fast"), "cross_fit": cross_fit},
        "model": group("model", model),
        "algo": {"gamma": 0.95},
    }


def untrained(model: str = "fast", task: str = "residual", cross_fit: int = 1, smoothing: float = 0.0) -> Trained:
    config = run_config(model, task, cross_fit, smoothing)
    torch.manual_seed(0)
    humanoid = humanoid_of(config)
    # Around standing, with so much spread that what is seen makes a difference.
    states = 0.3 * torch.randn(300, StateLayout(humanoid.mj_model.nu).size)
    states[:, 0], states[:, 1] = 0.95, 1.0
    return untrained_on(config, humanoid, states)


def write_walk(path: Path, frames: int, fps: float = 30.0) -> Path:
    """A textured plane that passes by at a wavering speed."""
    texture = np.random.default_rng(0).integers(0, 255, (120, 400, 3)).astype(np.uint8)
    shifts = np.cumsum(2 + 2 * np.sin(np.arange(frames) / 4)).astype(int) % 250
    write_video(path, [texture[:, at : at + 128] for at in shifts], fps)
    return path
