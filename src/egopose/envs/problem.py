"""One definition of the imitation problem, shared by the batched environment and the dm_control task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.envs.mdp.observations import BodyState, BodyView
from egopose.envs.mdp.rewards import RewardTable
from egopose.envs.mdp.step_view import StepView
from egopose.humanoid.model import HumanoidModel

#: Keys of a body state, batch ``[N]``, float64: ``qpos [N, nq]``, ``qvel [N, nv]`` and ``com [N, 3]`` m of the body,
#: ``xpos [N, B, 3]`` m and ``xquat [N, B, 4]`` of its parts in the world. A reference has the same keys, and
#: ``com_vel [N, 3]`` m/s.
BODY_KEYS = ("qpos", "qvel", "xpos", "xquat", "com")
#: From what an environment writes to the row of the target motion that each body should be in, ``[N]`` int64.
Rows = Callable[[Mapping[str, Tensor]], Tensor]


class Scene(NamedTuple):
    """Boxes of n worlds; a box that is not used is parked out of reach.

    Attributes:
        top: ``[n, K, 3]`` m, centres of the upper faces in the world.
        heading: ``[n, K]`` rad about the vertical.
        used: ``[n, K]`` bool.
    """

    top: Tensor
    heading: Tensor
    used: Tensor


class Followed(NamedTuple):
    """The target motion of bodies at test time, when the truth is not known, as a table.

    Attributes:
        states: ``[R, 2 nq - 3]`` humanoid states.
        row: which of them each body should be in now.
        path: ``[R, 3]`` x, y (m) and heading (rad) of the root, in a world of its own for each take; None where there
            is none. Only how the rows of a take lie to each other counts.
    """

    states: Tensor
    row: Rows
    path: Tensor | None = None


class TargetMotion(Protocol):
    """The motion that N bodies follow, some frames ahead of where each body is in it.

    ``entries`` are an environment's: ``frame``, ``episode_start`` and ``episode_step``, ``[N, 1]`` int64 each. ``ahead
    [K]`` int64 are frames; behind the motion's end its last frame stands still.

    Attributes:
        size: S, numbers of a humanoid state.
    """

    size: int

    def states(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float32]:
        """Humanoid states ``[N, K, S]``."""
        ...

    def path(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float64]:
        """``[N, K, 3]`` x, y (m) and heading (rad) of the root, in a world of the motion's own."""
        ...

    def followed(self, starts: Tensor | None = None) -> Followed:
        """The motion of bodies whose episodes begin at global frames ``[W]``, each once; None for all of it."""
        ...


def global_frame(entries: Mapping[str, Tensor]) -> Tensor:
    """The row of a table of all frames."""
    return entries["frame"].squeeze(-1)


@dataclass(frozen=True)
class TakeTable:
    """Where the takes lie among the reference's frames.

    Args:
        offsets: ``[K]`` int64, first frame of each take.
        lengths: ``[K]`` int64, frames.
        lowest_head_height: ``[K]`` float64 m, the lowest the reference's head gets in the take.
        groups: of each take, what ``data.shares`` names; empty where nothing names them.
    """

    offsets: Tensor
    lengths: Tensor
    lowest_head_height: Tensor
    groups: tuple[str, ...] = ()

    def last(self) -> Tensor:
        """``[F]`` int64, the last frame of each frame's take."""
        return (self.offsets + self.lengths - 1).repeat_interleave(self.lengths)

    def following(self) -> Tensor:
        """``[F]`` int64, the frame after each frame; of a take's last frame, itself."""
        frames = torch.arange(int(self.lengths.sum()))
        return torch.minimum(frames + 1, self.last())


class Problem(Protocol):
    """What an environment asks of a task: the one definition that every environment of it shares.

    Attributes:
        humanoid: compiled at the simulation's rate.
        takes: where episodes lie among the reference's frames.
        reward: the table of terms.
        observation_sizes: key -> numbers, of what :meth:`observations` gives.
        endings: names of what :meth:`ended` gives.
        ends_episode: those of them that end an episode.
        remembers_start: whether targets depend on the joint angles a body was placed with.
        motion_seen: the target motion whose path observations compare the root with; None where they do not. See
            :mod:`egopose.envs.mdp.path`.
        actions_move_targets: whether an action is added to PD targets; False where it is a torque.
        watched: the parts of a step beyond the body that rewards or endings read, of
            :data:`egopose.envs.mdp.rewards.PARTS`.
        memory_size: M, numbers kept of each world's episode for :meth:`remembered`; 0 for none.
    """

    humanoid: HumanoidModel
    takes: TakeTable
    reward: RewardTable
    observation_sizes: Mapping[str, int]
    endings: tuple[str, ...]
    ends_episode: frozenset[str]
    remembers_start: bool
    motion_seen: TargetMotion | None
    actions_move_targets: bool
    watched: frozenset[str]
    memory_size: int

    def view(self, state: BodyState | BodyView) -> BodyView:
        """``state`` with the quantities derived from it; every other method takes either."""
        ...

    def observations(self, state: BodyState | BodyView, frame: Tensor) -> dict[str, Tensor]:
        """``[N, size]`` float64 by key, of states at global frames ``[N]``."""
        ...

    def step_view(self, state: BodyState | BodyView, frame: Tensor, step: Tensor, **parts: Any) -> StepView:
        """What reward terms see; ``parts`` are those of the view that the reward needs."""
        ...

    def rewards(self, view: StepView) -> tuple[Tensor, dict[str, Tensor]]:
        """Reward ``[N]`` of a step and its terms."""
        ...

    def target(self, action: Tensor, frame: Tensor, placed: Tensor | None = None) -> Tensor:
        """Controls ``[N, nu]`` from actions ``[N, A]``, for reaching frames ``[N]``."""
        ...

    def ended(self, view: StepView, take: Tensor) -> dict[str, Tensor]:
        """``[N]`` bool by ending, of a step of worlds that act out ``take [N]``."""
        ...

    def remembered(self, view: StepView, memory: Tensor) -> Tensor:
        """What is kept ``[N, M]`` after a step, from what was kept before it; zeros where an episode begins.

        :meth:`ended` finds it in its view.
        """
        ...

    def first_state(self, frame: Tensor, scene: Scene | None = None) -> tuple[Tensor, Tensor]:
        """``qpos [n, nq]`` and ``qvel [n, nv]`` of episodes that begin at global frames ``[n]``.

        ``scene`` is what :meth:`boxes` gave for them; None where there are no boxes.
        """
        ...

    def boxes(self, frame: Tensor, generator: torch.Generator) -> Scene | None:
        """Where the boxes of the humanoid's model stand in episodes that begin at global frames ``[n]``.

        None where the model has none (:func:`egopose.humanoid.boxes.with_boxes` gives it some).
        """
        ...

    def followed(self, starts: Tensor | None = None) -> Followed:
        """The target motion of bodies whose episodes begin at global frames ``[W]``."""
        ...
