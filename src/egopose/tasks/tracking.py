"""Following any kinematic motion with a simulated body: the one policy behind estimates, forecasts and reconstructions.

The policy sees the body, and where the motion it follows goes next (:mod:`egopose.envs.target_window`). It sees no
video. It is trained on motion capture with errors as a regressor makes them, and paid for the truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from egopose.core.config import convert, from_mapping
from egopose.core.errors import InputError
from egopose.envs.imitation import ActionSettings
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.starts import Piece
from egopose.envs.tracking import TrackingEndings, TrackingProblem
from egopose.motion.rotations import Array
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import WINDOW, ImitationTask
from egopose.tasks.target_variants import TargetError, target_variants
from egopose.tasks.task import Sources


@dataclass(frozen=True)
class _OtherSet:
    """A row of ``task.also``: the folder of a choice of ``conf/data``, None for not used; subjects, None for all."""

    folder: str | None
    subjects: tuple[str, ...] | None


class Tracking(ImitationTask):
    """Bodies follow motion capture with errors on top."""

    name, protocol = "tracking", "survival"

    def check(self, config: Mapping[str, Any]) -> None:
        """Raises InputError: the policy cannot see what it should follow, or it is never, or not first, the truth."""
        if WINDOW not in config["model"]["inputs"]:
            raise InputError("configuration", "model.inputs", f"a tracker follows {WINDOW}: model=tracking")
        free = [number for number, row in enumerate(config["task"]["errors"]) if row is None]
        if free != [0]:
            raise InputError("configuration", "task.errors", f"needs the truth (null) first and once, not at {free}")

    def dataset(self, config: Mapping[str, Any], sources: Sources) -> Dataset:
        """Every training clip with each error of ``task.errors``, and its mirror image; test clips with each error.

        Clips of the sets ``task.also`` train as well.

        Raises:
            InputError: an error's setting is missing or wrong, or a set cannot be used.
        """
        task = config["task"]
        errors = [
            None if row is None else from_mapping(TargetError, row, f"task.errors[{number}]")
            for number, row in enumerate(task["errors"])
        ]
        motions = sources.motions()
        clips, train = clips_of(motions), list(motions.train)
        for name, row in task["also"].items():
            also = from_mapping(_OtherSet, row, f"task.also.{name}")
            if also.folder is not None:
                other = sources.other_motions(name, also.folder, also.subjects)
                train += [Piece(len(clips) + f.take, f.start, f.stop) for f in other.train]
                clips += clips_of(other)
        mirror, seed = convert(task["mirror"], bool, "task", "mirror"), int(task["errors_seed"])
        fragments = [*train, *motions.test]
        whole = target_variants(motions.humanoid, clips, fragments, errors, mirror, seed)
        trains = len(train)
        return replace(
            motions,
            reference=whole.reference,
            takes=whole.takes,
            train=_part(whole.pieces, len(fragments), slice(trains)),
            test=_part(whole.unmirrored, len(fragments), slice(trains, None)),
            joint_targets=whole.joint_targets,
            states=whole.states,
            path=whole.path,
        )

    def problem(self, config: Mapping[str, Any], dataset: Dataset, endings_end: bool | None) -> TrackingProblem:
        """See :class:`~egopose.tasks.task.Task`."""
        task = config["task"]
        termination = {**task["termination"], **({} if endings_end is None else {"enabled": endings_end})}
        assert dataset.states is not None
        assert dataset.path is not None
        return TrackingProblem(
            dataset.humanoid,
            dataset.reference,
            dataset.takes,
            build_reward(config["reward"]),
            ActionSettings(**task["action"]),
            from_mapping(TrackingEndings, termination, "task.termination"),
            torch.as_tensor(dataset.joint_targets),
            dataset.states,
            dataset.path,
        )


def _part(pieces: list[Piece], count: int, part: slice) -> list[Piece]:
    """The same ``part`` of every ``count`` pieces."""
    return [piece for at in range(0, len(pieces), count) for piece in pieces[at : at + count][part]]


def clips_of(dataset: Dataset) -> list[Array]:
    """``qpos [T, nq]`` of every take; copies, as a store's own are mapped from its files."""
    offsets, lengths = dataset.takes.offsets.tolist(), dataset.takes.lengths.tolist()
    qpos = dataset.reference["qpos"]
    return [qpos[a : a + n].numpy().copy() for a, n in zip(offsets, lengths, strict=True)]


TASK = Tracking()
