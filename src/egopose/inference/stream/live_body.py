"""The humanoid of a live stream: policy, fail-safe and physics, one frame at a time.

It does what :func:`egopose.inference.estimator.estimate_takes` does over whole takes, with parts of the same
environment. But there are no tables over all frames: they hold the frame that the body is at and the known ones after
it, and are written anew at each frame. A planner looks ahead through them as long as there is time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.forecasting_transforms import RecurrentStates
from egopose.envs.imitation import ImitationProblem
from egopose.envs.test_time import prepare_for_test
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.inference.acting import acting
from egopose.inference.causal import Seen
from egopose.inference.failsafe import FailSafe, FailSafeSettings
from egopose.inference.planner import Planner
from egopose.inference.stream.live_rows import LiveRows
from egopose.models.context import BidirectionalContext, LstmState
from egopose.models.episode_context import EpisodeContext
from egopose.models.pose_regression import state_to_qpos
from egopose.models.recurrent import PastContext
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class LivePose:
    """The humanoid at one control frame.

    Attributes:
        frame: control frames since the stream's start.
        qpos: ``[nq]``.
        value: V of the state at the frame before, from which the step here was decided; None at the first frame.
        confidence: that value over its running mean, see :class:`FailSafe`.
        reset: placed where the regressor sees it, because the fail-safe triggered or the physics broke.
    """

    frame: int
    qpos: Array
    value: float | None
    confidence: float | None
    reset: bool


class LiveContext(nn.Module):
    """In the place of a policy's own :class:`EpisodeContext`: its causal form, told of a frame at a time."""

    def __init__(self, context: BidirectionalContext) -> None:
        super().__init__()
        self.context = context
        self._table: Tensor | None = None
        self._state: LstmState | None = None

    def see(self, window: Tensor, later: bool) -> None:
        """``window [W, D]``: the features of the present frame and its look-ahead.

        With ``later`` the frames of the look-ahead get contexts as well, as they look now.
        """
        if later:
            contexts, self._state = self.context.causal_window(window[None], self._state)
            self._table = contexts[0]
        else:
            self._table, self._state = self.context.causal_step(window[None], self._state)

    def forward(self, episode_start: Tensor, frame: Tensor) -> Tensor:
        """``[N, output_size]`` of rows ``frame [N, 1]``, 0 the present one; behind the last, that one's."""
        assert self._table is not None
        return self._table.index_select(0, frame.flatten().clamp(max=len(self._table) - 1))


