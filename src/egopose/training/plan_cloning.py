"""The policy of a reconstruction learns to do as a simulated motion's teacher does, before PPO takes over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from egopose.envs.mdp.observations import BodyView
from egopose.envs.reconstruction import ReconstructionProblem
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.derivatives import moved
from egopose.humanoid.physics_worker import Placer
from egopose.motion.rotations import Array
from egopose.training.plan_feedback import PlanTeacher


@dataclass(frozen=True)
class PlanCloningSettings:
    """See ``conf/task/reconstruction.yaml``.

    Args:
        rounds: of replays and learning. The first is led by the teacher, later ones by the policy as well.
        bodies: side by side in a round's replays.
        nearby: states near each one met, with the control that the teacher would take there.
        steps: of learning, a round.
        batch: lessons a step.
        learning_rate: Adam's, falling to nothing.
        largest: units of the action; what teacher would exceed is cut.
        counted: states that the normaliser is to have seen.
    """

    rounds: int
    bodies: int
    nearby: int
    steps: int
    batch: int
    learning_rate: float
    largest: float
    counted: int


@dataclass(frozen=True)
class PlanLessons:
    """n lessons: ``state [n, S]`` raw and ``scene [n, P]`` as the policy sees them, ``action [n, nu]``; float32."""

    state: Tensor
    scene: Tensor
    action: Tensor

    def __add__(self, other: PlanLessons) -> PlanLessons:
        pairs = ((self.state, other.state), (self.scene, other.scene), (self.action, other.action))
        return PlanLessons(*(torch.cat(pair) for pair in pairs))


class PlanSchool:
    """Lessons of a teacher, as the policy sees its states.

    Args:
        problem: whose observations and actions they are; its boxes are where the motion has them.
        teacher: of the motion.
    """

    def __init__(self, problem: ReconstructionProblem, teacher: PlanTeacher) -> None:
        self._problem, self._teacher = problem, teacher
        humanoid = problem.humanoid
        self._placer = Placer(humanoid.mj_model, humanoid.body_ids)
        self._mass = humanoid.mj_model.body_mass[humanoid.body_ids]

    def seen(
        self, frame: NDArray[np.int64], qpos: Array, qvel: Array, change: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``humanoid_state [n, S]`` and ``scene_parameters [n, P]`` of bodies at ``frame [n]``, float32.

        With ``change [n, K, 4]`` of the boxes each body is moved as the box is that carries it.
        """
        problem, at, count = self._problem, torch.from_numpy(frame), len(frame)
        scene = problem.ranges.scene(problem.start.change.expand(count, -1, -1) if change is None else change)
        state = torch.from_numpy(qpos), torch.from_numpy(qvel)
        if change is not None and len(problem.ranges.headings):
            state = problem.carried(at, *state, scene)
        places = state[0].numpy()
        xpos, xquat, xipos = self._placer(places)
        com = self._mass @ xipos / self._mass.sum()
        arrays = {"qpos": places, "qvel": state[1].numpy(), "xpos": xpos, "xquat": xquat, "com": com}
        body = BodyView({name: torch.from_numpy(value) for name, value in arrays.items()}, problem.layout)
        seen = problem.observations_among(body, at, body.qpos[:, :7], scene.top, scene.heading)
        return seen["humanoid_state"].float(), seen["scene_parameters"].float()

    def target(self, action: Tensor, frame: NDArray[np.int64]) -> Array:
        """Controls ``[n, nu]`` rad of actions ``[n, nu]`` at ``frame [n]``."""
        return self._problem.target(action, torch.from_numpy(frame + 1)).numpy()

    def lessons(
        self,
        frame: NDArray[np.int64],
        qpos: Array,
        qvel: Array,
        settings: PlanCloningSettings,
        rng: np.random.Generator,
    ) -> PlanLessons:
        """Of these states, and of ``nearby`` others around each.

        Where episodes' boxes vary, the others see boxes drawn from their ranges. What the control should be there
        nobody knows; that it changes little is a better beginning than what an untaught network makes of it.
        """
        nv, deviation = qvel.shape[1], self._teacher.settings.deviations(qvel.shape[1])
        parts = [(frame, qpos, qvel)]
        for _ in range(settings.nearby):
            move = deviation * rng.normal(size=(len(frame), 2 * nv)) * rng.random((len(frame), 1))
            parts.append((frame, moved(qpos, move[:, :nv]), qvel + move[:, nv:]))
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        out = None
        for at, places, speeds in parts:
            ctrl = torch.from_numpy(self._teacher.control(at, places, speeds))
            base = self._problem.target(torch.zeros(ctrl.shape), torch.from_numpy(at + 1))
            action = (ctrl - base) / self._problem.action.scale
            change = None if places is qpos else self._problem.changes(len(at), generator)
            state, scene = self.seen(at, places, speeds, change)
            part = PlanLessons(state, scene, action.clamp(-settings.largest, settings.largest).float())
            out = part if out is None else out + part
        assert out is not None
        return out


def set_statistics(normalizer: StateNormalizer, states: Tensor, counted: int) -> None:
    """The normaliser's, as if it had seen ``counted`` states like ``states [n, S]``."""
    states = states.double()
    normalizer.count.fill_(counted)
    normalizer.mean.copy_(states.mean(0))
    normalizer.sum_of_squares.copy_((states.var(0) + 1e-6) * (counted - 1))


def clone_plan(
    mean: Callable[[Tensor, Tensor], Tensor],
    parameters: list[nn.Parameter],
    normalizer: StateNormalizer,
    lessons: PlanLessons,
    settings: PlanCloningSettings,
    generator: torch.Generator,
) -> float:
    """Teach ``mean(normalised state, scene) -> action``; the root mean squared error of the last steps, units."""
    optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
    state = normalizer.normalize(lessons.state)
    errors = list[float]()
    for step in range(settings.steps):
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * (1.0 - step / settings.steps)
        rows = torch.randint(len(state), (settings.batch,), generator=generator)
        loss = (mean(state[rows], lessons.scene[rows]) - lessons.action[rows]).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        errors.append(loss.item())
    return float(np.sqrt(np.mean(errors[-100:])))
