"""What a reward term sees of a control step."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import TypeAlias

from torch import Tensor

from egopose.envs.mdp.observations import BodyView

#: A body, or a table of some of its attributes at the rows of a reference.
BodyLike: TypeAlias = BodyView | SimpleNamespace


@dataclass(frozen=True)
class Contacts:
    """Which bodies touch what at the end of a step.

    Args:
        floor: ``[N, E]`` bool, end effectors on the floor.
        boxes: ``[N, E, K]`` bool, end effectors on each box of the scene.
    """

    floor: Tensor
    boxes: Tensor


@dataclass(frozen=True)
class StepView:
    """One control step of N worlds, as reward terms read it.

    A term names the parts it needs (:class:`egopose.envs.mdp.rewards.Term`); the others may be None.

    Args:
        body: where the step led.
        reference: the frame it should have led to.
        step: ``[N]`` int64 steps into the episode.
        contacts: see :class:`Contacts`.
        torques: ``[N, nu]`` N m of the actuators.
        target: ``[N, nu]`` rad, the PD target of the step (N m where actions are torques).
        scene: ``[N, K, 7]`` place (m, centre of the upper face) and quaternion of each box.
        memory: ``[N, M]`` what the problem keeps of the episode's steps, this one included.
    """

    body: BodyView
    reference: BodyLike
    step: Tensor
    contacts: Contacts | None = None
    torques: Tensor | None = None
    target: Tensor | None = None
    scene: Tensor | None = None
    memory: Tensor | None = None
