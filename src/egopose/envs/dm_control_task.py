"""The same problem as a dm_control task: one world, for the viewer, for debugging, for dm_control's own tools."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import dm_env
import mujoco
import numpy as np
import torch
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_env import specs
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from egopose.envs.mdp.path import lay, on_path, root_on_floor
from egopose.envs.mdp.step_view import StepView
from egopose.envs.problem import Problem
from egopose.envs.starts import Starts
from egopose.envs.target_motion import present_path


class HumanoidPhysics(dm_mujoco.Physics):
    """One world that steps as :class:`~egopose.humanoid.physics.BatchedPhysics` does.

    The constraint solver starts cold at every control step. A step that diverges does not raise: the world returns
    to its previous pose, at rest, and :attr:`diverged` is true.
    """

    diverged = False
    max_speed = 1e3

    def step(self, nstep: int = 1) -> None:
        data = self.data
        before, warnings = np.concatenate([data.qpos, data.qvel]), int(data.warning.number.sum())
        data.qacc_warmstart[:] = 0.0
        with self.suppress_physics_errors(), self.check_invalid_state():
            # Not dm_control's mj_step2 first: after a reset that would take over what was computed with actuation off.
            mujoco.mj_step(self.model.ptr, data.ptr, nstep)
            mujoco.mj_step1(self.model.ptr, data.ptr)
        self.diverged = not (
            int(data.warning.number.sum()) == warnings
            and np.isfinite(data.qpos).all()
            and (np.abs(data.qvel) < self.max_speed).all()
        )
        if self.diverged:
            data.qpos[:] = before[: len(data.qpos)] if np.isfinite(before).all() else self.model.qpos0
            data.qvel[:], data.ctrl[:] = 0.0, 0.0
            mujoco.mj_forward(self.model.ptr, data.ptr)


class EgoPoseTask(control.Task):
    """State, reward and termination of a task's problem for ``dm_control.rl.control.Environment``.

    Observations: the problem's (``humanoid_state [115]`` of imitation), float64, and ``frame [1]`` int64. The last time
    step has discount 0 after an ending or diverged physics and 1 at the end of the fragment or horizon.

    Args:
        problem: of a bare floor; watches the body alone.
        starts: deals episodes.
        seed: of the starts.

    Raises:
        ValueError: the problem watches contacts, torques, targets or boxes.
    """

    def __init__(self, problem: Problem, starts: Starts, seed: int = 0) -> None:
        if problem.watched:
            raise ValueError(f"one world of dm_control tells of the body alone, not of {', '.join(problem.watched)}")
        self.problem, self.starts = problem, starts
        self._generator = torch.Generator().manual_seed(seed)
        self._take, self._start, self._stop, self._frame = (torch.zeros(1, dtype=torch.int64) for _ in range(4))
        self._placed, self._laid = torch.zeros(0), torch.zeros(1, 3, dtype=torch.float64)
        self.reward_terms: dict[str, float] = {}

    def initialize_episode(self, physics: HumanoidPhysics) -> None:
        episode = self.starts(torch.zeros(1, dtype=torch.int64), self._generator)
        self._take, self._start, self._stop = episode.take, episode.start, episode.stop
        self._frame = episode.start
        qpos, qvel = self.problem.first_state(self._frame)
        physics.data.qpos[:], physics.data.qvel[:] = qpos[0].numpy(), qvel[0].numpy()
        self._placed = qpos[:, 7:]
        if (motion := self.problem.motion_seen) is not None:
            frame = self._frame[:, None]
            clock = {"frame": frame, "episode_start": frame, "episode_step": torch.zeros_like(frame)}
            self._laid = lay(present_path(motion, clock), root_on_floor(qpos))
        physics.diverged = False

    def before_step(self, action: NDArray[np.floating] | Tensor, physics: HumanoidPhysics) -> None:
        self._frame = torch.minimum(self._frame + 1, self._stop - 1)
        target = self.problem.target(torch.as_tensor(np.asarray(action))[None], self._frame, self._placed)
        physics.set_control(target[0].numpy())

    def action_spec(self, physics: HumanoidPhysics) -> specs.BoundedArray:
        # Whatever is added to a joint's target, half a turn is as far as it can matter.
        return specs.BoundedArray((physics.model.nu,), np.float64, -np.pi, np.pi, name="action")

    def get_observation(self, physics: HumanoidPhysics) -> OrderedDict[str, NDArray[Any]]:
        state = self._body_state(physics)
        seen = {key: value[0].numpy() for key, value in self.problem.observations(state, self._frame).items()}
        if self.problem.motion_seen is not None:
            seen["root_on_path"] = on_path(self._laid, root_on_floor(state["qpos"]))[0].numpy()
        return OrderedDict(**seen, frame=self._frame.numpy().copy())

    def get_reward(self, physics: HumanoidPhysics) -> float:
        reward, terms = self.problem.rewards(self._step_view(physics))
        self.reward_terms = {k: 0.0 if physics.diverged else float(v) for k, v in terms.items()}
        return 0.0 if physics.diverged else float(reward)

    def get_termination(self, physics: HumanoidPhysics) -> float | None:
        endings = self.problem.ended(self._step_view(physics), self._take)
        if physics.diverged or any(bool(endings[name]) for name in self.problem.ends_episode):
            return 0.0
        return 1.0 if bool(self._frame >= self._stop - 1) else None

    def _step_view(self, physics: HumanoidPhysics) -> StepView:
        return self.problem.step_view(self._body_state(physics), self._frame, self._frame - self._start)

    def _body_state(self, physics: HumanoidPhysics) -> TensorDict:
        # The step ends with mj_step1, so positions are those of the present qpos.
        data, ids = physics.data, self.problem.humanoid.body_ids
        mass = physics.model.body_mass[ids]
        arrays = {
            "qpos": data.qpos.copy(),
            "qvel": data.qvel.copy(),
            "xpos": data.xpos[ids],
            "xquat": data.xquat[ids],
            "com": mass @ data.xipos[ids] / mass.sum(),
        }
        return TensorDict({k: torch.from_numpy(np.asarray(v))[None] for k, v in arrays.items()}, batch_size=[1])


def load_environment(problem: Problem, starts: Starts, seed: int = 0) -> dm_env.Environment:
    """One world as a dm_env, ready for ``dm_control.viewer.launch`` or TorchRL's ``DMControlWrapper``."""
    # A copy: dm_control switches actuation off and on in the model while it resets.
    physics = HumanoidPhysics.from_model(wrapper.MjModel(copy.copy(problem.humanoid.mj_model)))
    return control.Environment(
        physics, EgoPoseTask(problem, starts, seed), n_sub_steps=problem.humanoid.substeps, legacy_step=True
    )
