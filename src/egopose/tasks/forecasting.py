"""Ego-pose forecasting (Yuan & Kitani 2019, section 3.2): the motion to come after a context of seen frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torchrl.envs.transforms import Transform

from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs.forecasting_transforms import TimeLeft
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import Problem
from egopose.envs.reference_forecasts import TrackForecast
from egopose.envs.starts import Starts, after_context
from egopose.envs.transforms import StateNormalizer
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import ImitationTask, training_deviation


class Forecasting(ImitationTask):
    """An episode begins at the last frame of its context; nothing the policy reads reaches beyond that frame."""

    name, protocol = "forecasting", "forecasts"

    def context(self, config: Mapping[str, Any]) -> int:
        """``task.context``, frames."""
        return int(config["task"]["context"])

    def check(self, config: Mapping[str, Any]) -> None:
        """Raises InputError: the policy would see the future."""
        task, model = config["task"], config["model"]
        if config.get("forecaster") is not None:  # these replace the regressor, and depend on the context alone
            if task["action"]["reference"] != "rest" or model["context"]["source"] != "frozen":
                cause = "a forecaster is for task=forecasting_follow model=forecasting_follow"
                raise InputError("configuration", "forecaster", cause)
            return
        if task["action"]["reference"] == "regressor":
            raise InputError("configuration", "task.action.reference", "regressor knows the frames to be forecast")
        if "tracking_error" in model["inputs"]:
            raise InputError("configuration", "model.inputs", "tracking_error knows the frames to be forecast")
        context = model["context"]
        if context["source"] != "past" or int(context["horizon"]) > self.context(config):
            cause = f"a forecast sees the past {task['context']} frames only: model=forecasting"
            raise InputError("configuration", "model.context", cause)

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """The kinematic forecast, if there is one, the state's normaliser and the time left."""
        time_left = TimeLeft(int(config["task"]["horizon"]) - 1)
        if dataset.forecasts is None:
            return [*super().transforms(config, dataset, problem), time_left]
        normalizer = StateNormalizer(problem.observation_sizes["humanoid_state"])
        return [_track_forecast(config, dataset), normalizer, time_left]

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        """As of imitation, from the last frame of each context on."""
        minimum = 2 if whole_fragments else config["task"]["minimum"]
        pieces = after_context(fragments, self.context(config), minimum)
        return super().starts(config, problem, pieces, whole_fragments)


def _track_forecast(config: Mapping[str, Any], dataset: Dataset) -> TrackForecast:
    """The policy's observations of the forecasts it follows, as ``task.follow`` says."""
    assert dataset.forecasts is not None
    task, humanoid = config["task"], dataset.humanoid
    if not isinstance(task.get("follow"), Mapping):
        raise InputError("configuration", "task.follow", "is missing: a forecaster is for task=forecasting_follow")
    lag = torch.as_tensor(humanoid.kd / humanoid.kp) * float(task["follow"]["velocity_feedforward"])
    floor = float(config["forecaster"]["std_floor"])
    return TrackForecast(
        dataset.forecasts,
        training_deviation(humanoid_state(dataset.reference).float(), dataset, floor),
        torch.as_tensor(humanoid.rest_action),
        lag,
        float(task["follow"]["error_clip"]),
        [int(step) for step in task["follow"]["ahead"]],
    )


TASK = Forecasting()
