"""Reconstruction of a filmed person's motion: a policy that makes a body do, with physics, what one clip shows.

Yu, Park & Lee 2021. Poses, contacts and an up-hint come from a folder that ``egopose reconstruct prepare`` wrote; where
the root is nobody tells the policy or its reward. The folder of the clip is the data: no set is prepared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs.transforms import Transform

from egopose.core.config import convert, from_mapping
from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.data.preparation import humanoid_of
from egopose.data.reference import reference_states
from egopose.envs.imitation import ActionSettings
from egopose.envs.mdp.clip_hints import EFFECTORS, ClipHints, hints_of
from egopose.envs.mdp.observations import TouchingPoints
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.problem import Problem, TakeTable
from egopose.envs.reconstruction import ReconstructionEndings, ReconstructionProblem, StartStates
from egopose.envs.scene_ranges import SceneRanges
from egopose.envs.starts import Piece, Starts, WholeFragments, training_starts
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.boxes import DEPTH
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.scene.carriers import carriers
from egopose.scene.clip import BODIES, Clip, box_poses, humanoid_in, read_clip, wanted_contacts
from egopose.scene.scene_file import FREE, Scene
from egopose.scene.simulated import SimulatedMotion, load_simulated
from egopose.scene.up_hint import up_hint
from egopose.scene.windows import Window, windows
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import Sources

_SOURCE = "configuration"


@dataclass(frozen=True)
class ClipDataset(Dataset):
    """A dataset of one clip.

    Args:
        clip: its folder's.
        plan: a simulated motion of the clip that episodes begin in, or None.
    """

    clip: Clip | None = None
    plan: SimulatedMotion | None = None


class Reconstruction:
    """Bodies do what one clip shows, among the boxes of its scene."""

    name, protocol = "reconstruction", "reconstruction"

    def context(self, config: Mapping[str, Any]) -> int | None:
        """See :class:`~egopose.tasks.task.Task`."""
        return None

    def check(self, config: Mapping[str, Any]) -> None:
        """Raises InputError: no clip is named, the policy would see what is not there, or targets have no source."""
        task, model = config["task"], config["model"]
        if not task["clip"]:
            raise InputError(_SOURCE, "task.clip", "name the folder that `egopose reconstruct prepare` wrote")
        if task["targets"] not in ("clip", "plan"):
            raise InputError(_SOURCE, "task.targets", f"must be clip or plan, not {task['targets']!r}")
        if task["targets"] == "plan" and not task["start_from"]:
            raise InputError(_SOURCE, "task.targets", "plan needs task.start_from=PLAN")
        if model["context"]["source"] != "none":
            raise InputError(_SOURCE, "model.context.source", "a clip has no worn camera's video: model=reconstruction")

    def dataset(self, config: Mapping[str, Any], sources: Sources) -> ClipDataset:
        """The clip alone; ``sources`` is not asked.

        Raises:
            InputError: the folder or the plan cannot be read, or they do not fit the humanoid or each other.
        """
        self.check(config)
        task = config["task"]
        folder = Path(str(task["clip"])).expanduser()
        clip = read_clip(folder)
        bare = humanoid_of(config)
        humanoid = humanoid_in(clip.scene, bare)
        if len(clip) < 2:
            raise InputError(folder / "body.npz", "frames", "a clip needs two frames at least")
        try:
            writable = replace(clip.body, qpos=clip.body.qpos.copy())
            reference = reference_states(bare, writable)
        except ValueError as error:
            raise InputError(folder / "body.npz", "body", str(error)) from None
        plan = None if not task["start_from"] else _plan(Path(str(task["start_from"])).expanduser(), clip, humanoid)
        window = window_of(config, clip)
        head = reference["xpos"][:, humanoid.head, 2].min()
        takes = TakeTable(torch.tensor([0]), torch.tensor([len(clip)]), head[None].double())
        pieces = [Piece(0, window.start, window.stop)]
        return ClipDataset(humanoid, reference, takes, pieces, pieces, clip=clip, plan=plan)

    def followed(self, config: Mapping[str, Any], dataset: Dataset) -> Dataset:
        """See :class:`~egopose.tasks.task.Task`."""
        return dataset

    def problem(self, config: Mapping[str, Any], dataset: Dataset, endings_end: bool | None) -> ReconstructionProblem:
        """See :class:`~egopose.tasks.task.Task`.

        Raises:
            InputError: a setting is missing or wrong.
        """
        assert isinstance(dataset, ClipDataset)
        assert dataset.clip is not None
        task, clip, plan, humanoid = config["task"], dataset.clip, dataset.plan, dataset.humanoid
        termination = {**task["termination"], **({} if endings_end is None else {"enabled": endings_end})}
        touches = touches_of(clip, humanoid)
        touching = touching_points(humanoid)
        ranges = ranges_of(clip.scene)
        there = set(window_of(config, clip).boxes) if convert(task["scene"]["vary"], bool, "task.scene", "vary") else ()
        action = from_mapping(ActionSettings, task["action"], "task.action")
        if task["targets"] == "plan":
            action = replace(action, velocity_feedforward=0.0)
        return ReconstructionProblem(
            humanoid,
            dataset.reference,
            dataset.takes,
            build_reward(config["reward"]),
            action,
            from_mapping(ReconstructionEndings, termination, "task.termination"),
            _targets(str(task["targets"]), clip, plan),
            clip_hints(clip, humanoid, dataset.reference, touches, touching),
            touching,
            ranges,
            torch.tensor([box.name in there for box in clip.scene.boxes], dtype=torch.bool),
            _start(dataset, touches, ranges),
            convert(task["scene"]["seen"], bool, "task.scene", "seen"),
        )

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """The state's normaliser; e is within [-1, 1] already."""
        return [StateNormalizer(problem.observation_sizes["humanoid_state"])]

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        """See :class:`~egopose.tasks.task.Task`; at any frame of the clip."""
        task, takes = config["task"], problem.takes
        if whole_fragments:
            return WholeFragments(fragments, takes.offsets, takes.lengths)
        longest = max(f.stop - f.start for f in fragments)
        horizon = longest if task["horizon"] is None else min(int(task["horizon"]), longest)
        minimum = min(int(task["minimum"]), horizon)
        return training_starts(task["starts"], fragments, takes.offsets, takes.lengths, horizon, minimum)