class LiveBody:
    """One humanoid that follows what is seen.

    Args:
        env: one world over :class:`EgoPoseEnv` on a take of :data:`egopose.inference.stream.build.ROWS` frames, which
            stand for the present one and those after it; falls do not end it, the transforms are as trained.
        actor, critic: of the run, on ``env``'s observations. Their contexts are made live: no use offline afterwards.
        failsafe: settings.
        lap: told ``policy``, ``planner`` and ``physics`` when each is done.
        planner: of this body, with ``copies`` of its environment; None for the policy alone.
        copies: the planner's environment.
        clock: s, by which a planner knows that its time is up.

    Raises:
        InputError: the policy forecasts, or it has a memory.
    """

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        failsafe: FailSafeSettings,
        lap: Callable[[str], None] = lambda stage: None,
        planner: Planner | None = None,
        copies: TransformedEnv | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        if any(isinstance(module, PastContext) for module in actor.modules()):
            raise InputError("checkpoint", "model.context.source", "past: a forecasting policy cannot estimate")
        if any(isinstance(part, RecurrentStates) for part in env.transform):
            raise InputError("checkpoint", "model.memory", "a live body's policy has none: name a run without")
        prepare_for_test(env, actor, critic)
        env.reset()
        assert isinstance(base.problem, ImitationProblem)  # a live body follows what the regressor sees
        self._base, self._problem, self._physics = base, base.problem, base.physics
        self._planner, self._envs = planner, [env] if copies is None else [env, copies]
        self._acts = acting(env, actor, critic)
        self._contexts = [live for network in (actor, critic) for live in _make_live(network)]
        self.guard = FailSafe(1, failsafe)
        self._lap = lap
        self._world, self._reached = torch.tensor([0]), torch.tensor([1])
        self._before: Seen | None = None
        self._root = None if base.problem.motion_seen is None else torch.zeros(3, dtype=torch.float64)
        self._deadline = math.inf
        if planner is not None:
            planner.late = lambda: clock() >= self._deadline

    @torch.no_grad()
    def advance(self, seen: Seen, deadline: float = math.inf) -> LivePose:
        """To the frame that was just seen.

        The first call places the body at the origin, heading along x.

        Args:
            seen: the frame after the last one.
            deadline: of the clock, at which the planner must stop.
        """
        before, self._before = self._before, seen
        if before is None:
            origin = np.zeros((1, self._physics.model.nq))
            origin[0, 3] = 1.0
            self._place(seen, origin)
            self._lap("physics")
            return LivePose(seen.frame, self._physics.qpos[0].copy(), None, None, False)
        body = self._physics.body_state()
        rows = self._write(before, seen)
        for live in self._contexts:
            live.see(before.window, self._planner is not None)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            observation = self._acts.act(self._acts.observed())
        action, value = observation["action"], observation["state_value"].squeeze(-1)
        self._lap("policy")
        if self._planner is not None:
            self._deadline = deadline
            self._planner.follow(rows.humanoid_state)
            action = action + self._planner.perturbation(self._base)
            value = self._planner.value
            self._lap("planner")
        head = torch.from_numpy(body["xpos"][:, self._problem.humanoid.head, 2])
        triggered = bool(self.guard.update(value, head, torch.ones(1, dtype=torch.bool)))
        # The guard keeps what it is told for a report; here that would grow for ever.
        confidence = self.guard.confidence.pop()
        target = self._problem.target(action, self._reached)
        diverged = bool(self._physics.step(target.numpy())[0])
        if rows.path is not None:
            self._root = rows.path[1]
        if reset := triggered or diverged:
            self._place(seen, body["qpos"])
            if self._planner is not None:
                self._planner.forget(self._world)
        pose = LivePose(seen.frame, self._physics.qpos[0].copy(), float(value), float(confidence), reset)
        self._lap("physics")
        return pose

    @property
    def plans(self) -> dict[str, int]:
        """``plans`` begun, ``plans_cut`` and ``plans_missed`` of them for want of time; zero without a planner."""
        names = ("plans", "plans_cut", "plans_missed")
        return {name: 0 if self._planner is None else getattr(self._planner, name) for name in names}

    def state(self) -> tuple[Array, Array]:
        """``qpos [nq]`` and ``qvel [nv]`` at the frame :meth:`advance` reached; views, which its next call changes."""
        return self._physics.qpos[0], self._physics.qvel[0]

    def _write(self, *frames: Seen) -> LiveRows:
        """Put what is known from the first of ``frames`` on into all tables."""
        rows = LiveRows.of(frames, self._problem.n_frames, self._root, self._problem.humanoid.control_dt)
        for env in self._envs:
            rows.write(env)
        return rows

    def _place(self, seen: Seen, where: Array) -> None:
        """Into the regressor's state, standing and facing as ``where [1, nq]``, feet out of the floor.

        A path that is followed is laid there.
        """
        self._write(seen)
        state, humanoid = seen.humanoid_state[None].numpy(), self._problem.humanoid
        qpos, qvel = state_to_qpos(state, where[:, :2], rot.heading(where[:, 3:7]), humanoid.joint_range)
        self._base.place(self._world, torch.from_numpy(out_of_floor(humanoid, qpos)), torch.from_numpy(qvel))


def _make_live(network: TensorDictModuleBase) -> list[LiveContext]:
    """Exchange each context of ``network`` that reads a table for its live form; those."""
    made = []
    for module in network.modules():
        # Of an earlier stream there is a live form already; a new one knows nothing of what that has seen.
        if isinstance(module, TensorDictModule) and isinstance(module.module, EpisodeContext | LiveContext):
            module.module = LiveContext(module.module.context)
            made.append(module.module)
    return made
