"""A small run of tracking on the stand-in body: its configuration and data."""

from __future__ import annotations

from typing import Any

import torch

from egopose.envs.starts import Piece
from egopose.tasks.dataset import Dataset
from egopose.tasks.tracking import TASK
from helpers.env_stand_in import group
from helpers.humanoid_stand_in import reference_motion, stand_in
from helpers.toy_problem import COLLECTOR, LOOP, LOOP_IN_ALGO, SETTINGS

ALSO = (Piece(0, 0, 30),)
TRAIN, TEST = (Piece(0, 0, 40), Piece(1, 0, 12)), (Piece(1, 12, 25),)


class StandInSources:
    """Two takes of the stand-in's motion, and one more as a set of its own."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def motions(self) -> Dataset:
        humanoid: Any = stand_in()
        reference, takes = reference_motion(humanoid)
        return Dataset(humanoid, reference, takes, TRAIN, TEST)

    def other_motions(self, name: str, folder: str, subjects: Any) -> Dataset:
        self.asked.append((name, folder, subjects))
        humanoid: Any = stand_in()
        reference, takes = reference_motion(humanoid, (30,))
        reference["qpos"][:, 0] += 100.0
        return Dataset(humanoid, reference, takes, ALSO, ())


def configuration(folder: str | None = None, **training: Any) -> dict[str, Any]:
    loop = {**LOOP, "steps_per_iteration": 48, "iterations": 4, "checkpoint_every": 2, **training}
    own = {key: loop.pop(key) for key in LOOP_IN_ALGO}
    model, task = group("model", "tracking"), group("task", "tracking")
    return {
        "seed": 5,
        "task": {**task, "horizon": 12, "minimum": 6, "also": {"cmu6": {**task["also"]["cmu6"], "folder": folder}}},
        "reward": group("reward", "tracking"),
        "regressor": {"std_floor": 0.05},
        "model": {**model, "hidden": [8], "critic": {**model["critic"], "hidden": [8]}},
        "algo": {**SETTINGS, "minibatch_size": 16, **own},
        "collector": {**COLLECTOR, "num_envs": 4},
        "training": {"start_from": None, **loop, "evaluation_num_envs": 2, "evaluation_seed": 1},
    }


def tracking_dataset(config: dict[str, Any] | None = None, sources: Any = None) -> Dataset:
    return TASK.dataset(config or configuration(), sources or StandInSources())


def weights_of(run: Any) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in run.ppo.actor.state_dict().items()}
