"""A small estimation run: its configuration and data."""

from __future__ import annotations

from typing import Any

import torch

from egopose.envs.mdp.observations import humanoid_state
from egopose.tasks.dataset import Dataset
from helpers.env_stand_in import PIECES, group
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.toy_problem import COLLECTOR, LOOP, LOOP_IN_ALGO, SETTINGS


def estimation_dataset() -> Dataset:
    humanoid: Any = stand_in()
    reference, takes = reference_motion(humanoid)
    generator = torch.Generator().manual_seed(0)
    frames = reference.shape[0]
    return Dataset(
        humanoid,
        reference,
        takes,
        PIECES,
        PIECES,
        visual_features=torch.randn(frames, 6, generator=generator),
        visual_context=torch.randn(frames, 5, generator=generator),
        joint_targets=reference["qpos"][:, 7:].float(),
        states=humanoid_state(reference).float(),
    )


#: The stand-in's hinges turn about z, y, x.
FEEDBACK = {"pitch": [["RightFoot_1", "LeftFoot_1"], ["Spine_1"]], "roll": [["RightFoot_2", "LeftFoot_2"]]}


def configuration(context: str = "frozen", **training: Any) -> dict[str, Any]:
    loop = {**LOOP, "steps_per_iteration": 48, "iterations": 4, "checkpoint_every": 2, **training}
    model = group("model", "fast")
    return {
        "seed": 5,
        "task": {**group("task", "residual"), "horizon": 12, "minimum": 6},
        "reward": group("reward", "estimation"),
        "regressor": {"std_floor": 0.05},
        "model": {
            **model,
            "hidden": [8],
            "feedback": {**model["feedback"], **FEEDBACK},
            "context": {**model["context"], "source": context, "hidden_size": 4},
        },
        "algo": {
            **SETTINGS,
            "minibatch_size": 16,
            **{k: loop.pop(k) for k in LOOP_IN_ALGO},
        },
        "collector": {**COLLECTOR, "num_envs": 4},
        "training": {**loop, "evaluation_num_envs": 2, "evaluation_seed": 1},
    }


def assert_equal(first: Any, second: Any, where: str) -> None:
    if isinstance(first, dict):
        assert set(first) == set(second)
        for key in first:
            assert_equal(first[key], second[key], f"{where}.{key}")
    else:
        assert torch.equal(first, second), where
