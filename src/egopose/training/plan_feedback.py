"""A simulated motion with the feedback that keeps bodies near it: a teacher for the policy of a reconstruction.

Played again from any other state, a motion's controls make a body fall within a second. So the step is linearised along
the motion, and Riccati's recursion gives gains (Li & Todorov 2004): the control is the motion's own, and the gains
times how far the body is from it. Noise leads bodies to states around the motion, and each gets the control that the
teacher would take there (Laskey et al. 2017, DART; Ross, Gordon & Bagnell 2011 where the student leads).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.derivatives import Differences, Simulator, Single, linearised, moved, state_difference
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.trajectory import TrackingCost, TrajectoryOptimiser
from egopose.motion.rotations import Array
from egopose.scene.simulated import SimulatedMotion

#: Controls ``[n, nu]`` rad of a policy at frames ``[n]`` in states ``[n, nq]``, ``[n, nv]``.
Student = Callable[[NDArray[np.int64], Array, Array], Array]
_TOO_FAST = 60.0  # m/s and rad/s: a body that broke


@dataclass(frozen=True)
class FeedbackSettings:
    """See ``conf/task/reconstruction.yaml``.

    Args:
        reach: rad that feedback may change a control by.
        place, turn, joints: m, rad and rad, standard deviations of how far bodies begin from the motion.
        rates: m/s and rad/s, likewise.
        noise: rad, standard deviation of what is added to controls on the way.
        lost: m that a body's root may be from the motion's; then it is taken out.
        cost: of being away from the motion, see :class:`TrackingCost`.
    """

    reach: float
    place: float
    turn: float
    joints: float
    rates: float
    noise: float
    lost: float
    cost: TrackingCost

    def deviations(self, nv: int) -> Array:
        """``[2 nv]`` of how far bodies begin from the motion."""
        return np.array([*[self.place] * 3, *[self.turn] * 3, *[self.joints] * (nv - 6), *[self.rates] * nv])


class PlanTeacher:
    """Controls near a simulated motion.

    Args:
        simulator: of the motion's humanoid; its boxes are put where the motion has them.
        humanoid: the model.
        plan: the motion.
        settings: see :class:`FeedbackSettings`.
    """

    def __init__(
        self, simulator: Simulator, humanoid: HumanoidModel, plan: SimulatedMotion, settings: FeedbackSettings
    ) -> None:
        self.plan, self.settings, self._simulator, self._humanoid = plan, settings, simulator, humanoid
        if len(plan.box_headings):
            simulator.place_boxes(plan.box_tops, plan.box_headings)
        #: ``[T - 1, nu, 2 nv]`` how the control changes with the state.
        self.gains = self._gains()

    def _gains(self) -> Single:
        plan, simulator = self.plan, self._simulator
        # A frame at a time keeps the memory of the derivatives small.
        rows = [
            linearised(simulator, plan.qpos[t : t + 1], plan.qvel[t : t + 1], plan.ctrl[t : t + 1], Differences())
            for t in range(len(plan) - 1)
        ]
        state, control = (np.concatenate(part)[None] for part in zip(*rows, strict=True))
        optimiser = TrajectoryOptimiser(simulator, self.settings.cost)
        size = 2 * plan.qvel.shape[1]
        nothing = np.zeros((1, len(plan), size)), np.zeros((1, *plan.ctrl.shape))
        _, gains = optimiser.backward(state, control, *nothing)
        return gains[0]

    def control(self, frame: NDArray[np.int64], qpos: Array, qvel: Array) -> Array:
        """``[n, nu]`` rad for reaching the frame after ``frame [n]`` from ``qpos [n, nq]`` and ``qvel [n, nv]``."""
        plan, reach = self.plan, self.settings.reach
        away = state_difference(qpos, qvel, plan.qpos[frame], plan.qvel[frame])
        change = np.einsum("nij,nj->ni", self.gains[frame], away)
        return np.asarray(plan.ctrl[frame] + np.clip(change, -reach, reach))

    def replays(
        self, bodies: int, rng: np.random.Generator, student: Student | None = None
    ) -> tuple[NDArray[np.int64], Array, Array]:
        """States that bodies meet which begin near the motion, at any frame, and are led astray.

        Args:
            bodies: side by side, each to the motion's end or until it is lost.
            rng: of starts and noise.
            student: leads half of the bodies in place of the teacher and noise.

        Returns:
            ``frame [n]``, ``qpos [n, nq]`` and ``qvel [n, nv]``; every frame is before the last.
        """
        plan, settings = self.plan, self.settings
        frame = rng.integers(0, len(plan) - 1, bodies)
        qpos, qvel = self._near(frame, rng)
        led = (np.arange(bodies) % 2 == 1) & (student is not None)
        met: list[tuple[NDArray[np.int64], Array, Array]] = []
        while len(frame):
            met.append((frame, qpos, qvel))
            ctrl = self.control(frame, qpos, qvel) + settings.noise * rng.normal(size=(len(frame), plan.ctrl.shape[1]))
            if student is not None:
                ctrl = np.where(led[:, None], student(frame, qpos, qvel), ctrl)
            qpos, qvel = self._simulator.step(qpos, qvel, ctrl)
            frame = frame + 1
            kept = self._near_still(frame, qpos, qvel) & (frame < len(plan) - 1)
            frame, qpos, qvel, led = frame[kept], qpos[kept], qvel[kept], led[kept]
        frames, states, rates = zip(*met, strict=True)
        return np.concatenate(frames), np.concatenate(states), np.concatenate(rates)

    def kept(self, bodies: int, rng: np.random.Generator, student: Student) -> float:
        """Mean frames for which ``student`` keeps bodies near the motion that begin near its first frame."""
        frame = np.zeros(bodies, dtype=np.int64)
        qpos, qvel = self._near(frame, rng)
        near, frames = np.ones(bodies, dtype=bool), np.ones(bodies)
        for _ in range(len(self.plan) - 1):
            qpos, qvel = self._simulator.step(qpos, qvel, student(frame, qpos, qvel))
            frame = frame + 1
            near &= self._near_still(frame, qpos, qvel)
            frames += near
        return float(frames.mean())

    def _near(self, frame: NDArray[np.int64], rng: np.random.Generator) -> tuple[Array, Array]:
        """States drawn around the motion's at ``frame [n]``."""
        plan, nv, bodies = self.plan, self.plan.qvel.shape[1], len(frame)
        move = self.settings.deviations(nv) * rng.normal(size=(bodies, 2 * nv)) * rng.random((bodies, 1))
        return moved(plan.qpos[frame], move[:, :nv]), plan.qvel[frame] + move[:, nv:]

    def _near_still(self, frame: NDArray[np.int64], qpos: Array, qvel: Array) -> NDArray[np.bool_]:
        away = np.linalg.norm(qpos[:, :3] - self.plan.qpos[frame, :3], axis=1)
        return (np.abs(qvel).max(axis=1) < _TOO_FAST) & (away < self.settings.lost)
