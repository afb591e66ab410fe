"""The common part of tasks whose bodies imitate reference motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torchrl.envs.transforms import Transform

from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs.imitation import ActionSettings, ImitationProblem, TerminationSettings
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.problem import Problem
from egopose.envs.start_shares import StartShares
from egopose.envs.starts import Starts, WholeFragments, training_starts
from egopose.envs.target_window import TargetWindow
from egopose.envs.transforms import StateNormalizer, VisualContext
from egopose.tasks.dataset import Dataset, smoothed
from egopose.tasks.task import Sources

#: The observation of what lies ahead in the target motion, see :mod:`egopose.envs.target_window`.
WINDOW = "target_window"


class ImitationTask:
    """Bodies imitate the reference motion of takes, seen through the state regressor. Tasks build on it."""

    name: str
    protocol: str

    def context(self, config: Mapping[str, Any]) -> int | None:
        """See :class:`~egopose.tasks.task.Task`."""
        return None

    def check(self, config: Mapping[str, Any]) -> None:
        """See :class:`~egopose.tasks.task.Task`."""

    def dataset(self, config: Mapping[str, Any], sources: Sources) -> Dataset:
        """See :class:`~egopose.tasks.task.Task`."""
        return sources.seen_motions()

    def followed(self, config: Mapping[str, Any], dataset: Dataset) -> Dataset:
        """What the regressor saw, smoothed as ``task.action`` says."""
        return smoothed(dataset, float(config["task"]["action"].get("smoothing", 0.0)))

    def problem(self, config: Mapping[str, Any], dataset: Dataset, endings_end: bool | None) -> ImitationProblem:
        """See :class:`~egopose.tasks.task.Task`.

        Raises:
            ValueError: the dataset lacks what the configuration asks for.
        """
        task = config["task"]
        termination = {**task["termination"], **({} if endings_end is None else {"enabled": endings_end})}
        return ImitationProblem(
            dataset.humanoid,
            dataset.reference,
            dataset.takes,
            build_reward(config["reward"]),
            ActionSettings(**task["action"]),
            TerminationSettings(**termination),
            dataset.joint_targets,
            dataset.forecasts,
            dataset.states,
            dataset.path,
            WINDOW in config["model"]["inputs"],
        )

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """The visual context, if it is the regressor's, the target motion's window, if it is read, and the state's
        normaliser."""
        transforms: list[Transform] = [StateNormalizer(problem.observation_sizes["humanoid_state"])]
        if WINDOW in config["model"]["inputs"]:
            transforms.insert(0, target_window_of(config, problem))
        if config["model"]["context"]["source"] == "frozen":
            if dataset.visual_context is None:
                raise InputError("configuration", "model.context.source", "frozen needs a trained state regressor")
            transforms.insert(0, VisualContext(dataset.visual_context))
        return transforms

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        """See :class:`~egopose.tasks.task.Task`; in training as ``task.starts`` and ``data.shares`` say."""
        task, takes = config["task"], problem.takes
        if whole_fragments:
            return WholeFragments(fragments, takes.offsets, takes.lengths)
        horizon, minimum = task["horizon"], task["minimum"]
        limits = config.get("data", {}).get("shares")
        shares = StartShares(takes.groups, limits) if limits else None
        return training_starts(task.get("starts"), fragments, takes.offsets, takes.lengths, horizon, minimum, shares)


def training_deviation(states: torch.Tensor, dataset: Dataset, floor: float) -> torch.Tensor:
    """``[S]``: deviation of states ``[F, S]`` on the training frames, floored for still numbers."""
    offsets = dataset.takes.offsets
    rows = [states[int(offsets[f.take]) + f.start : int(offsets[f.take]) + f.stop] for f in dataset.train]
    return torch.cat(rows).std(dim=0).clamp_min(floor)


def target_window_of(config: Mapping[str, Any], problem: Problem) -> TargetWindow:
    """The window of what bodies follow, ``task.ahead``.

    Raises:
        InputError: there is nothing to follow, or the setting is missing or wrong.
    """
    if problem.motion_seen is None:
        raise InputError("configuration", "model.inputs", f"{WINDOW} needs states to follow and their path")
    ahead = tuple(int(frames) for frames in config["task"].get("ahead", ()))
    if not ahead or min(ahead) < 1:
        raise InputError("configuration", "task.ahead", f"{WINDOW} needs frames ahead of the body, not {ahead}")
    return TargetWindow(problem.motion_seen, ahead)
