"""Waves to be forecast and small settings for it."""

from __future__ import annotations

from typing import Any

import torch

from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import spline_basis
from egopose.tasks.dataset import Dataset
from egopose.training.forecaster_settings import ForecasterSettings
from egopose.training.kernel_forecast import Contexts
from helpers.env_stand_in import group

FPS = 30.0


SMALL: dict[str, Any] = {
    "recurrent": 8, "hidden": 16, "spacing": 3, "context": 5, "horizon": 12, "members": 2, "kernel": None,
    "continued": None,
}  # fmt: skip


def settings(**changes: Any) -> ForecasterSettings:
    values = {key: value for key, value in group("forecaster", "fast").items() if key != "optimiser"}
    return ForecasterSettings.from_config({**values, **SMALL, **changes})


def curves(dataset: Dataset, horizon: int = 12) -> ReferenceForecasts:
    """Curves from every frame of the first take that fit the reference from there on."""
    poses = humanoid_state(dataset.reference).float()
    size = 11 + (poses.shape[1] - 11) // 2
    basis = spline_basis(horizon + 1, 3, FPS)[0]
    last = int(dataset.takes.lengths[0]) - 1
    starts = torch.arange(last)
    futures = poses[(starts[:, None] + torch.arange(horizon + 1)).clamp(max=last), :size]
    return ReferenceForecasts(torch.linalg.pinv(basis) @ futures, starts, len(poses), horizon, 3, FPS)


def contexts_of(states: torch.Tensor, context: int) -> Contexts:
    starts = torch.arange(context - 1, len(states))
    return Contexts.at(states[starts[:, None] + torch.arange(1 - context, 1)], starts, len(states))


def unmirrored(poses: torch.Tensor) -> StateMirror:
    """Of a body that is its own mirror image."""
    return StateMirror(torch.arange(poses.shape[1]), torch.ones(poses.shape[1]))


def wave(frames: int, dofs: int = 4) -> torch.Tensor:
    """Pose states of a body that swings its joints, one period in twelve frames."""
    t = torch.arange(frames)[:, None] * (2 * torch.pi / 12)
    joints = 0.5 * torch.sin(t + torch.arange(dofs))
    return torch.cat([torch.ones(frames, 2), torch.zeros(frames, 3), joints, torch.zeros(frames, 6)], dim=1)


CONFIG: dict[str, Any] = {
    "seed": 0,
    "reward": group("reward", "forecasting"),
    "model": {**group("model", "forecasting_follow"), "hidden": [8], "feedback": None},
    "algo": {},
}


def configuration() -> dict[str, Any]:
    task = {**group("task", "forecasting_follow"), "context": 5, "horizon": 13, "minimum": 4}
    return {**CONFIG, "task": task, "forecaster": {**group("forecaster", "fast"), **SMALL}}
