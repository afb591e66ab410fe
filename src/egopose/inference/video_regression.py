"""``python -m egopose.estimate video=x.mp4 checkpoint=RUN_OR_CHECKPOINT [out=DIR]``: motion from a video alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.data.spans import Span
from egopose.data.store import Fragment
from egopose.envs.problem import TakeTable
from egopose.humanoid.model import HumanoidModel
from egopose.inference.causal import CausalRegression
from egopose.models.pose_regression import pose_regression
from egopose.models.predictions import predict_span
from egopose.models.regressor import StateRegressor
from egopose.motion.motion import Motion
from egopose.pipeline.regressor import joint_targets
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import task_of
from egopose.vision.features import encode


def causal_regression(
    humanoid: HumanoidModel,
    regressor: StateRegressor,
    source_config: Mapping[str, Any],
    task: Mapping[str, Any],
    lookahead: int,
    tells_later: bool = False,
) -> CausalRegression:
    """The regressor that sees ``lookahead`` frames ahead and no more, for a policy of the group ``task``.

    Args:
        humanoid: the run's.
        regressor: trained, in eval mode.
        source_config: the groups ``vision`` and ``regressor`` it was trained with.
        task: the run's.
        lookahead: frames.
        tells_later: see :class:`CausalRegression`.
    """
    smoothing = float(task["action"].get("smoothing", 0.0)) / humanoid.control_dt
    joint_range = torch.as_tensor(humanoid.joint_range)
    return CausalRegression(regressor, joint_range, lookahead, crossed(source_config), smoothing, tells_later)


def crossed(source_config: Mapping[str, Any]) -> bool:
    """A policy trained on the tables of several fits reads the regressor's states for a context."""
    return int(source_config["regressor"]["cross_fit"]) > 1


def seen_in(
    humanoid: HumanoidModel, regressor: StateRegressor, flow: np.ndarray, source_config: Mapping[str, Any]
) -> dict[str, Tensor]:
    """The regressor's output for a whole video.

    Args:
        humanoid: the run's.
        regressor: trained, in eval mode.
        flow: ``[T, 2, S, S]`` of the video at the control rate, with a third plane if the regressor reads body parts.
        source_config: the groups ``vision`` and ``regressor`` it was trained with.

    Returns:
        ``visual_features [T, D]``, ``visual_context [T, C]`` as a policy reads it, ``humanoid_state [T, S]``,
        ``joint_targets [T, nu]`` rad.
    """
    batch = int(source_config["vision"]["encode_batch"])
    seen = predict_span(regressor, torch.from_numpy(flow), Span(0, len(flow)), batch)
    states = seen["humanoid_state"]
    return {
        "visual_features": seen["visual_features"],
        "visual_context": regressor.normalise(states) if crossed(source_config) else seen["visual_context"],
        "humanoid_state": states,
        "joint_targets": joint_targets(states, humanoid),
    }


def seen_live(
    causal: CausalRegression, regressor: StateRegressor, flow: np.ndarray, source_config: Mapping[str, Any]
) -> dict[str, Tensor]:
    """As :func:`seen_in`, but each frame as in the live stream; smoothed if the policy follows smoothed states."""
    encoder, batch = regressor.encoder, int(source_config["vision"]["encode_batch"])
    features = encode(encoder, flow, batch)  # type: ignore[arg-type]  # a regressor of video has a FlowEncoder
    result = [causal.push(frame, row) for frame, row in enumerate(features)]
    rows = [*(row for row in result if row is not None), *causal.drain()]
    keys = ("visual_context", "humanoid_state", "joint_targets")
    return {"visual_features": features, **{key: torch.stack([getattr(row, key) for row in rows]) for key in keys}}


def require_estimation(run: Mapping[str, Any], checkpoint: str | Path) -> None:
    """Raises InputError: the configuration ``run`` of a checkpoint is of a policy that forecasts."""
    if task_of(run).protocol != "estimates":
        raise InputError(checkpoint, "task", "this run forecasts; an estimation policy is needed here")


def video_dataset(
    humanoid: HumanoidModel, seen: Mapping[str, Tensor], name: str, path: Tensor | None = None
) -> tuple[Dataset, Motion]:
    """The dataset of a video: one take, whose reference is the state regressor's own estimate.

    There is no mocap. PoseReg's motion takes its place, from the origin and facing along x. It gives the policy its
    start; no figure is computed from the distance to it.

    Args:
        humanoid: the run's.
        seen: of T frames, see :func:`seen_in`.
        name: of the take.
        path: ``[T, 3]`` x, y (m) and heading (rad) of the root, if something else tells it better than the regressor;
            None for the path of the regressor's own velocities.

    Returns:
        The dataset and PoseReg's motion.

    Raises:
        InputError: fewer than 2 frames.
    """
    frames = len(seen["humanoid_state"])
    if frames < 2:
        raise InputError(name, "video", f"has {frames} frames at 30 frames/s; at least 2 are needed")
    states = seen["humanoid_state"].numpy()
    facing = np.array([1.0, 0.0, 0.0, 0.0])
    motion = pose_regression(
        states, humanoid.skeleton, np.zeros(2), facing, 1.0 / humanoid.control_dt, humanoid.joint_range, name
    )
    reference = reference_states(humanoid, motion)
    lowest = reference["xpos"][:, humanoid.head, 2].min().reshape(1)
    whole = [Fragment(0, 0, frames)]
    dataset = Dataset(
        humanoid,
        reference,
        TakeTable(torch.tensor([0]), torch.tensor([frames]), lowest),
        train=whole,
        test=whole,
        visual_features=seen.get("visual_features"),
        visual_context=seen["visual_context"],
        joint_targets=seen["joint_targets"],
        states=seen["humanoid_state"],
        path=path,
    )
    return dataset, motion


def run_folder(checkpoint: Path) -> Path:
    """The run directory a checkpoint folder ``RUN/checkpoints/NAME`` lies in."""
    return checkpoint.resolve().parents[1]
