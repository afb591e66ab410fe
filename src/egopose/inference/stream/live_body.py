"""The humanoid of a live stream: policy, fail-safe and physics, one frame at a time.

It does what :func:`egopose.inference.estimator.estimate_takes` does over whole takes, with parts of the same
environment. But there are no tables over all frames: only the previous and the present frame are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.imitation import ImitationProblem
from egopose.envs.test_time import prepare_for_test
from egopose.envs.transforms import StateNormalizer, TrackingError
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.inference.causal import Seen
from egopose.inference.failsafe import FailSafe, FailSafeSettings
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
    """In the place of a policy's own :class:`EpisodeContext`: its causal form, a frame a call.

    Set :attr:`window` ``[W, D]`` to the features of the frame and its look-ahead before each call.
    """

    def __init__(self, context: BidirectionalContext) -> None:
        super().__init__()
        self.context = context
        self.window: Tensor | None = None
        self._state: LstmState | None = None

    def forward(self, episode_start: Tensor, frame: Tensor) -> Tensor:
        """``[1, output_size]``; the arguments, which say where a table would be read, do not matter."""
        assert self.window is not None
        out, self._state = self.context.causal_step(self.window[None], self._state)
        return out


class LiveBody:
    """One humanoid that follows what is seen.

    Args:
        env: one world over :class:`EgoPoseEnv` on a take of two frames, which stand for the present one and the next;
            falls do not end it, the transforms are as trained.
        actor, critic: of the run, on ``env``'s observations. Their contexts are made live: no use offline afterwards.
        failsafe: settings.
        lap: told ``policy`` and ``physics`` when each is done.

    Raises:
        InputError: the policy forecasts.
    """

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        failsafe: FailSafeSettings,
        lap: Callable[[str], None] = lambda stage: None,
    ) -> None:
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        if any(isinstance(module, PastContext) for module in actor.modules()):
            raise InputError("checkpoint", "model.context.source", "past: a forecasting policy cannot estimate")
        prepare_for_test(env, actor, critic)
        assert isinstance(base.problem, ImitationProblem)  # a live body follows what the regressor sees
        self._base, self._problem, self._physics = base, base.problem, base.physics
        self._actor, self._critic = actor, critic
        self._transforms = [t for t in env.transform if isinstance(t, TrackingError | StateNormalizer)]
        self._contexts = [live for network in (actor, critic) for live in _make_live(network)]
        self.guard = FailSafe(1, failsafe)
        self._lap = lap
        self._world, self._reached = torch.tensor([0]), torch.tensor([1])
        self._before: Seen | None = None

    @torch.no_grad()
    def advance(self, seen: Seen) -> LivePose:
        """To the frame that was just seen.

        The first call places the body at the origin, heading along x.
        """
        before, self._before = self._before, seen
        if before is None:
            origin = np.zeros((1, self._physics.model.nq))
            origin[0, 3] = 1.0
            self._place(seen, origin)
            self._lap("physics")
            return LivePose(seen.frame, self._physics.qpos[0].copy(), None, None, False)
        body = self._physics.body_state()
        observation = self._observe(before, seen)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            observation = self._critic(self._actor(observation))
        head = torch.from_numpy(body["xpos"][:, self._problem.humanoid.head, 2])
        active = torch.ones(1, dtype=torch.bool)
        value = observation["state_value"].squeeze(-1)
        triggered = bool(self.guard.update(value, head, active))
        # The guard keeps what it is told for a report; here that would grow for ever.
        confidence = self.guard.confidence.pop()
        if self._problem.action.reference == "regressor":
            self._problem.read_actions_from(torch.stack([before.joint_targets, seen.joint_targets]))
        target = self._problem.target(observation["action"], self._reached)
        self._lap("policy")
        diverged = bool(self._physics.step(target.numpy())[0])
        if reset := triggered or diverged:
            self._place(seen, body["qpos"])
        pose = LivePose(seen.frame, self._physics.qpos[0].copy(), float(value), float(confidence), reset)
        self._lap("physics")
        return pose

    def state(self) -> tuple[Array, Array]:
        """``qpos [nq]`` and ``qvel [nv]`` at the frame :meth:`advance` reached; views, which its next call changes."""
        return self._physics.qpos[0], self._physics.qvel[0]

    def _observe(self, now: Seen, ahead: Seen) -> TensorDictBase:
        """The observation ``[1]`` at ``now``, as the environment makes it from its tables."""
        for live in self._contexts:
            live.window = now.window
        state = {"qpos": torch.from_numpy(self._physics.qpos), "qvel": torch.from_numpy(self._physics.qvel)}
        index = torch.zeros(1, 1, dtype=torch.int64)
        observation: TensorDictBase = TensorDict(
            {
                "humanoid_state": self._problem.observation(state).float(),
                "visual_context": now.visual_context[None],
                "frame": index,
                "episode_start": index,
            },
            batch_size=[1],
        )
        for transform in self._transforms:
            if isinstance(transform, TrackingError):
                transform.table = torch.stack([now.humanoid_state, ahead.humanoid_state])
                transform.following = torch.tensor([1, 1])
            observation = transform.forward(observation)
        return observation

    def _place(self, seen: Seen, where: Array) -> None:
        """Into the regressor's state, standing and facing as ``where [1, nq]``, feet out of the floor."""
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
