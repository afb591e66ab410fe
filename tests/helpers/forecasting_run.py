"""A small forecasting run: its configuration and data."""

from __future__ import annotations

from typing import Any

import torch

from egopose.tasks.dataset import Dataset
from helpers.env_stand_in import PIECES, group
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.toy_problem import COLLECTOR, LOOP, LOOP_IN_ALGO, SETTINGS

CONTEXT, HORIZON = 5, 8


def forecasting_dataset() -> Dataset:
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    features = torch.randn(reference.shape[0], 6, generator=torch.Generator().manual_seed(0))
    return Dataset(humanoid, reference, takes, PIECES, PIECES, visual_features=features)


def configuration(**training: Any) -> dict[str, Any]:
    loop = {**LOOP, "steps_per_iteration": 80, "iterations": 4, "checkpoint_every": 2, **training}
    model = group("model", "forecasting")
    return {
        "seed": 5,
        "task": {**group("task", "forecasting"), "context": CONTEXT, "horizon": HORIZON + 1, "minimum": 4},
        "reward": {**group("reward", "forecasting"), "decay_horizon": HORIZON},
        "regressor": {"std_floor": 0.05},
        "model": {
            **model,
            "hidden": [8],
            "context": {**model["context"], "hidden_size": 4, "horizon": CONTEXT},
            "memory": {"hidden_size": 7},
        },
        "algo": {
            **SETTINGS,
            "minibatch_size": 40,
            **{k: loop.pop(k) for k in LOOP_IN_ALGO},
        },
        "collector": {**COLLECTOR, "num_envs": 4},
        "training": {**loop, "evaluation_num_envs": 2, "evaluation_seed": 1},
    }
