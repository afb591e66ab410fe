"""What a live forecast goes by besides the body's state: the past seen, or a curve that begins where that ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from egopose.core.errors import InputError
from egopose.envs.reference_forecasts import TrackForecast
from egopose.models.recurrent import PastContext
from egopose.models.regressor import StateRegressor
from egopose.motion.rotations import Array


class Curves(Protocol):
    """From states seen ``[W, context, S]`` to a curve's coefficients ``[W, K, P]``."""

    context: int

    def __call__(self, pasts: Tensor) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class Beginning:
    """Where a forecast begins and what it goes by.

    Attributes:
        qpos, qvel: ``[nq]`` and ``[nv]``.
        rows: ``[H, W]``, a row for each step.
    """

    qpos: Array
    qvel: Array
    rows: Tensor


class Guide(Protocol):
    """``frames``: C of the past that it reads."""

    frames: int

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """From visual features ``[C, D]`` and the live body's state."""
        ...


class SeenPast:
    """The policy's own context of the past, the same at every step (Yuan & Kitani 2019, section 3.2).

    Args:
        past: the policy's.
    """

    def __init__(self, past: PastContext) -> None:
        self._context, self.frames = past.context, past.frames

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """A forecast begins in the body's state."""
        return Beginning(qpos, qvel, self._context(features[None]).expand(steps, -1))


class FollowedCurve:
    """A kinematic forecast from the states that the regressor sees in the past.

    Args:
        follow: of the environment; its curves are nobody else's.
        regressor: of the policy's run, in eval mode.
        curves: of the policy's run.
        joint_range: ``[nu, 2]`` rad.
    """

    def __init__(self, follow: TrackForecast, regressor: StateRegressor, curves: Curves, joint_range: Array) -> None:
        self._follow, self._regressor, self._curves = follow, regressor, curves
        self.frames, self._joint_range = curves.context, joint_range

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """A forecast begins where its curve does, as in training, standing and facing as the body."""
        states = self._regressor.from_features(features[None])["humanoid_state"].double()
        start, forecasts = torch.zeros(1, dtype=torch.int64), self._follow.forecasts
        forecasts.put(self._curves(states), start)
        first = forecasts.first_state(start, torch.from_numpy(qpos)[None], self._joint_range)
        rows = torch.cat(self._follow.curve(start.expand(steps), torch.arange(steps)), dim=-1)
        return Beginning(first[0][0].numpy(), first[1][0].numpy(), rows)


def guide_of(
    env: TransformedEnv, actor: TensorDictModuleBase, regressor: StateRegressor, curves: Curves | None
) -> Guide:
    """Of a forecasting policy, see :class:`egopose.inference.stream.live_forecasts.LiveFutures`.

    Raises:
        InputError: the policy does not forecast.
    """
    past = parts_of(actor, PastContext)
    follow = [part for part in env.transform if isinstance(part, TrackForecast)]
    if follow and curves is not None:
        return FollowedCurve(follow[0], regressor, curves, env.base_env.problem.humanoid.joint_range)
    if len(past) != 1:
        raise InputError("forecast.checkpoint", "model.context.source", "is not past: this policy does not forecast")
    return SeenPast(past[0])


def parts_of(network: nn.Module, kind: type) -> list[Any]:
    """The modules of ``network`` of a kind."""
    return [part for part in network.modules() if isinstance(part, kind)]
