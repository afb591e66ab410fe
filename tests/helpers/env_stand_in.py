"""Environments on the stand-in body, for the tests of the environment."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from egopose.envs.env import EgoPoseEnv
from egopose.envs.imitation import ActionSettings, ImitationProblem, TerminationSettings
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.starts import WholeFragments, training_starts
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


def build_problem(
    humanoid: Any, reference: Any, takes: Any, task: dict[str, Any], reward: dict[str, Any], **tables: Any
) -> ImitationProblem:
    """The imitation problem of a file of ``conf/task`` and one of ``conf/reward``."""
    settings = ActionSettings(**task["action"]), TerminationSettings(**task["termination"])
    return ImitationProblem(humanoid, reference, takes, build_reward(reward), *settings, **tables)


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


def environment(
    n: int, *, horizon: int = 15, minimum: int = 8, whole_fragments: bool = False, starts: Any = None, **kwargs: Any
) -> EgoPoseEnv:
    given, fragments = kwargs.pop("problem", None) or problem(), kwargs.pop("fragments", PIECES)
    offsets, lengths = given.takes.offsets, given.takes.lengths
    if whole_fragments:
        dealt: Any = WholeFragments(fragments, offsets, lengths)
    else:
        dealt = training_starts(starts, fragments, offsets, lengths, horizon, minimum)
    return EgoPoseEnv(given, n, dealt, **kwargs)
