"""What a controller that plans with the simulator would do, in states that a policy meets: the policy's first lessons.

Each lesson is a state, the control there and how the control changes with the state. The teacher follows true motion
by iterative LQR in a receding horizon. Random controls, or the policy that is being taught, lead it to other states
than its own (dataset aggregation: Ross, Gordon & Bagnell 2011; gains as lessons: Carius, Farshidian & Hutter 2020).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from egopose.envs.starts import Piece
from egopose.humanoid.derivatives import Simulator, Single, state_difference
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics_worker import Placer
from egopose.humanoid.trajectory import Followed, Nominal, TrackingCost, TrajectoryOptimiser, feed_forward, shifted
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array

#: Controls ``[n, nu]`` rad of a policy at frames ``[n]`` in states ``[n, nq]``, ``[n, nv]``.
Student = Callable[[NDArray[np.int64], Array, Array], Array]
_TOO_FAST = 60.0  # m/s and rad/s: a body that broke
_LARGEST_GAIN = 1e4  # half precision ends at 6.5e4


@dataclass(frozen=True)
class TeacherSettings:
    """See ``conf/tracker.yaml``, which gives the source of every value.

    Args:
        num_envs: bodies side by side.
        horizon: frames ahead.
        every: frames between plans.
        velocity: factor of the feed-forward's lag, see :func:`egopose.humanoid.trajectory.feed_forward`.
        reach: rad that a control may differ from the feed-forward.
        chunk: frames of a piece of motion, after which a body begins elsewhere.
        noise: rad, standard deviation of what is added to the controls of the bodies that are led astray.
        astray: share of the bodies, drawn anew at every plan, that noise or the student leads.
        start_joints, start_rates: rad and rad/s, standard deviations of joints at the start of a piece.
        lost: m that the head may be below the motion's; then the body begins elsewhere.
        cost: see :class:`~egopose.humanoid.trajectory.TrackingCost`.
        forces: of inverse dynamics, see :class:`~egopose.humanoid.inverse_dynamics.ForceSettings`.
    """

    num_envs: int
    horizon: int
    every: int
    velocity: float
    reach: float
    chunk: int
    noise: float
    astray: float
    start_joints: float
    start_rates: float
    lost: float
    cost: TrackingCost
    forces: ForceSettings


@dataclass(frozen=True)
class Lessons:
    """n lessons.

    Args:
        frame: ``[n]`` int64, of the motion that is followed.
        qpos, qvel: ``[n, nq]``, ``[n, nv]`` float32, where the body was.
        ctrl: ``[n, nu]`` float32 rad, the teacher's control.
        gains: ``[n, nu, 2 nv]`` float16, how it changes with the state.
    """

    frame: NDArray[np.int64]
    qpos: Single
    qvel: Single
    ctrl: Single
    gains: NDArray[np.float16]

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def joined(cls, parts: Sequence[Lessons]) -> Lessons:
        """All lessons of ``parts``."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


@dataclass(frozen=True)
class TeachersMotion:
    """The motion that is followed, all takes one after the other.

    Args:
        qpos, qvel: ``[F, nq]``, ``[F, nv]``.
        torques: ``[F, nu]`` N m of inverse dynamics.
        heads: ``[F]`` m, the head's height.
    """

    qpos: Array
    qvel: Array
    torques: Array
    heads: Array


def teachers_motion(humanoid: HumanoidModel, clips: Sequence[Array], forces: ForceSettings) -> TeachersMotion:
    """Velocities, torques and head heights of ``clips``, ``qpos [T, nq]`` at the control rate each."""
    fps = 1.0 / humanoid.control_dt
    qvel, torques = [], []
    for clip in clips:
        qvel.append(finite_difference(clip, fps))
        found = with_forces(humanoid, Motion(humanoid.skeleton, clip, fps), forces).torques if len(clip) > 2 else None
        torques.append(np.zeros((len(clip), clip.shape[1] - 7)) if found is None else found)
    qpos = np.concatenate(clips)
    return TeachersMotion(qpos, np.concatenate(qvel), np.concatenate(torques), head_heights(humanoid, qpos))


def head_heights(humanoid: HumanoidModel, qpos: Array) -> Array:
    """``[n]`` m of bodies at ``qpos [n, nq]``."""
    xpos, _, _ = Placer(humanoid.mj_model, humanoid.body_ids)(qpos)
    return np.asarray(xpos[:, humanoid.head, 2])


def chunks(pieces: Sequence[Piece], offsets: Sequence[int], length: int) -> list[tuple[int, int, int]]:
    """Pieces of motion of about ``length`` frames: first and last + 1 global frame, and the end of what may be seen.

    Neighbours share a frame, so that every step of the motion is in one.
    """
    out = []
    for piece in pieces:
        count = max(1, round((piece.stop - piece.start) / length))
        bounds = np.linspace(piece.start, piece.stop, count + 1).astype(int) + offsets[piece.take]
        end = int(bounds[-1])
        bodies = [(int(a), min(int(b) + 1, end), end) for a, b in pairwise(bounds)]
        out += [(first, stop, end) for first, stop, end in bodies if stop - first > 1]
    return out


