"""The problem of a body that does what a film shows, among boxes, with no root motion to follow.

Yu, Park & Lee 2021, section 5: poses, contacts and an up-hint are known of every frame, and the scene roughly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.imitation import ActionSettings, ImitationProblem, TerminationSettings
from egopose.envs.mdp.clip_hints import ClipHints
from egopose.envs.mdp.link_observations import boxes_from_root, links_in_root_frame, up_in_root_frame
from egopose.envs.mdp.observations import BodyState, BodyView, TouchingPoints
from egopose.envs.mdp.rewards import RewardTable
from egopose.envs.mdp.rotations import yaw
from egopose.envs.mdp.scene_rewards import contact_mismatch
from egopose.envs.mdp.step_view import StepView
from egopose.envs.problem import Scene, TakeTable
from egopose.envs.scene_ranges import SceneRanges, depth_in_scene, moved_with
from egopose.humanoid.link_rates import LinkRates
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics_worker import Placer

#: m: so deep a kinematic foot may be in what it stands on; physics pushes it out gently.
_SUNK = 0.03
ENDINGS = ("centre_of_mass_low", "up_hint_off", "contact_mismatch", "forbidden_contact")


@dataclass(frozen=True)
class ReconstructionEndings:
    """When an episode ends before its time (Yu, Park & Lee 2021, section 5.2); None for never.

    Args:
        enabled: off in evaluation.
        centre_of_mass_low: m that the centre of mass may be lower over the lowest joint than in the clip's pose.
        up_hint_off: rad that the way from pelvis to head may be off the up-hint.
        contact_mismatch: s for which an end effector's contact may be wrong without a break.
        forbidden_contact: s for which anything but feet and hands may touch floor or boxes without a break.
    """

    enabled: bool
    centre_of_mass_low: float | None
    up_hint_off: float | None
    contact_mismatch: float | None
    forbidden_contact: float | None


@dataclass(frozen=True)
class StartStates:
    """Where episodes begin, frame by frame.

    Args:
        qpos, qvel: ``[F, nq]``, ``[F, nv]``.
        support: ``[F]`` int64 the box that carries the body, -1 for the floor.
        change: ``[K, 4]`` of the boxes from their first guess where these states were made.
    """

    qpos: Tensor
    qvel: Tensor
    support: Tensor
    change: Tensor


class ReconstructionProblem(ImitationProblem):
    """A clip's poses, contacts and up-hint are imitated among boxes.

    Args:
        humanoid: with the scene's boxes, and contact sensors on every body.
        reference: ``[F]`` body states of the clip's poses. Of them only joints are rewarded.
        takes: one.
        reward: see :mod:`egopose.envs.mdp.scene_rewards`.
        action: see :class:`ActionSettings`.
        endings: of episodes.
        targets: ``[F, nu]`` rad, what actions are added to for reaching each frame.
        hints: of the clip.
        touching: the end effectors.
        ranges: of the boxes.
        varies: ``[K]`` bool, which boxes are drawn anew for each episode; the others stand as in the first states.
        start: first states.
        sees_scene: whether the policy sees up, its height and where the boxes are, beside what the paper shows it.
    """

    def __init__(
        self,
        humanoid: HumanoidModel,
        reference: TensorDictBase,
        takes: TakeTable,
        reward: RewardTable,
        action: ActionSettings,
        endings: ReconstructionEndings,
        targets: Tensor,
        hints: ClipHints,
        touching: TouchingPoints,
        ranges: SceneRanges,
        varies: Tensor,
        start: StartStates,
        sees_scene: bool,
    ) -> None:
        ends = TerminationSettings(enabled=endings.enabled)
        super().__init__(humanoid, reference, takes, reward, action, ends, targets)
        bodies = len(humanoid.body_ids)
        self.hints, self.ranges, self.start, self.varies = hints, ranges, start, varies
        self.sees_scene, self.touching = sees_scene, touching
        self.layout = replace(self.layout, touching=touching, rates=LinkRates(humanoid.mj_model, humanoid.body_ids))
        self.endings = ENDINGS
        asked = {name for name in ENDINGS if getattr(endings, name) is not None}
        self.ends_episode = frozenset(asked) if endings.enabled else frozenset()
        self._limits = endings
        boxes = len(ranges.headings)
        self.observation_sizes: Mapping[str, int] = {
            "humanoid_state": 1 + 15 * bodies - 9 + (4 + 5 * boxes if sees_scene else 0),
            "scene_parameters": ranges.size,
        }
        self.watched = reward.needs | {"contacts"}
        self.memory_size = len(touching.bodies) + 1
        self._placer = Placer(humanoid.mj_model, humanoid.body_ids)
        self._torque_limit = torch.as_tensor(humanoid.torque_limit, dtype=torch.float64)
        self._others = torch.ones(bodies, dtype=torch.bool)
        self._others[touching.bodies] = False

    def observations(self, state: BodyState | BodyView, frame: Tensor) -> dict[str, Tensor]:
        """``humanoid_state``: the phase, the links in the root's frame and, if asked for, the scene around the root;
        ``scene_parameters``: e of the world's boxes."""
        body = self.view(state)
        if len(self.ranges.headings):
            boxes = body.boxes
            tops, headings = boxes[..., :3], yaw(boxes[..., 3:])
        else:
            tops, headings = body.qpos.new_zeros(len(frame), 0, 3), body.qpos.new_zeros(len(frame), 0)
        return self.observations_among(body, frame, body.qpos[:, :7], tops, headings)

    def observations_among(
        self, body: BodyView, frame: Tensor, root: Tensor, tops: Tensor, headings: Tensor
    ) -> dict[str, Tensor]:
        """:meth:`observations` of bodies with ``root [N, 7]`` among boxes; differentiable in root and boxes.

        Args:
            body: of the links.
            frame: ``[N]``.
            root: place and quaternion.
            tops: ``[N, K, 3]`` m. headings: ``[N, K]`` rad.
        """
        phase = (frame.double() / max(1, self.n_frames - 1))[:, None]
        parts = [phase, links_in_root_frame(body)]
        if self.sees_scene:
            parts += [up_in_root_frame(root[:, 3:]), root[:, 2:3], boxes_from_root(root, tops, headings)]
        change = self.ranges.change(tops, headings)
        return {"humanoid_state": torch.cat(parts, dim=-1), "scene_parameters": self.ranges.parameters(change)}

    def step_view(self, state: BodyState | BodyView, frame: Tensor, step: Tensor, **parts: Any) -> StepView:
        """See :class:`ImitationProblem`; terms find the frame's hints beside the joints."""
        view = super().step_view(state, frame, step, **parts)
        told = {"hints": self.hints.at(frame), "torque_limit": self._torque_limit}
        told["control_dt"] = self.humanoid.control_dt
        return replace(view, reference=SimpleNamespace(**vars(view.reference), **told))

    def remembered(self, view: StepView, memory: Tensor) -> Tensor:
        """``[N, 5]`` steps for which each effector's contact has been wrong, and anything else has touched."""
        assert view.contacts is not None
        touched = view.contacts.floor | view.contacts.boxes.any(-1)
        now = torch.cat([contact_mismatch(view), touched[:, self._others].any(-1, keepdim=True)], dim=-1)
        return torch.where(now, memory + 1.0, 0.0)

    def ended(self, view: StepView, take: Tensor) -> dict[str, Tensor]:
        """``[N]`` by each of :data:`ENDINGS`, see :class:`ReconstructionEndings`; False where it has no limit."""
        assert view.memory is not None
        limits, body, hints = self._limits, view.body, view.reference.hints  # type: ignore[union-attr]
        height = body.centre_of_mass[:, 2] - body.xpos[..., 2].amin(-1)
        wrong = view.memory * self.humanoid.control_dt
        figures = {
            "centre_of_mass_low": hints.com_height - height,
            "up_hint_off": (body.up_angle - hints.up).abs(),
            "contact_mismatch": wrong[:, :-1].amax(-1),
            "forbidden_contact": wrong[:, -1],
        }
        never = float("inf")
        found = {name: getattr(limits, name) for name in ENDINGS}
        return {name: value > (never if found[name] is None else found[name]) for name, value in figures.items()}

    def boxes(self, frame: Tensor, generator: torch.Generator) -> Scene | None:
        """As drawn for each episode, or as the first states have them. None where the scene has no boxes."""
        if not len(self.ranges.headings):
            return None
        return self.ranges.scene(self.changes(len(frame), generator))

    def changes(self, count: int, generator: torch.Generator) -> Tensor:
        """``[count, K, 4]`` of the boxes of so many episodes."""
        standing = self.start.change.expand(count, -1, -1)
        return torch.where(self.varies[:, None], self.ranges.drawn(count, generator), standing)

    def first_state(self, frame: Tensor, scene: Scene | None = None) -> tuple[Tensor, Tensor]:
        """The start's; a body that a box carries is moved as the box is, and one that would be in a box is raised."""
        qpos, qvel = self.start.qpos.index_select(0, frame), self.start.qvel.index_select(0, frame)
        if scene is None:
            return qpos, qvel
        qpos, qvel = self.carried(frame, qpos, qvel, scene)
        up = torch.zeros_like(qpos)
        up[:, 2] = (self._depth(qpos.detach(), scene) - _SUNK).clamp_min(0.0)
        return qpos + up, qvel

    def _depth(self, qpos: Tensor, scene: Scene) -> Tensor:
        """``[n]`` m, how deep bodies are in the scene, by their joints, soles and hands."""
        xpos, xquat, _ = self._placer(qpos.numpy())
        state = {"qpos": qpos, "qvel": qpos, "xpos": torch.from_numpy(xpos), "xquat": torch.from_numpy(xquat)}
        body = BodyView(state, self.layout)
        points = torch.cat([body.xpos, body.touching_points], dim=1)
        return depth_in_scene(points, scene.top.detach(), scene.heading.detach(), self.hints.box_sizes)

    def carried(self, frame: Tensor, qpos: Tensor, qvel: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
        """Bodies ``[n]`` at ``frame [n]``, among the boxes of the first states, moved to where ``scene`` has theirs."""
        support = self.start.support.index_select(0, frame)
        rows, at = torch.arange(len(frame)), support.clamp_min(0)
        tops, headings = self.ranges.changed(self.start.change)
        moved = moved_with(qpos, qvel, (tops[at], headings[at]), (scene.top[rows, at], scene.heading[rows, at]))
        carried = (support >= 0)[:, None]
        return torch.where(carried, moved[0], qpos), torch.where(carried, moved[1], qvel)
