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
from egopose.envs.reference_forecasts import ForecastTargets, ReferenceForecasts, TrackForecast
from egopose.envs.starts import Starts, after_context
from egopose.envs.transforms import StateNormalizer
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import WINDOW, ImitationTask, target_window_of, training_deviation

#: What the actions of a policy that follows a forecast are added to, see :class:`ForecastTargets`.
TARGETS = "followed_targets"


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
            _check_followed(task, model)
            return
        if task["action"]["reference"] == "regressor":
            raise InputError("configuration", "task.action.reference", "regressor knows the frames to be forecast")
        for key in ("tracking_error", WINDOW):
            if key in model["inputs"]:
                raise InputError("configuration", "model.inputs", f"{key} knows the frames to be forecast")
        context = model["context"]
        if context["source"] != "past" or int(context["horizon"]) > self.context(config):
            cause = f"a forecast sees the past {task['context']} frames only: model=forecasting"
            raise InputError("configuration", "model.context", cause)

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """What the policy sees of a kinematic forecast, if there is one, the state's normaliser and the time left."""
        time_left = TimeLeft(int(config["task"]["horizon"]) - 1)
        if dataset.forecasts is None:
            return [*super().transforms(config, dataset, problem), time_left]
        model, shown = config["model"], list[Transform]()
        if model["context"]["source"] == "frozen":
            shown.append(_track_forecast(config, dataset, dataset.forecasts))
        if WINDOW in model["inputs"]:
            shown.append(target_window_of(config, problem))
        normalizer = StateNormalizer(problem.observation_sizes["humanoid_state"])
        # The targets come last: so runs from before they were a transform of their own still load.
        return [*shown, normalizer, time_left, _forecast_targets(config, dataset, dataset.forecasts)]

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        """As of imitation, from the last frame of each context on."""
        minimum = 2 if whole_fragments else config["task"]["minimum"]
        pieces = after_context(fragments, self.context(config), minimum)
        return super().starts(config, problem, pieces, whole_fragments)


def _check_followed(task: Mapping[str, Any], model: Mapping[str, Any]) -> None:
    """Raises InputError: a policy with these settings cannot follow a kinematic forecast."""
    source, windowed = model["context"]["source"], WINDOW in model["inputs"]
    if task["action"]["reference"] != "rest" or source not in ("frozen", "none") or (source == "none") != windowed:
        cause = "a forecaster is for experiment=forecasting_follow or tracked_forecasting: their task and their model"
        raise InputError("configuration", "forecaster", cause)
    if model.get("base") != TARGETS:
        cause = f"a policy that follows a forecast adds its actions to {TARGETS}, not to {model.get('base')}"
        raise InputError("configuration", "model.base", cause)
    if not isinstance(task.get("follow"), Mapping):
        cause = "is missing: a forecaster is for task=forecasting_follow or tracked_forecasting"
        raise InputError("configuration", "task.follow", cause)


def _track_forecast(config: Mapping[str, Any], dataset: Dataset, forecasts: ReferenceForecasts) -> TrackForecast:
    """The policy's observations of the forecasts it follows, as ``task.follow`` says."""
    follow, floor = config["task"]["follow"], float(config["forecaster"]["std_floor"])
    for name in ("error_clip", "ahead"):
        if name not in follow:
            raise InputError("configuration", f"task.follow.{name}", "is missing: task=forecasting_follow")
    return TrackForecast(
        forecasts,
        training_deviation(humanoid_state(dataset.reference).float(), dataset, floor),
        float(follow["error_clip"]),
        [int(step) for step in follow["ahead"]],
    )


def _forecast_targets(config: Mapping[str, Any], dataset: Dataset, forecasts: ReferenceForecasts) -> ForecastTargets:
    """What the policy's actions are added to, as ``task.follow`` says."""
    humanoid, share = dataset.humanoid, float(config["task"]["follow"]["velocity_feedforward"])
    lag = torch.as_tensor(humanoid.kd / humanoid.kp) * share
    return ForecastTargets(forecasts, torch.as_tensor(humanoid.rest_action), lag)


TASK = Forecasting()