def teach(
    humanoid: HumanoidModel,
    motion: TeachersMotion,
    pieces: Sequence[tuple[int, int, int]],
    settings: TeacherSettings,
    simulator: Simulator,
    rng: np.random.Generator,
    student: Student | None = None,
) -> tuple[Lessons, int]:
    """The lessons of ``pieces`` (:func:`chunks`), and how many of their bodies were lost.

    Args:
        humanoid: whose motion it is.
        motion: that is followed.
        pieces: each is followed from its first frame to its last.
        settings: see :class:`TeacherSettings`.
        simulator: of all steps.
        rng: of starts and noise.
        student: leads bodies astray in place of noise.
    """
    optimiser = TrajectoryOptimiser(simulator, settings.cost, reach=settings.reach)
    bodies = _Bodies(motion, list(pieces), settings, rng)
    lessons: list[Lessons] = []
    lost = 0
    while bodies.begin_those_that_wait():
        followed = bodies.followed(humanoid)
        nominal = optimiser.simulate(bodies.qpos, bodies.qvel, followed)
        if bodies.plan is not None:
            older = shifted(bodies.plan, followed, settings.every)
            gains = np.concatenate([bodies.gains[:, settings.every :], 0 * bodies.gains[:, : settings.every]], axis=1)
            kept = optimiser.simulate(bodies.qpos, bodies.qvel, followed, older, gains=gains)
            kept.cost[bodies.fresh] = np.inf
            nominal = nominal.chosen(kept)
        bodies.plan, bodies.gains = optimiser.improve(nominal, followed)
        astray = rng.random(settings.num_envs) < settings.astray
        for step in range(settings.every):
            ahead, plan = followed.ctrl[:, step], bodies.plan
            away = state_difference(bodies.qpos, bodies.qvel, plan.qpos[:, step], plan.qvel[:, step])
            ctrl = plan.ctrl[:, step] + np.einsum("nij,nj->ni", bodies.gains[:, step], away)
            ctrl = np.clip(ctrl, ahead - settings.reach, ahead + settings.reach)
            lessons.append(bodies.lessons(step, ctrl))
            if student is None:
                led = ctrl + settings.noise * rng.normal(size=ctrl.shape)
            else:
                led = student(bodies.frames(step), bodies.qpos, bodies.qvel)
            ctrl = np.where(astray[:, None], led, ctrl)
            bodies.qpos, bodies.qvel = simulator.step(bodies.qpos, bodies.qvel, ctrl)
        lost += bodies.advance(humanoid)
    return Lessons.joined(lessons), lost


class _Bodies:
    """Bodies on pieces of motion; each takes the next piece when it is through with one or lost."""

    def __init__(
        self,
        motion: TeachersMotion,
        pieces: list[tuple[int, int, int]],
        settings: TeacherSettings,
        rng: np.random.Generator,
    ) -> None:
        count = settings.num_envs
        self._motion, self._waiting, self._settings, self._rng = motion, pieces[::-1], settings, rng
        self._at, self._end, self._seen = (np.zeros(count, dtype=np.int64) for _ in range(3))
        self._runs = np.zeros(count, dtype=bool)
        self.fresh = np.ones(count, dtype=bool)
        self.qpos, self.qvel = np.tile(motion.qpos[0], (count, 1)), np.tile(motion.qvel[0], (count, 1))
        self.plan: Nominal | None = None
        self.gains: Single = np.zeros(0, dtype=np.float32)

    def begin_those_that_wait(self) -> bool:
        """Put idle bodies at the next pieces; False where nothing runs any more."""
        rng, settings = self._rng, self._settings
        self.fresh[:] = False
        for body in np.flatnonzero(~self._runs)[: len(self._waiting)]:
            start, self._end[body], self._seen[body] = self._waiting.pop()
            self._at[body], self._runs[body], self.fresh[body] = start, True, True
            self.qpos[body], self.qvel[body] = self._motion.qpos[start], self._motion.qvel[start]
            self.qpos[body, 7:] += settings.start_joints * rng.normal(size=self.qpos.shape[1] - 7)
            self.qvel[body, 6:] += settings.start_rates * rng.normal(size=self.qvel.shape[1] - 6)
        return bool(self._runs.any())

    def frames(self, step: int) -> NDArray[np.int64]:
        """``[N]`` the frame each body should be in ``step`` frames after the plan."""
        return np.minimum(self._at + step, np.maximum(self._seen - 1, 0))

    def followed(self, humanoid: HumanoidModel) -> Followed:
        """What the bodies follow; behind the end of a take its last frame stands still."""
        settings, motion = self._settings, self._motion
        ahead = self._at[:, None] + np.arange(settings.horizon + 1)
        rows = np.minimum(ahead, np.maximum(self._seen - 1, 0)[:, None])
        qvel = np.where((ahead > rows)[..., None], 0.0, motion.qvel[rows])
        ctrl = feed_forward(humanoid, motion.qpos[rows], qvel, motion.torques[rows], settings.velocity)
        return Followed(motion.qpos[rows], qvel, ctrl)

    def lessons(self, step: int, ctrl: Array) -> Lessons:
        """Of the bodies that are not through yet."""
        rows = np.flatnonzero(self._runs & (self._at + step < self._end - 1))
        qpos, qvel, led = (part[rows].astype(np.float32) for part in (self.qpos, self.qvel, ctrl))
        gains = np.clip(self.gains[rows, step], -_LARGEST_GAIN, _LARGEST_GAIN)
        return Lessons(self._at[rows] + step, qpos, qvel, led, gains.astype(np.float16))

    def advance(self, humanoid: HumanoidModel) -> int:
        """A plan is through: stop bodies at their end and those that were lost; how many were."""
        settings = self._settings
        self._at += settings.every
        # Not below a bound, so that what is no number is broken too.
        broken = ~(np.abs(self.qvel).max(1) < _TOO_FAST)
        self.qpos[broken], self.qvel[broken] = self._motion.qpos[0], 0.0
        wanted = self._motion.heads[self.frames(0)]
        lost = self._runs & (broken | (head_heights(humanoid, self.qpos) < wanted - settings.lost))
        self._runs &= ~lost & (self._at < self._end - 1)
        return int(lost.sum())