def touches_of(clip: Clip, humanoid: HumanoidModel) -> Tensor:
    """``[T, 4, 1 + K]`` bool: what each end effector should touch.

    By the scene's contacts; where it names none of the feet, they stand on the floor when the clip says so.
    """
    wanted = wanted_contacts(clip.scene, humanoid, len(clip))
    touches = wanted[:, [humanoid.skeleton.index(BODIES[name]) for name in EFFECTORS]]
    if not any(contact.effector.endswith("_foot") for contact in clip.scene.contacts):
        touches[:, :2, 0] = clip.touching
    return torch.from_numpy(touches)


def touching_points(humanoid: HumanoidModel) -> TouchingPoints:
    """The middles of the soles, and of the hands' shapes."""
    model, points = humanoid.mj_model, []
    bodies = [humanoid.skeleton.index(BODIES[name]) for name in EFFECTORS]
    feet = {int(foot): sole.mean(axis=0) for foot, sole in zip(humanoid.feet, humanoid.sole_points, strict=True)}
    for body in bodies:
        geom = int(model.body_geomadr[humanoid.body_ids[body]])
        points.append(feet.get(body, model.geom_pos[geom]))
    return TouchingPoints(torch.tensor(bodies), torch.from_numpy(np.stack(points)), humanoid.head)


def window_of(config: Mapping[str, Any], clip: Clip) -> Window:
    """The part of the clip that ``task.window`` names; all of it, with all of its boxes, for None.

    Raises:
        InputError: the clip has no such window.
    """
    number = config["task"]["window"]
    if number is None:
        return Window(1, tuple(box.name for box in clip.scene.boxes), 0, len(clip), len(clip))
    there = windows(clip.scene.contacts, len(clip))
    if not 1 <= int(number) <= len(there):
        raise InputError(_SOURCE, "task.window", f"{number} must be from 1 to {len(there)}, the windows of this clip")
    return there[int(number) - 1]


