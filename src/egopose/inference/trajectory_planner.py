"""Looking ahead by iterative LQR: the policy's own future, improved by what the simulator says of every control.

The policy acts in the simulator for some frames. About that future a step is linear and the distance from the target
motion quadratic, so a backward pass (:mod:`egopose.humanoid.trajectory`) gives better controls, and gains that hold the
body to them until the next plan (Tassa, Erez & Todorov 2012). Random shooting (:mod:`egopose.inference.planner`) tries
candidates instead. The target motion is the regressor's or a forecast; the true motion plays no part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.collection.stepping import Entries, parts_of, run_parts
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.imitation import ImitationProblem
from egopose.envs.problem import Followed
from egopose.humanoid.derivatives import Simulator, Single, state_difference
from egopose.humanoid.physics import PER_WORLD
from egopose.humanoid.trajectory import Followed as FollowedFrames
from egopose.humanoid.trajectory import Nominal, TrackingCost, TrajectoryOptimiser
from egopose.inference.followed_path import FollowedPath
from egopose.models.pose_regression import state_to_qpos

_EPISODE = ("take", "start", "stop", "frame")
_ROWS = ("placed", "laid", *(f"physics.{name}" for name in PER_WORLD))
_VELOCITIES, _HINGES = 58, 52  # of the humanoid
_SIMULATED = 512  # worlds that are stepped together


@dataclass(frozen=True)
class TrajectoryPlannerSettings:
    """``conf/planner/trajectory.yaml``, which gives every value and its source.

    Args:
        horizon: frames ahead.
        every: frames between plans.
        reach: rad that a control may differ from the policy's.
        steps: shares of the controls' changes that the line search tries.
        cost: see :class:`~egopose.humanoid.trajectory.TrackingCost`; controls are compared with the policy's.
        lost: m; the value is 0 while the head is further than this below its target, so a fallen body is reset.
        place_time, heading_time: s, see :class:`~egopose.inference.followed_path.FollowedPath`.
        reset_threshold: of the fail-safe; None for the paper's at the run's discount.
    """

    horizon: int
    every: int
    reach: float
    steps: tuple[float, ...]
    cost: TrackingCost
    lost: float
    place_time: float
    heading_time: float
    reset_threshold: float | None

    def __post_init__(self) -> None:
        if not 0 < self.every <= self.horizon:
            raise InputError("planner", "every", "must lie between 1 and the horizon")
        for name in ("reach", "lost", "place_time", "heading_time"):
            if not getattr(self, name) > 0:
                raise InputError("planner", name, "must be positive")

    @property
    def samples(self) -> int:
        """Copies of each body that its planner simulates with the policy."""
        return 1

    @property
    def control_steps(self) -> float:
        """Simulated for a frame of each body: two nominal futures, the derivatives of one, and the line search."""
        derivatives = 2 * _VELOCITIES + _HINGES
        return (2 + derivatives + len(self.steps)) * self.horizon / self.every

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> TrajectoryPlannerSettings:
        """Raises InputError: a value is missing, unknown or wrong."""
        cost = from_mapping(TrackingCost, values["cost"], "conf/planner: cost")
        return from_mapping(cls, {**values, "cost": cost}, "conf/planner")


class TrajectoryPlanner:
    """Plans for N bodies side by side.

    Args:
        env: N environments like those that are planned for. A fall does not end an episode, and the normaliser is
            frozen.
        actor, critic: policy and value network, in evaluation mode; sequences of modules that read and write plain
            entries.
        settings: see :class:`TrajectoryPlannerSettings`.
        followed: the target motion; None for the problem's own.

    Attributes:
        path: the target motion's in the worlds of the bodies.
        value: ``[N]`` V of the present state; 0 while the head is more than ``lost`` below its target.

    Raises:
        InputError: actions are torques, or the target motion has no path.
    """

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        settings: TrajectoryPlannerSettings,
        followed: Followed | None = None,
    ) -> None:
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        problem, humanoid = base.problem, base.problem.humanoid
        if not problem.actions_move_targets:
            raise InputError("planner", "action", "a planner moves targets of PD controllers, not torques")
        assert isinstance(problem, ImitationProblem)
        self._scale = problem.action.scale
        gaussian = isinstance(actor, ProbabilisticTensorDictSequential)
        self._actor = [part for step in (actor.module[:-1] if gaussian else [actor]) for part in parts_of(step)]
        self._action, self._critic = "loc" if gaussian else "action", parts_of(critic)
        self.settings, self._env, self._base = settings, env, base
        self._states, self._row, path = problem.followed() if followed is None else followed
        if path is None:
            raise InputError("planner", "path", "the target motion has no path: planner=ahead")
        self.path = FollowedPath(path, humanoid.control_dt, settings.place_time, settings.heading_time)
        self._simulator = Simulator(humanoid, _SIMULATED, base.physics.threads)
        self._optimiser = TrajectoryOptimiser(self._simulator, settings.cost, settings.steps, settings.reach)
        env.reset()
        count, model = base.batch_size[0], humanoid.mj_model
        self._heads = self._head_heights()
        self._plan: Nominal | None = None
        self._gains: Single = np.zeros((count, settings.horizon, model.nu, 2 * model.nv), dtype=np.float32)
        self._forgotten = np.zeros(count, dtype=bool)
        self._age = 0
        self.value = torch.zeros(count)

    def _head_heights(self) -> Tensor:
        """``[R]`` m of the target motion."""
        problem, count = self._base.problem, self._base.batch_size[0]
        heights = []
        for rows in self._states.split(count):
            qpos, qvel = self._placed(rows, torch.zeros(len(rows), 2), torch.zeros(len(rows)))
            self._base.place(torch.arange(len(rows)), torch.from_numpy(qpos), torch.from_numpy(qvel))
            heights.append(torch.as_tensor(self._base.body_state()["xpos"])[: len(rows), problem.humanoid.head, 2])
        return torch.cat(heights)

    def _placed(self, states: Tensor, place: Tensor, heading: Tensor) -> tuple[Any, Any]:
        """``qpos``, ``qvel`` of target ``states [n, S]`` at ``place [n, 2]`` and ``heading [n]``."""
        facing = torch.zeros(len(states), 4, dtype=torch.float64)
        facing[:, 0], facing[:, 3] = torch.cos(0.5 * heading), torch.sin(0.5 * heading)
        joint_range = self._base.problem.humanoid.joint_range
        return state_to_qpos(states.double().numpy(), place.numpy(), facing.numpy(), joint_range)

    def perturbation(self, base: EgoPoseEnv) -> Tensor:
        """``[N, nu]`` to add to the policy's mean action in the present state of ``base`` (N environments)."""
        row = self._row(base.observe())
        self.path.advance(row, base.body_state()["qpos"])
        step = self._age % self.settings.every
        now = base.state_dict()
        seen = self._begin(now)
        if step == 0 or self._forgotten.any():
            self._look_ahead(base, seen)
            self._age, step = 0, 0
        assert self._plan is not None
        self._age += 1
        run_parts(self._actor, seen)
        run_parts(self._critic, seen)
        head = torch.as_tensor(base.body_state()["xpos"])[:, base.problem.humanoid.head, 2]
        low = self._heads[row] - head > self.settings.lost
        self.value = torch.where(low, 0.0, seen["state_value"].squeeze(-1))
        away = state_difference(
            base.physics.qpos, base.physics.qvel, self._plan.qpos[:, step], self._plan.qvel[:, step]
        )
        wanted = self._plan.ctrl[:, step] + np.einsum("nij,nj->ni", self._gains[:, step], away)
        policy = self._controls(base, seen[self._action])
        wanted = np.clip(wanted, policy - self.settings.reach, policy + self.settings.reach)
        return torch.from_numpy((wanted - policy) / self._scale).float()

    def forget(self, worlds: Tensor) -> None:
        """``worlds [n]`` were placed elsewhere: all bodies plan anew."""
        self._forgotten[worlds.numpy()] = True

    def _begin(self, state: Mapping[str, Tensor]) -> Entries:
        """Put the copies into the bodies' state; what they see."""
        own = self._base.state_dict()
        own |= {name: state[name] for name in (*_EPISODE, *_ROWS) if name in state}
        self._base.load_state_dict(own)
        return Entries(self._env.transform(self._base.observe()).items())

    @staticmethod
    def _controls(base: EgoPoseEnv, action: Tensor) -> Any:
        """PD targets ``[N, nu]`` rad of ``action`` in the present frame."""
        frame = torch.minimum(base.frame + 1, torch.as_tensor(base.state_dict()["stop"]) - 1)
        return base.problem.target(action, frame, base.placed).numpy()

    @torch.no_grad()
    def _look_ahead(self, base: EgoPoseEnv, seen: Entries) -> None:
        settings, copies = self.settings, self._base
        start = copies.physics.qpos.copy(), copies.physics.qvel.copy()
        now = copies.state_dict()
        qpos, qvel, ctrl, rows = [start[0]], [start[1]], [], [self._row(seen)]
        for _ in range(settings.horizon):
            run_parts(self._actor, seen)
            ctrl.append(self._controls(copies, seen[self._action]))
            after = copies.try_step(seen[self._action])
            rows.append(self._row(after))
            qpos.append(copies.physics.qpos.copy())
            qvel.append(copies.physics.qvel.copy())
            seen = self._env.transform._step(seen, Entries(after))
        copies.load_state_dict(now)
        targets = [self._placed(self._states[row], *self.path.at(row)) for row in rows]
        followed = FollowedFrames(
            np.stack([target[0] for target in targets], 1),
            np.stack([target[1] for target in targets], 1),
            np.stack(ctrl, 1),
        )
        policy = Nominal(np.stack(qpos, 1), np.stack(qvel, 1), followed.ctrl, np.zeros(len(start[0])))
        policy = Nominal(policy.qpos, policy.qvel, policy.ctrl, self._cost(policy, followed))
        nominal = policy
        if self._plan is not None:
            kept = self._continued(start, followed)
            kept.cost[self._forgotten] = np.inf
            nominal = policy.chosen(kept)
        self._forgotten[:] = False
        self._plan, self._gains = self._optimiser.improve(nominal, followed)

    def _continued(self, start: tuple[Any, Any], followed: FollowedFrames) -> Nominal:
        """The last plan from the present state on, with its gains; behind its end the policy's controls."""
        assert self._plan is not None
        by = self.settings.every
        kept = self._plan.ctrl.shape[1] - by
        older = Nominal(
            np.concatenate([self._plan.qpos[:, by:-1], followed.qpos[:, kept:]], axis=1),
            np.concatenate([self._plan.qvel[:, by:-1], followed.qvel[:, kept:]], axis=1),
            np.concatenate([self._plan.ctrl[:, by:], followed.ctrl[:, kept:]], axis=1),
            self._plan.cost,
        )
        gains = np.concatenate([self._gains[:, by:], 0 * self._gains[:, :by]], axis=1)
        return self._optimiser.simulate(*start, followed, older, gains=gains)

    def _cost(self, nominal: Nominal, followed: FollowedFrames) -> Any:
        """``[N]`` of a trajectory that was simulated elsewhere."""
        cost = self.settings.cost
        wrong = state_difference(nominal.qpos, nominal.qvel, followed.qpos, followed.qvel)
        each = (cost.weights(nominal.qvel.shape[-1]) * wrong**2).sum(-1)
        control = cost.control * ((nominal.ctrl - followed.ctrl) ** 2).sum((1, 2))
        return each[:, :-1].sum(1) + cost.last * each[:, -1] + control

    def close(self) -> None:
        """Stop the copies' physics."""
        self._simulator.close()
        self._env.close()
