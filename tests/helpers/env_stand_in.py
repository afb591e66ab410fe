"""Environments on the stand-in body, for the tests of the environment."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from egopose.envs.build import build_env, build_problem
from egopose.envs.env import EgoPoseEnv
from egopose.envs.problem import ImitationProblem
from helpers.humanoid_stand_in import StandIn, reference_motion, stand_in


class Piece(NamedTuple):
    take: int
    start: int
    stop: int


PIECES = (Piece(0, 0, 40), Piece(1, 5, 25))


@cache
def group(name: str, option: str) -> dict[str, Any]:
    """One config file as the mains see it."""
    with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
        return dict(OmegaConf.to_container(compose(f"{name}/{option}")[name], resolve=True))


def problem(
    humanoid: StandIn | None = None,
    reward: str = "estimation",
    action_reference: torch.Tensor | None = None,
    **task: Any,
) -> ImitationProblem:
    humanoid = humanoid or stand_in()
    reference, takes = reference_motion(humanoid)
    settings = group("task", "residual" if action_reference is not None else "estimation") | task
    return build_problem(
        humanoid,
        reference,
        takes,
        settings,
        group("reward", reward),
        action_reference=action_reference,
    )


def environment(n: int, *, horizon: int = 15, minimum: int = 8, **kwargs: Any) -> EgoPoseEnv:
    given = kwargs.pop("problem", None) or problem()
    task = {"horizon": horizon, "minimum": minimum}
    return build_env(given, kwargs.pop("fragments", PIECES), n, task, **kwargs)