def ranges_of(scene: Scene) -> SceneRanges:
    """What the scene leaves free of its boxes."""
    tops, headings = box_poses(scene)
    span = np.array([[box.free.get(name, (0.0, 0.0)) for name in FREE] for box in scene.boxes])
    low, high = torch.from_numpy(span.reshape(-1, len(FREE), 2)).unbind(-1)
    return SceneRanges(torch.from_numpy(tops), torch.from_numpy(headings), low.contiguous(), high.contiguous(), DEPTH)


def clip_hints(
    clip: Clip, humanoid: HumanoidModel, reference: Any, touches: Tensor, touching: TouchingPoints
) -> ClipHints:
    """What the clip tells of every frame beside its poses."""
    xpos, xquat = reference["xpos"].double(), reference["xquat"].double()
    quats, points = xquat[:, touching.bodies].numpy(), touching.points.numpy()
    places = xpos[:, touching.bodies] + torch.from_numpy(rot.rotate(quats, np.broadcast_to(points, (len(clip), 4, 3))))
    name = humanoid.skeleton.names[humanoid.head]
    up = torch.from_numpy(up_hint(clip.body, name))
    sizes = torch.from_numpy(humanoid.box_sizes)
    sure = clip.body.confidence
    trust = torch.ones(len(clip), dtype=torch.float64) if sure is None else torch.tensor(sure, dtype=torch.float64)
    return hints_of(up, touches, places, reference["com"].double(), xpos[..., 2].amin(-1), trust, sizes)


def _plan(path: Path, clip: Clip, humanoid: HumanoidModel) -> SimulatedMotion:
    """Raises InputError: it is missing, damaged, or of another body, scene or clip."""
    plan = load_simulated(path)
    model = humanoid.mj_model
    shapes = {"qpos": model.nq, "qvel": model.nv, "ctrl": model.nu}
    for name, size in shapes.items():
        if getattr(plan, name).shape[1:] != (size,):
            raise InputError(path, name, f"has shape {list(getattr(plan, name).shape)}, the humanoid {size} columns")
    if len(plan.box_headings) != len(clip.scene.boxes):
        raise InputError(path, "box_headings", f"has {len(plan.box_headings)} boxes, the scene {len(clip.scene.boxes)}")
    if len(plan) < 2:
        raise InputError(path, "qpos", "a plan needs two frames at least")
    return plan


def _targets(source: str, clip: Clip, plan: SimulatedMotion | None) -> Tensor:
    """``[T, nu]`` rad what actions are added to for reaching each frame."""
    joints = clip.body.qpos[:, 7:].copy()
    if source == "plan" and plan is not None:
        last = min(len(plan), len(clip))
        joints[1:last] = plan.ctrl[: last - 1]
        joints[0] = plan.ctrl[0]
    return torch.from_numpy(joints)


def _start(dataset: ClipDataset, touches: Tensor, ranges: SceneRanges) -> StartStates:
    """The plan's states, and behind its end the kinematic body's."""
    plan, support = dataset.plan, torch.from_numpy(carriers(touches.numpy()))
    qpos, qvel = dataset.reference["qpos"].double(), dataset.reference["qvel"].double()
    if plan is None:
        return StartStates(qpos, qvel, support, torch.zeros_like(ranges.low))
    # Copies: files are read into arrays that cannot be written to.
    tops, headings = torch.tensor(plan.box_tops), torch.tensor(plan.box_headings)
    known = min(len(plan), len(qpos))
    qpos = torch.cat([torch.tensor(plan.qpos[:known]), qpos[known:]])
    qvel = torch.cat([torch.tensor(plan.qvel[:known]), qvel[known:]])
    return StartStates(qpos, qvel, support, ranges.change(tops, headings))


TASK = Reconstruction()
