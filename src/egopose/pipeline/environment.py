"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import TransformedEnv

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs import build as envs
from egopose.envs.aids import Aids
from egopose.envs.forecasting_transforms import RecurrentStates, TimeLeft
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.reference_forecasts import TrackForecast
from egopose.envs.transforms import RawState, StateNormalizer, TrackingError, VisualContext
from egopose.models.recurrent import hidden_keys
from egopose.tasks.dataset import Dataset, smoothed


def build_env(
    config: Mapping[str, Any],
    dataset: Dataset,
    split: str = "train",
    *,
    num_envs: int,
    threads: int = 1,
    seed: int = 0,
    whole_fragments: bool = False,
    falls_end: bool | None = None,
    dump_dir: Path | None = None,
    fragments: Sequence[FragmentLike] | None = None,
    aids: Aids | None = None,
    workers: int = 1,
) -> TransformedEnv:
    """The environment with its transforms, as ``config`` says.

    Args:
        config: resolved.
        dataset: see :class:`Dataset`.
        split: ``train`` or ``test`` fragments.
        num_envs: N.
        threads: of the physics.
        seed: of the starts.
        whole_fragments: each world runs its own fragment from end to end.
        falls_end: whether a fall ends an episode; None for what the task says.
        dump_dir: where diverged worlds leave their last states.
        fragments: in place of those of ``split``.
        aids: only for environments that a run collects in, ``workers`` of them.

    Raises:
        InputError: the configuration asks for a table the dataset lacks, lets a forecast see the future, or the rooms
            refuse it.
    """
    dataset = smoothed(dataset, float(config["task"]["action"].get("smoothing", 0.0)))
    task = dict(config["task"])
    forecasts = task.get("context") is not None
    if forecasts:
        _refuse_future(config)
    if falls_end is not None:
        task["termination"] = {**task["termination"], "enabled": falls_end}
    try:
        problem = envs.build_problem(
            dataset.humanoid,
            dataset.reference,
            dataset.takes,
            task,
            config["reward"],
            action_reference=dataset.joint_targets,
            forecasts=dataset.forecasts,
        )
        base = envs.build_env(
            problem,
            fragments or (dataset.train if split == "train" else dataset.test),
            num_envs,
            task,
            threads=threads,
            seed=seed,
            whole_fragments=whole_fragments,
            dump_dir=dump_dir,
            aids=aids,
            workers=workers,
        )
    except (ValueError, TypeError) as error:
        raise error if isinstance(error, InputError) else InputError("configuration", "task", str(error)) from None
    transforms = [StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])]
    if dataset.forecasts is not None:
        transforms.insert(0, _follow(config, dataset))
    elif config["model"]["context"]["source"] == "frozen":
        if dataset.visual_context is None:
            raise InputError("configuration", "model.context.source", "frozen needs a trained state regressor")
        transforms.insert(0, VisualContext(dataset.visual_context))
    if dataset.forecasts is None and "tracking_error" in config["model"]["inputs"]:
        if dataset.states is None:
            raise InputError("configuration", "model.inputs", "tracking_error needs a trained state regressor")
        if "tracking_error_clip" not in task:
            raise InputError("configuration", "task.tracking_error_clip", "is missing")
        scale = _state_scale(dataset, float(config["regressor"]["std_floor"]))
        clip = float(task["tracking_error_clip"])
        transforms.insert(0, TrackingError(dataset.states, dataset.takes.following(), scale, clip))
    if "discriminator" in config.get("algo", ()):
        transforms.insert(0, RawState())
    if forecasts:
        transforms.append(TimeLeft(int(task["horizon"]) - 1))
    if (memory := config["model"].get("memory")) is not None:
        keys = [key for owner in ("policy", "value") for key in hidden_keys(owner)]
        transforms.append(RecurrentStates(dict.fromkeys(keys, int(memory["hidden_size"]))))
    return TransformedEgoPoseEnv(base, *transforms)


def _follow(config: Mapping[str, Any], dataset: Dataset) -> TrackForecast:
    """What the policy sees of the forecasts it follows, as ``task.follow`` says."""
    assert dataset.forecasts is not None
    task, humanoid = config["task"], dataset.humanoid
    if not isinstance(task.get("follow"), Mapping):
        raise InputError("configuration", "task.follow", "is missing: a forecaster is for task=forecasting_follow")
    lag = torch.as_tensor(humanoid.kd / humanoid.kp) * float(task["follow"]["velocity_feedforward"])
    return TrackForecast(
        dataset.forecasts,
        _scale_of(humanoid_state(dataset.reference).float(), dataset, float(config["forecaster"]["std_floor"])),
        torch.as_tensor(humanoid.rest_action),
        lag,
        float(task["follow"]["error_clip"]),
        [int(step) for step in task["follow"]["ahead"]],
    )


def _refuse_future(config: Mapping[str, Any]) -> None:
    """Raises InputError: a forecasting policy would read what is known only once the future was seen."""
    task, model = config["task"], config["model"]
    if config.get("forecaster") is not None:  # these stand in the regressor's place, and know the context alone
        if task["action"]["reference"] != "rest" or model["context"]["source"] != "frozen":
            cause = "a forecaster is for task=forecasting_follow model=forecasting_follow"
            raise InputError("configuration", "forecaster", cause)
        return
    if task["action"]["reference"] == "regressor":
        raise InputError("configuration", "task.action.reference", "regressor knows the frames to be forecast")
    if "tracking_error" in model["inputs"]:
        raise InputError("configuration", "model.inputs", "tracking_error knows the frames to be forecast")
    context = model["context"]
    if context["source"] != "past" or int(context["horizon"]) > int(task["context"]):
        cause = f"a forecast sees the past {task['context']} frames only: model=forecasting"
        raise InputError("configuration", "model.context", cause)


def _state_scale(dataset: Dataset, floor: float) -> torch.Tensor:
    """``[S]``: deviation of the regressor's states on the training frames, floored for still numbers."""
    assert dataset.states is not None
    return _scale_of(dataset.states, dataset, floor)


def _scale_of(states: torch.Tensor, dataset: Dataset, floor: float) -> torch.Tensor:
    offsets = dataset.takes.offsets
    rows = [states[int(offsets[f.take]) + f.start : int(offsets[f.take]) + f.stop] for f in dataset.train]
    return torch.cat(rows).std(dim=0).clamp_min(floor)
