"""A reconstruction's policy over its whole clip: the mean action from the first frame on, and the motion it makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.rotations import yaw
from egopose.envs.reconstruction import ReconstructionProblem
from egopose.envs.starts import Piece
from egopose.envs.test_time import Controller, prepare_for_test
from egopose.motion.rotations import Array
from egopose.scene.simulated import SimulatedMotion


@dataclass(frozen=True)
class ClipRollout:
    """What a policy made of a clip.

    Args:
        motion: states, controls and boxes; its first frame is ``first`` of the clip.
        first: see ``motion``.
        rewards: ``[T - 1]`` of each step.
        terms: each term ``[T - 1]``.
        ended: frames of the motion from which on each ending would have ended the episode; None where it never would.
        touched: ``[T - 1, 4, 1 + K]`` what the end effectors touched after each step.
    """

    motion: SimulatedMotion
    first: int
    rewards: Array
    terms: Mapping[str, Array]
    ended: Mapping[str, int | None]
    touched: NDArray[np.bool_]

    @property
    def survived(self) -> int:
        """Frames until the first ending, the first frame included."""
        return min([frame for frame in self.ended.values() if frame is not None], default=len(self.motion))


@torch.no_grad()
def roll_out(
    env: TransformedEnv, actor: Controller, piece: Piece, state: tuple[Array, Array] | None = None
) -> ClipRollout:
    """One world from the first frame of ``piece`` to its last.

    Args:
        env: of one world, whose endings end nothing; its boxes are those of the first states.
        actor: its mean action is taken.
        piece: of the clip.
        state: ``[nq]`` and ``[nv]`` to begin in; None for the episode's own first state.
    """
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    problem, physics = base.problem, base.physics
    assert isinstance(problem, ReconstructionProblem)
    problem.varies = torch.zeros_like(problem.varies)
    prepare_for_test(env, actor)
    observation = env.reset()
    if state is not None:
        base.place(torch.tensor([0]), *(torch.from_numpy(part[None]) for part in state))
        observation.update(env.transform(base.observe()))
    qpos, qvel, ctrl = [physics.qpos[0].copy()], [physics.qvel[0].copy()], []
    rewards, touched = [], []
    terms: dict[str, list[float]] = {name: [] for name in problem.reward.names}
    ended: dict[str, int | None] = dict.fromkeys((*problem.endings, "diverged"))
    tops = physics.box_tops[0].copy()
    headings = yaw(torch.from_numpy(physics.box_quaternions[0].copy())).numpy()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for t in range(piece.start + 1, piece.stop):
            acted = actor(observation)
            ctrl.append(problem.target(acted["action"], torch.tensor([t]))[0].numpy())
            after = env.step(acted)["next"]
            qpos.append(physics.qpos[0].copy())
            qvel.append(physics.qvel[0].copy())
            rewards.append(float(after["reward"]))
            for name in terms:
                terms[name].append(float(after["reward_terms", name]))
            for name in ended:
                if ended[name] is None and bool(after[name]):
                    ended[name] = t - piece.start
            touched.append(_touched(problem, base))
            observation = after.exclude("reward", "action")
    motion = SimulatedMotion(np.stack(qpos), np.stack(qvel), np.stack(ctrl), tops, headings)
    figures = {name: np.array(values) for name, values in terms.items()}
    return ClipRollout(motion, piece.start, np.array(rewards), figures, ended, np.stack(touched))


def _touched(problem: ReconstructionProblem, base: EgoPoseEnv) -> NDArray[np.bool_]:
    bodies = problem.touching.bodies.numpy()
    floor, boxes = base.physics.floor_contacts[0, bodies], base.physics.box_contacts[0, bodies]
    return np.concatenate([floor[:, None], boxes], axis=1)


def joined(rollouts: Sequence[ClipRollout]) -> ClipRollout:
    """Rollouts each of which begins in the state that the one before ends in, as one."""
    first, motions = rollouts[0].first, [one.motion for one in rollouts]
    later = motions[1:]
    motion = SimulatedMotion(
        np.concatenate([motions[0].qpos, *(one.qpos[1:] for one in later)]),
        np.concatenate([motions[0].qvel, *(one.qvel[1:] for one in later)]),
        np.concatenate([one.ctrl for one in motions]),
        motions[0].box_tops,
        motions[0].box_headings,
    )
    ended: dict[str, int | None] = {}
    for name in rollouts[0].ended:
        frames = [at + one.first - first for one in rollouts if (at := one.ended[name]) is not None]
        ended[name] = min(frames, default=None)
    terms = {name: np.concatenate([one.terms[name] for one in rollouts]) for name in rollouts[0].terms}
    rewards, touched = (np.concatenate([getattr(one, name) for one in rollouts]) for name in ("rewards", "touched"))
    return ClipRollout(motion, first, rewards, terms, ended, touched)


def after(rollout: ClipRollout, before: SimulatedMotion) -> SimulatedMotion:
    """The motion of the rollout, and until it begins that of ``before``, whose states it begins in."""
    first, motion = rollout.first, rollout.motion
    return SimulatedMotion(
        np.concatenate([before.qpos[:first], motion.qpos]),
        np.concatenate([before.qvel[:first], motion.qvel]),
        np.concatenate([before.ctrl[:first], motion.ctrl]),
        motion.box_tops,
        motion.box_headings,
    )


def until(motion: SimulatedMotion, frames: int) -> SimulatedMotion:
    """The first ``frames`` of a motion, at least two."""
    last = max(2, frames)
    return SimulatedMotion(
        motion.qpos[:last], motion.qvel[:last], motion.ctrl[: last - 1], motion.box_tops, motion.box_headings
    )
