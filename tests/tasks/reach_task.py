"""A third task in one file: a body that must keep its hand at a point above a box, seen by nobody's camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.envs.transforms import Transform

from egopose.data.fragments import FragmentLike
from egopose.envs.imitation import ActionSettings, ImitationProblem, TerminationSettings
from egopose.envs.mdp.observations import BodyState, BodyView
from egopose.envs.mdp.rewards import build_reward, reward_term
from egopose.envs.mdp.step_view import StepView
from egopose.envs.problem import Problem, Scene
from egopose.envs.starts import Starts, UniformStarts, WholeFragments
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.boxes import with_boxes
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import Sources

HAND, ABOVE = "RightHand", 0.3


@reward_term(reads=(), needs=("scene",))
def hand_at_point(view: StepView, *, scale: float, hand: int) -> Tensor:
    """exp(-scale |hand - point|^2) ``[N]``; the point is above the first box."""
    return torch.exp(-scale * (view.body.xpos[:, hand] - point_of(view)).square().sum(-1))


def point_of(view: StepView) -> Tensor:
    assert view.scene is not None
    return view.scene[:, 0, :3] + torch.tensor([0.0, 0.0, ABOVE], dtype=torch.float64)


class ReachProblem(ImitationProblem):
    """Begins where reference motion does; the hand's distance is observed, rewarded, and ends an episode."""

    def __init__(self, dataset: Dataset, config: Mapping[str, Any], endings_end: bool | None) -> None:
        task = config["task"]
        humanoid = with_boxes(dataset.humanoid, [task["box"]])
        self.hand, self.far = humanoid.skeleton.index(HAND), float(task["termination"]["distance"])
        terms = {name: {**row} for name, row in config["reward"]["terms"].items() if row is not None}
        terms["hand_at_point"]["hand"] = self.hand
        super().__init__(
            humanoid,
            dataset.reference,
            dataset.takes,
            build_reward({**config["reward"], "terms": terms}),
            ActionSettings(**task["action"]),
            TerminationSettings(enabled=task["termination"]["enabled"] if endings_end is None else endings_end),
        )
        self.observation_sizes = {**self.observation_sizes, "hand_height": 1}
        self.endings = (*self.endings, "hand_away")
        self.ends_episode = frozenset(self.endings) if self.termination.enabled else frozenset()

    def observations(self, state: BodyState | BodyView, frame: Tensor) -> dict[str, Tensor]:
        return {**super().observations(state, frame), "hand_height": self.view(state).xpos[:, self.hand, 2:3]}

    def ended(self, view: StepView, take: Tensor) -> dict[str, Tensor]:
        away = (view.body.xpos[:, self.hand] - point_of(view)).norm(dim=-1) > self.far
        return {**super().ended(view, take), "hand_away": away}

    def boxes(self, frame: Tensor, generator: torch.Generator) -> Scene:
        """In front of where the body begins, at a height drawn for each episode."""
        root = self.first_state(frame)[0]
        top = root[:, None, :3] + torch.tensor([0.6, -0.2, 0.0], dtype=torch.float64)
        top[..., 2] = 0.3 + 0.3 * torch.rand(len(frame), 1, generator=generator, dtype=torch.float64)
        return Scene(top, torch.zeros(len(frame), 1, dtype=torch.float64), torch.ones(len(frame), 1, dtype=torch.bool))


class Reach:
    name, protocol = "reach", "survival"

    def context(self, config: Mapping[str, Any]) -> int | None:
        return None

    def check(self, config: Mapping[str, Any]) -> None:
        pass

    def dataset(self, config: Mapping[str, Any], sources: Sources) -> Dataset:
        return sources.motions()

    def followed(self, config: Mapping[str, Any], dataset: Dataset) -> Dataset:
        return dataset

    def problem(self, config: Mapping[str, Any], dataset: Dataset, endings_end: bool | None) -> ReachProblem:
        return ReachProblem(dataset, config, endings_end)

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        return [StateNormalizer(problem.observation_sizes["humanoid_state"])]

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        takes, task = problem.takes, config["task"]
        if whole_fragments:
            return WholeFragments(fragments, takes.offsets, takes.lengths)
        return UniformStarts(fragments, takes.offsets, takes.lengths, task["horizon"], task["minimum"])


TASK = Reach()
