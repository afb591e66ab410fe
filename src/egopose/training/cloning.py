"""A tracker learns what its teacher would do (:mod:`egopose.training.teacher`), before PPO takes over.

Each lesson is seen many times: with other errors in the target motion, mirrored, and in states near its own, where the
teacher's gains tell the control. So the gains are targets for the policy's derivative.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from egopose.envs.imitation import ImitationProblem
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.target_window import Rows, target_window
from egopose.humanoid.derivatives import Single, moved
from egopose.models.mirror import joint_mirror
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.training.teacher import Lessons


@dataclass(frozen=True)
class CloningSettings:
    """See ``conf/tracker.yaml``.

    Args:
        seconds: of learning, a round.
        batch: lessons a step.
        learning_rate, weight_decay: AdamW, with a linear warm-up and a fall to nothing.
        truth: share of the lessons in which the target motion has no error.
        nearby: share of the lessons that are moved.
        place, turn, joints: m, rad and rad, standard deviations of the largest moves.
        linear, angular, joint_rates: m/s, rad/s and rad/s, likewise.
        largest_change: rad, of the control by a move.
        largest_action: rad.
    """

    seconds: float
    batch: int
    learning_rate: float
    weight_decay: float
    truth: float
    nearby: float
    place: float
    turn: float
    joints: float
    linear: float
    angular: float
    joint_rates: float
    largest_change: float
    largest_action: float

    def deviations(self, nv: int) -> Array:
        """``[2 nv]`` of moves."""
        position = [*[self.place] * 3, *[self.turn] * 3, *[self.joints] * (nv - 6)]
        return np.array([*position, *[self.linear] * 3, *[self.angular] * 3, *[self.joint_rates] * (nv - 6)])


class LessonReader:
    """Batches of what the policy sees and what it should do.

    Args:
        lessons: their frames are those of the clips' first copies; None to use :meth:`seen` alone.
        problem: whose actions move targets.
        states, path, last: ``[F, S]``, ``[F, 3]``, ``[F]`` of all copies, see :class:`TargetWindow`.
        ahead: frames ahead.
        copies: of every clip on either side: the first without an error.
        mirror: whether as many mirror images follow.
        settings: see :class:`CloningSettings`.
        seed: of all draws.
    """

    def __init__(
        self,
        lessons: Lessons | None,
        problem: ImitationProblem,
        states: Tensor,
        path: Tensor,
        last: Tensor,
        ahead: tuple[int, ...],
        copies: int,
        mirror: bool,
        settings: CloningSettings,
        seed: int,
    ) -> None:
        self._lessons, self._problem, self._settings = lessons, problem, settings
        self._states, self._path, self._last = states.numpy(), path.numpy(), last.numpy()
        self._ahead, self._copies, self._mirror = np.array(ahead), copies, mirror
        # Half precision is for the disk: to convert it at every draw takes longer than all else.
        self._gains = np.zeros(0, dtype=np.float32) if lessons is None else lessons.gains.astype(np.float32)
        self._frames = len(self._last) // (copies * (1 + mirror))
        self._rng = np.random.default_rng(seed)
        index, sign = joint_mirror(problem.humanoid.skeleton)
        self._joints, self._signs = index, sign
        self._rates = np.concatenate([np.arange(6), 6 + index])
        self._rate_signs = np.concatenate([[1.0, -1.0, 1.0, -1.0, 1.0, -1.0], sign])
        self._deviations = settings.deviations(problem.humanoid.mj_model.nv)

    def draw(self, count: int) -> tuple[Array, Rows, Array]:
        """Humanoid states ``[n, S]``, windows ``[n, W]`` and actions ``[n, nu]``."""
        rng, lessons, settings = self._rng, self._lessons, self._settings
        assert lessons is not None
        rows = rng.integers(0, len(lessons), count)
        qpos, qvel, ctrl = (part[rows].astype(np.float64) for part in (lessons.qpos, lessons.qvel, lessons.ctrl))
        nv = qvel.shape[1]
        size = rng.random((count, 1)) * (rng.random((count, 1)) < settings.nearby)
        move = size * self._deviations * rng.normal(size=(count, 2 * nv))
        change = _times(self._gains, rows, move.astype(np.float32))
        ctrl += np.clip(change, -settings.largest_change, settings.largest_change)
        qpos, qvel = moved(qpos, move[:, :nv]), qvel + move[:, nv:]
        side = np.zeros(count, dtype=np.int64)
        if self._mirror:
            side = rng.integers(0, 2, count)
            flipped = side == 1
            qpos[flipped, :7] *= np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
            qpos[flipped, 7:] = self._signs * qpos[flipped, 7:][:, self._joints]
            qvel[flipped] = self._rate_signs * qvel[flipped][:, self._rates]
            ctrl[flipped] = self._signs * ctrl[flipped][:, self._joints]
        copy = np.where(rng.random(count) < settings.truth, 0, rng.integers(0, self._copies, count))
        frame = lessons.frame[rows] + self._frames * (copy + self._copies * side)
        state, window = self.seen(frame, qpos, qvel)
        base = self._problem.target(torch.zeros(count, ctrl.shape[1]), torch.from_numpy(self.next(frame))).numpy()
        action = (ctrl - base) / self._problem.action.scale
        return state, window, np.clip(action, -settings.largest_action, settings.largest_action)

    def next(self, frame: np.ndarray) -> np.ndarray:
        """``[n]`` the frame after each, within its take."""
        return np.minimum(frame + 1, self._last[frame])

    def seen(self, frame: np.ndarray, qpos: Array, qvel: Array) -> tuple[Array, Rows]:
        """Humanoid states and windows of bodies at ``frame [n]``; the path lies where the reference does."""
        state = humanoid_state_rows(qpos, qvel)
        root = np.column_stack([qpos[:, :2], rot.yaw(qpos[:, 3:7])])
        rows = np.minimum(frame[:, None] + self._ahead, self._last[frame][:, None])
        return state, target_window(state, root, self._states[rows], self._path[rows])


def _times(gains: np.ndarray, rows: np.ndarray, move: Single) -> Single:
    """``gains[rows] [n, nu, 2 nv]`` times ``move [n, 2 nv]``, some at a time: whole they fill no cache."""
    parts = range(0, len(rows), _AT_ONCE)
    return np.concatenate(
        [
            (gains[rows[at : at + _AT_ONCE]].astype(np.float32) @ move[at : at + _AT_ONCE, :, None])[..., 0]
            for at in parts
        ]
    )


def clone(
    network: nn.Module,
    normalise: Callable[[Tensor], Tensor],
    reader: LessonReader,
    settings: CloningSettings,
    progress: Callable[[int, float, float], None],
) -> float:
    """Teach ``network(state, window) -> action``; the mean squared error of the last steps, rad^2.

    Args:
        network: the policy's mean.
        normalise: of states, as the policy's environment does.
        reader: of lessons.
        settings: see :class:`CloningSettings`.
        progress: told steps, root mean squared error (rad) and seconds, now and then.
    """
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    began, step, total, error = time.monotonic(), 0, 0.0, float("nan")
    while (share := (time.monotonic() - began) / settings.seconds) < 1.0:
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * min(1.0, (step + 1) / _WARM_UP) * (1.0 - share)
        state, window, action = (torch.from_numpy(part).float() for part in reader.draw(settings.batch))
        loss = (network(normalise(state), window) - action).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        step, total = step + 1, total + loss.item()
        if step % _TOLD_EVERY == 0:
            error, total = total / _TOLD_EVERY, 0.0
            progress(step, error**0.5, time.monotonic() - began)
    left = step % _TOLD_EVERY
    return total / left if left else error


_WARM_UP, _TOLD_EVERY = 200, 500  # steps
_AT_ONCE = 64  # lessons whose gains are multiplied together
