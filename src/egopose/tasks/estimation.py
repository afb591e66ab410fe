"""Ego-pose estimation (Yuan & Kitani 2019, section 3.1): the motion of the wearer while the video goes on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl.envs.transforms import Transform

from egopose.core.errors import InputError
from egopose.envs.problem import Problem
from egopose.envs.transforms import TrackingError
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import ImitationTask, training_deviation


class Estimation(ImitationTask):
    """Episodes are pieces of takes; the policy sees the whole video, or some frames ahead."""

    name, protocol = "estimation", "estimates"

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """Those of imitation. If the model reads the tracking error, it comes before them."""
        transforms = super().transforms(config, dataset, problem)
        if "tracking_error" not in config["model"]["inputs"]:
            return transforms
        if dataset.states is None:
            raise InputError("configuration", "model.inputs", "tracking_error needs a trained state regressor")
        if "tracking_error_clip" not in config["task"]:
            raise InputError("configuration", "task.tracking_error_clip", "is missing")
        scale = training_deviation(dataset.states, dataset, float(config["regressor"]["std_floor"]))
        clip = float(config["task"]["tracking_error_clip"])
        return [TrackingError(dataset.states, dataset.takes.following(), scale, clip), *transforms]


TASK = Estimation()
