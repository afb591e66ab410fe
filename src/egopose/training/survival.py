"""How long the humanoid keeps up with the reference before it falls: what PPO must improve first."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.envs.env import EgoPoseEnv
from egopose.envs.imitation import ImitationProblem
from egopose.envs.test_time import Controller, prepare_for_test


@dataclass(frozen=True)
class Survival:
    """``frames [N]`` reached by each world before it fell or its episode ended, and which ``fell [N]``."""

    frames: Tensor
    fell: Tensor

    @property
    def mean(self) -> float:
        """Mean number of frames survived."""
        return float(self.frames.double().mean())


@torch.no_grad()
def frames_survived(env: TransformedEnv, controller: Controller, seed: int) -> Survival:
    """One episode a world from uniform starts on the reference, with the environment's own fall and horizon.

    The same environment and seed give every controller the same starts, so figures compare.

    Args:
        env: over :class:`EgoPoseEnv` with uniform starts and falls that end the episode.
        controller: writes ``action`` into an observation: an actor (its mean action is taken), or
            :func:`reference_tracking`.
        seed: of the starts.
    """
    prepare_for_test(env, controller)
    env.set_seed(seed)
    observation = env.reset()
    frames = torch.zeros(env.batch_size[0], dtype=torch.int64)
    running, fell = torch.ones_like(frames, dtype=torch.bool), torch.zeros_like(frames, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            after = env.step(controller(observation))["next"]
            terminated = after["terminated"].squeeze(-1)
            frames += running & ~terminated
            fell |= running & terminated
            running &= ~after["done"].squeeze(-1)
            observation = after.exclude("reward", "action")
    return Survival(frames, fell)


def reference_tracking(env: TransformedEnv) -> Controller:
    """Open-loop PD towards the reference's own joint angles of the next frame: no policy, but the true motion known."""
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    problem = base.problem
    assert isinstance(problem, ImitationProblem)

    def track(observation: TensorDictBase) -> TensorDictBase:
        frame = torch.minimum(observation["frame"] + 1, observation["episode_stop"] - 1).squeeze(-1)
        return observation.set("action", action_towards(problem, frame, base.placed))

    return track


def base_tracking(env: TransformedEnv) -> Controller:
    """Open-loop PD towards what actions are added to (the regressor's pose, or the rest pose): the zero action."""
    size = env.action_spec.shape

    def track(observation: TensorDictBase) -> TensorDictBase:
        return observation.set("action", torch.zeros(size))

    return track


def action_towards(problem: ImitationProblem, frame: Tensor, placed: Tensor | None = None) -> Tensor:
    """The action ``[N, nu]`` whose PD target is the reference's joint angles at global frames ``[N]``.

    ``placed``: see :meth:`ImitationProblem.target`.
    """
    nothing = torch.zeros(len(frame), problem.humanoid.mj_model.nu)
    wanted = problem.reference_at(frame)["qpos"][:, 7:]
    return ((wanted - problem.target(nothing, frame, placed)) / problem.action.scale).float()
