"""What a live forecast goes by besides the body's state: the past seen, or a curve that begins where that ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from egopose.core.errors import InputError
from egopose.envs.imitation import ImitationProblem
from egopose.envs.reference_forecasts import ForecastReader, ForecastTargets, TrackForecast
from egopose.envs.target_window import TargetWindow
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
    """``frames``: C of the past that it reads. ``keys``: of what it shows a policy."""

    frames: int
    keys: frozenset[str]

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """From visual features ``[C, D]`` and the live body's state."""
        ...

    def seen(self, rows: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """What a policy reads besides the state; of operators that can be traced.

        Args:
            rows: ``[N, W]`` of a :class:`Beginning`, a row for each body.
            state: ``[N, S]`` raw humanoid states.
            root: ``[N, 3]`` x, y (m) and heading (rad) in the axes of the path that is followed.
        """
        ...


class SeenPast:
    """The policy's own context of the past, the same at every step (Yuan & Kitani 2019, section 3.2).

    Args:
        past: the policy's.
    """

    keys = frozenset(("visual_context",))

    def __init__(self, past: PastContext) -> None:
        self._context, self.frames = past.context, past.frames

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """A forecast begins in the body's state."""
        return Beginning(qpos, qvel, self._context(features[None]).expand(steps, -1))

    def seen(self, rows: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """The context alone."""
        return {"visual_context": rows}


class FollowedCurve:
    """A kinematic forecast from the states that the regressor sees in the past.

    Args:
        env: its forecasts are nobody else's.
        regressor: of the policy's run, in eval mode.
        curves: of the policy's run.
    """

    def __init__(self, env: TransformedEnv, regressor: StateRegressor, curves: Curves) -> None:
        problem = env.base_env.problem
        assert isinstance(problem, ImitationProblem)
        assert problem.forecasts is not None
        self._forecasts, self._joint_range = problem.forecasts, problem.humanoid.joint_range
        self._regressor, self._curves, self.frames = regressor, curves, curves.context
        kinds = (TrackForecast, TargetWindow, ForecastTargets)
        self._readers: list[ForecastReader] = [part for part in env.transform if isinstance(part, kinds)]
        self.keys = frozenset(key for part in env.transform if isinstance(part, kinds) for key in part.out_keys)
        self._widths: list[int] = []

    def begin(self, features: Tensor, qpos: Array, qvel: Array, steps: int) -> Beginning:
        """A forecast begins where its curve does, as in training, standing and facing as the body."""
        states = self._regressor.from_features(features[None])["humanoid_state"].double()
        start, forecasts = torch.zeros(1, dtype=torch.int64), self._forecasts
        forecasts.put(self._curves(states), start)
        first = forecasts.first_state(start, torch.from_numpy(qpos)[None], self._joint_range)
        still, step = torch.zeros(steps, 1, dtype=torch.int64), torch.arange(steps)[:, None]
        clock = {"frame": still, "episode_start": still, "episode_step": step}
        known = [reader.known(clock) for reader in self._readers]
        self._widths = [part.shape[-1] for part in known]
        return Beginning(first[0][0].numpy(), first[1][0].numpy(), torch.cat(known, dim=-1))

    def seen(self, rows: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """What the transforms of the environment would write."""
        parts = zip(self._readers, rows.split(self._widths, dim=-1), strict=True)
        return {key: entry for reader, part in parts for key, entry in reader.seen(part, state, root).items()}


def guide_of(
    env: TransformedEnv, actor: TensorDictModuleBase, regressor: StateRegressor, curves: Curves | None
) -> Guide:
    """Of a forecasting policy, see :class:`egopose.inference.stream.live_forecasts.LiveFutures`.

    Raises:
        InputError: the policy does not forecast.
    """
    past = parts_of(actor, PastContext)
    if curves is not None:
        return FollowedCurve(env, regressor, curves)
    if len(past) != 1:
        raise InputError("forecast.checkpoint", "model.context.source", "is not past: this policy does not forecast")
    return SeenPast(past[0])


def parts_of(network: nn.Module, kind: type) -> list[Any]:
    """The modules of ``network`` of a kind."""
    return [part for part in network.modules() if isinstance(part, kind)]
