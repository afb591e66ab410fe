"""The problem of a body that follows kinematic motion from frame to frame, and may not lose it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.imitation import ActionSettings, ImitationProblem, TerminationSettings
from egopose.envs.mdp.observations import BodyState, BodyView
from egopose.envs.mdp.rewards import RewardTable
from egopose.envs.mdp.step_view import StepView
from egopose.envs.problem import TakeTable
from egopose.humanoid.model import HumanoidModel


@dataclass(frozen=True)
class TrackingEndings:
    """When an episode of tracking ends before its time.

    Args:
        enabled: off in evaluation.
        head_below: m that the head may be below the reference's in the same frame.
        strays: m that the root may be away from the reference's, level.
    """

    enabled: bool
    head_below: float
    strays: float


class TrackingProblem(ImitationProblem):
    """Imitation of a reference while following states and a path that differ from it.

    Args:
        humanoid, reference, takes, reward, action: see :class:`ImitationProblem`.
        endings: of episodes.
        joint_targets: ``[F, nu]`` rad, what actions are added to.
        states: ``[F, S]`` humanoid states that are followed.
        path: ``[F, 3]`` of their root.
    """

    def __init__(
        self,
        humanoid: HumanoidModel,
        reference: TensorDictBase,
        takes: TakeTable,
        reward: RewardTable,
        action: ActionSettings,
        endings: TrackingEndings,
        joint_targets: Tensor,
        states: Tensor,
        path: Tensor,
    ) -> None:
        super().__init__(
            humanoid,
            reference,
            takes,
            reward,
            action,
            TerminationSettings(enabled=endings.enabled),
            joint_targets,
            states=states,
            path=path,
            shows_path=True,
        )
        self.endings = ("fallen", "strayed")
        self.ends_episode = frozenset(self.endings) if endings.enabled else frozenset()
        self._limits = endings
        self._heads = torch.as_tensor(reference["xpos"])[:, humanoid.head, 2].double().contiguous()
        self._places = self._qpos[:, :2].contiguous()

    def step_view(self, state: BodyState | BodyView, frame: Tensor, step: Tensor, **parts: Any) -> StepView:
        """See :class:`ImitationProblem`; endings compare with the reference's frame as well."""
        view = super().step_view(state, frame, step, **parts)
        told = {"head_height": self._heads.index_select(0, frame), "root_place": self._places.index_select(0, frame)}
        return replace(view, reference=SimpleNamespace(**vars(view.reference), **told))

    def ended(self, view: StepView, take: Tensor) -> dict[str, Tensor]:
        """``fallen [N]``: the head is far below the reference's. ``strayed [N]``: the root is far from it."""
        head = view.body.xpos[:, self.humanoid.head, 2]
        reference = vars(view.reference)
        away = (view.body.qpos[:, :2] - reference["root_place"]).norm(dim=-1)
        return {
            "fallen": head < reference["head_height"] - self._limits.head_below,
            "strayed": away > self._limits.strays,
        }
