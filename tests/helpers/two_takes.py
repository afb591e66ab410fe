"""Two bodies that follow a take each, whose falls end nothing, with a policy that does nothing: for planners."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv

from egopose.envs.starts import Piece
from egopose.envs.transforms import StateNormalizer
from helpers.env_stand_in import build_problem, environment, group
from helpers.humanoid_stand_in import reference_motion, stand_in

humanoid = cache(stand_in)


@cache
def true_motion(frames: int) -> Any:
    """Both takes, ``frames`` each."""
    return reference_motion(humanoid(), (frames, frames))


def make_env(num_envs: int, frames: int) -> TransformedEnv:
    """Environments on the takes from end to end."""
    reference, takes = true_motion(frames)
    task = group("task", "estimation")
    task = task | {"termination": {"enabled": False, "head_drop": 0.1}}
    problem = build_problem(humanoid(), reference, takes, task, group("reward", "estimation"))
    pieces = (Piece(0, 0, frames), Piece(1, 0, frames))
    base = environment(num_envs, problem=problem, fragments=pieces, whole_fragments=True)
    env = TransformedEnv(base, Compose(StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])))
    env.transform[0].freeze()
    return env


def passive() -> TensorDictModule:
    """A policy without action."""
    size = humanoid().mj_model.nu
    return TensorDictModule(lambda z: torch.zeros(len(z), size), in_keys=["humanoid_state"], out_keys=["action"])


def critic() -> TensorDictModule:
    """A value of the state."""
    return TensorDictModule(lambda z: 2.0 + z[:, :1], in_keys=["humanoid_state"], out_keys=["state_value"])
