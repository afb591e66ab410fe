"""The problem of a tracker on the stand-in body, and its window."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from egopose.envs.imitation import ActionSettings
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.mdp.path import root_on_floor
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.target_window import TargetWindow
from egopose.envs.tracking import TrackingEndings, TrackingProblem
from egopose.motion.motion import finite_difference
from helpers.env_stand_in import group
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in


def tracking_problem(
    error: float = 0.0, humanoid: StandIn | None = None, reference: TensorDict | None = None, **endings: Any
) -> TrackingProblem:
    """Two takes of the stand-in's motion, followed with an error of this size (rad and m) that stays the same."""
    humanoid = humanoid or stand_in()
    known, takes = reference_motion(humanoid)
    reference = known if reference is None else reference
    rng, states, targets, paths = np.random.default_rng(1), [], [], []
    for offset, length in zip(takes.offsets.tolist(), takes.lengths.tolist(), strict=True):
        qpos = reference["qpos"][offset : offset + length].numpy().copy()
        qpos[:, 7:] += error * rng.normal(size=qpos.shape[1] - 7)
        qpos[:, :2] += error * rng.normal(size=2)
        states.append(humanoid_state_rows(qpos, finite_difference(qpos, 30.0)))
        targets.append(qpos[:, 7:])
        paths.append(root_on_floor(torch.from_numpy(qpos)))
    limits = {"enabled": True, "head_below": 0.25, "strays": 1.0} | endings

    def table(rows: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(rows)).float()

    return TrackingProblem(
        humanoid,  # type: ignore[arg-type]
        reference,
        takes,
        build_reward(group("reward", "tracking")),
        ActionSettings(**group("task", "tracking")["action"]),
        TrackingEndings(**limits),
        table(targets),
        table(states),
        torch.cat(paths),
    )


def window_of(problem: TrackingProblem, ahead: tuple[int, ...]) -> TargetWindow:
    """What a policy sees of it."""
    assert problem.motion_seen is not None
    return TargetWindow(problem.motion_seen, ahead)
