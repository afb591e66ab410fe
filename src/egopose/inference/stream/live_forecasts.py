"""Forecasts of a live body: the forecasting policy from one moment on, in physics of its own.

It gives the same numbers as :func:`egopose.inference.forecaster.forecast`, step by step, with the policy's networks
and the physics alone. Beside a live stream every millisecond in Python makes the stream wait.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.modules import LSTMModule

from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.path import on_path, root_on_floor
from egopose.envs.test_time import prepare_for_test
from egopose.envs.transforms import StateNormalizer
from egopose.inference.bands import quantile_bands
from egopose.inference.stream.guides import Curves, Guide, guide_of, parts_of
from egopose.models.policy import GaussianHead
from egopose.models.regressor import StateRegressor
from egopose.motion.rotations import Array

_CONFIG = "conf/stream.yaml"

#: Of a frame's passing through a forecast, in order.
STAGES = ("forecast_encoder", "forecast_rollout", "forecast_output")


@dataclass(frozen=True)
class ForecastSettings:
    """Of the group ``forecast`` of ``conf/stream.yaml``.

    Args:
        every: s between forecasts.
        horizon: H, frames.
        samples: K, drawn futures beside the mean one; 1 for none.
        level: of the bands.
        noise_time: s, see :func:`egopose.inference.forecaster.forecast`.
        seed: of the drawn futures, together with the frame.

    Raises:
        InputError: a value that cannot be.
    """

    every: float
    horizon: int
    samples: int
    level: float
    noise_time: float
    seed: int

    def __post_init__(self) -> None:
        if not 0 < self.every <= 60:
            raise InputError(_CONFIG, "forecast.every", f"{self.every} s; more than 0 and at most 60")
        for name, most in (("horizon", 900), ("samples", 256)):
            if not 1 <= getattr(self, name) <= most:
                raise InputError(_CONFIG, f"forecast.{name}", f"{getattr(self, name)}; 1 to {most}")
        if not 0 < self.level < 1:
            raise InputError(_CONFIG, "forecast.level", f"{self.level}; between 0 and 1")
        if self.noise_time < 0 or self.seed < 0:
            raise InputError(_CONFIG, "forecast.noise_time, forecast.seed", "must not be negative")

    @property
    def drawn(self) -> int:
        """Drawn futures: none where one is asked for, the mean."""
        return self.samples if self.samples > 1 else 0


@dataclass(frozen=True, eq=False)
class Moment:
    """Where a forecast begins: copies, nobody else's.

    Attributes:
        frame: control frames since the stream's start.
        qpos, qvel: ``[nq]`` and ``[nv]`` of the live body there.
        flow: ``[C, 2, S, S]`` float32, widths a control frame, of the C frames up to it.
        handed: s on ``time.perf_counter``, when it was handed over.
    """

    frame: int
    qpos: Array
    qvel: Array
    flow: NDArray[np.float32]
    handed: float


@dataclass(frozen=True, eq=False)
class LiveForecast:
    """What may come after a frame.

    Attributes:
        frame: the last one seen; row 0 of all below is the one after it.
        qpos: ``[H, nq]`` by the policy's mean action.
        drawn: ``[K, H, nq]`` by drawn actions; K may be 0.
        low, high: ``[H, nu]`` rad, the middle ``level`` of the drawn futures of each joint angle, as drawn (not widened
            by a calibration); no rows where none are drawn.
        fallen: the first row in which the head is under the fail-safe's height, None for none.
        diverged: the physics broke; from there it stands still in its last pose.
    """

    frame: int
    qpos: Array
    drawn: Array
    low: Array
    high: Array
    fallen: int | None
    diverged: bool


class LiveFutures:
    """Rolls a forecasting policy out.

    Args:
        env: over :class:`EgoPoseEnv`, of ``1 + settings.drawn`` worlds, with ``WholeFragments`` starts; nobody else's.
        actor: the policy, on ``env``'s observations.
        regressor: of the policy's run, in eval mode.
        settings: see :class:`ForecastSettings`.
        fallen_height: m of the head.
        curves: of a policy that follows them, see :func:`egopose.pipeline.forecaster.ForecastCurves`.

    Attributes:
        context: C, frames of the past the policy reads.

    Raises:
        InputError: the policy reads what is not known live.
    """

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        regressor: StateRegressor,
        settings: ForecastSettings,
        fallen_height: float,
        curves: Curves | None = None,
    ) -> None:
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        prepare_for_test(env, actor)
        self._base, self._head, self._physics = base, base.problem.humanoid.head, base.physics
        self._guide: Guide = guide_of(env, actor, regressor, curves)
        self.context, self.settings = self._guide.frames, settings
        self._regressor, self._fallen_height = regressor, fallen_height
        dt = base.problem.humanoid.control_dt
        self._kept = math.exp(-dt / settings.noise_time) if settings.noise_time > 0 else 0.0
        self._encoded: dict[int, Tensor] = {}
        step = _Step(env, actor, self._guide)
        self._hidden_size = step.hidden_size
        self._step = self._traced(step)

    @torch.no_grad()
    def _traced(self, step: _Step) -> torch.jit.ScriptModule:
        """One call a step, during which Python's lock is free: the live loop would wait at each of forty otherwise."""
        worlds = 1 + self.settings.drawn
        still = torch.zeros(self.context, self._regressor.context.feature_size)
        rows = self._guide.begin(still, self._physics.qpos[0], self._physics.qvel[0], 1).rows
        example = (*self._state(), rows.expand(worlds, -1).contiguous())
        silent = torch.zeros(worlds, self._physics.model.nu)
        hidden = torch.zeros(2, 1, worlds, self._hidden_size)
        inputs = (*example, silent, hidden, self._base.placed, self._base.laid)
        with warnings.catch_warnings():
            # The normaliser's count, which is frozen.
            warnings.simplefilter("ignore", torch.jit.TracerWarning)
            traced = torch.jit.trace(step, inputs, check_trace=False)
        assert isinstance(traced, torch.jit.ScriptModule)
        return torch.jit.freeze(traced.eval())

    def _state(self) -> tuple[Tensor, Tensor]:
        return torch.from_numpy(self._physics.qpos), torch.from_numpy(self._physics.qvel)

    @torch.no_grad()
    def roll(self, moment: Moment, lap: Callable[[str], None] = lambda stage: None) -> LiveForecast:
        """The futures of a moment: each frame's flow is encoded once, whatever number of forecasts it serves.

        Args:
            moment: see :class:`Moment`.
            lap: told each of :data:`STAGES` but the output when it is done.
        """
        beginning = self._guide.begin(self._features(moment), moment.qpos, moment.qvel, self.settings.horizon)
        lap("forecast_encoder")
        worlds = 1 + self.settings.drawn
        state = (torch.from_numpy(part).expand(worlds, -1) for part in (beginning.qpos, beginning.qvel))
        self._base.place(torch.arange(worlds), *state)
        qpos, heads, broken = self._walk(beginning.rows, moment.frame)
        low = np.flatnonzero(heads < self._fallen_height)
        edges = np.empty((2, 0, qpos.shape[-1] - 7))
        if self.settings.drawn:
            bands = quantile_bands(qpos[None, 1:, :, 7:], self.settings.level)
            edges = np.concatenate([bands.low, bands.high])
        fallen = int(low[0]) if len(low) else None
        forecast = LiveForecast(moment.frame, qpos[0], qpos[1:], edges[0], edges[1], fallen, bool(broken[0]))
        lap("forecast_rollout")
        return forecast

    def _features(self, moment: Moment) -> Tensor:
        """``[C, D]``."""
        frames = range(moment.frame - self.context + 1, moment.frame + 1)
        known = self._encoded
        self._encoded = {frame: known[frame] for frame in frames if frame in known}
        for row, frame in enumerate(frames):
            if frame not in self._encoded:
                flow = torch.from_numpy(moment.flow[row : row + 1])
                self._encoded[frame] = self._regressor.encode(flow)[0]
        return torch.stack([self._encoded[frame] for frame in frames])

    def _walk(self, rows_read: Tensor, frame: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        """``qpos [N, H, nq]``, head height ``[H]`` of the mean future (m), ``[N]`` whose physics broke."""
        worlds, horizon, physics = 1 + self.settings.drawn, self.settings.horizon, self._physics
        generator = torch.Generator().manual_seed(self.settings.seed + frame)
        # The first world's stays silent: the mean future beside the drawn ones, whose noise goes on over time.
        noise = torch.zeros(worlds, physics.model.nu)
        noise[1:] = torch.randn(noise[1:].shape, generator=generator)
        hidden = torch.zeros(2, 1, worlds, self._hidden_size)
        rows, heights = np.empty((worlds, horizon, physics.model.nq)), np.empty(horizon)
        last, broken = physics.qpos.copy(), np.zeros(worlds, dtype=bool)
        for step in range(horizon):
            read = rows_read[step].expand(worlds, -1)
            target, hidden = self._step(*self._state(), read, noise, hidden, self._base.placed, self._base.laid)
            if worlds > 1:
                fresh = torch.randn(noise[1:].shape, generator=generator)
                noise[1:] = self._kept * noise[1:] + math.sqrt(1 - self._kept**2) * fresh
            broken |= physics.step(target.numpy())
            last = np.where(broken[:, None], last, physics.qpos)
            rows[:, step] = last
            heights[step] = physics.body_state()["xpos"][0, self._head, 2]
        return rows, heights, broken


class _Step(nn.Module):
    """From the bodies' state to PD targets, as the environment and the actor do it.

    Raises:
        InputError: the policy reads what is not known live.
    """

    def __init__(self, env: TransformedEnv, actor: TensorDictModuleBase, guide: Guide) -> None:
        super().__init__()
        self._problem, self._guide = env.base_env.problem, guide
        (self.normalizer,) = (part for part in env.transform if isinstance(part, StateNormalizer))
        (self.head,) = parts_of(actor, GaussianHead)
        (reader,) = (p for p in actor.modules() if isinstance(p, TensorDictModule) and p.module is self.head)
        self._reads = [str(key) for key in reader.in_keys[1:]]
        # What the mean is added to, if anything.
        others = [part for part in parts_of(actor, TensorDictModule) if part.module is torch.add]
        self._added = [str(key) for part in others for key in part.in_keys if key != "loc"]
        if unknown := [key for key in (*self._reads, *self._added) if key not in guide.keys]:
            cause = f"a live forecast knows the state and the past, not {', '.join(unknown)}"
            raise InputError("forecast.checkpoint", "model.inputs", cause)
        memories = parts_of(actor, LSTMModule)
        self.memory: nn.LSTM | None = memories[0].lstm if memories else None
        self.hidden_size = 0 if self.memory is None else self.memory.hidden_size

    def forward(
        self, qpos: Tensor, qvel: Tensor, rows: Tensor, noise: Tensor, hidden: Tensor, placed: Tensor, laid: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Targets ``[N, nu]`` float64 and the memory ``[2, 1, N, H]`` after it.

        Args:
            qpos, qvel: ``[N, nq]`` and ``[N, nv]``.
            rows: ``[N, W]`` of the guide.
            noise: ``[N, nu]`` in deviations.
            hidden: the memory before.
            placed: ``[N, nu]`` rad, where the bodies were put.
            laid: ``[N, 3]`` placements of the path that is followed.
        """
        # Of operators that can be traced, where `observation` has arrays.
        state = self._problem.view({"qpos": qpos, "qvel": qvel}).humanoid_state.float()
        seen = self._guide.seen(rows, state, on_path(laid, root_on_floor(qpos)).float())
        read = self.normalizer.normalize(state)
        if self.memory is not None:
            out, after = self.memory(read[:, None], (hidden[0], hidden[1]))
            read, hidden = out[:, 0], torch.stack(after)
        action, scale = self.head(read, *(seen[key] for key in self._reads))
        for key in self._added:
            action = action + seen[key]
        index = torch.zeros(qpos.shape[0], dtype=torch.int64)
        return self._problem.target(action + scale * noise, index, placed), hidden
