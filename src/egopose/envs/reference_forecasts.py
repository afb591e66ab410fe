"""Kinematic forecasts as an environment follows them: curves of poses, by the frame they begin at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from egopose.humanoid.state_layout import StateLayout
from egopose.models.motion_forecast import spline_basis
from egopose.models.pose_regression import integrated_path, state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array


class ReferenceForecasts:
    """Humanoid states at every step of every curve; a step behind a curve's end is its last.

    Args:
        coefficients: ``[R, K, P]`` of cubic splines, in the pose state's own units (see
            :mod:`egopose.models.motion_forecast`).
        starts: ``[R]`` global frames the curves begin at.
        frames: F of the store.
        horizon: last step of a curve.
        spacing: frames between knots.
        fps: frames per second.

    Attributes:
        size: S, numbers of a humanoid state.

    Raises:
        ValueError: coefficients of another number than the splines have, or a start outside the store.
    """

    def __init__(
        self, coefficients: Tensor, starts: Tensor, frames: int, horizon: int, spacing: int, fps: float
    ) -> None:
        self.horizon, self.frames, self._fps = horizon, frames, fps
        self.size = StateLayout.of_pose_size(coefficients.shape[-1]).size
        self._basis, self._slope = spline_basis(horizon + 1, spacing, fps)
        if coefficients.shape[:2] != (len(starts), self._basis.shape[1]):
            raise ValueError(f"curves {tuple(coefficients.shape)} of {len(starts)} starts do not fit the splines")
        if len(starts) and not 0 <= int(starts.min()) <= int(starts.max()) < frames:
            raise ValueError(f"curves begin outside the store's {frames} frames")
        self.coefficients, self.starts = coefficients.float(), starts.long()
        self._paths = torch.zeros(len(starts), horizon + 1, 3, dtype=torch.float64)
        self._has_path = torch.zeros(len(starts), dtype=torch.bool)
        self._row = torch.full((frames,), -1, dtype=torch.int64)
        self._row[self.starts] = torch.arange(len(starts))

    def put(self, coefficients: Tensor, starts: Tensor) -> None:
        """Other curves ``[R, K, P]`` for these starts ``[R]``; those of other starts stay."""
        kept = ~torch.isin(self.starts, starts)
        self._paths = torch.cat([self._paths[kept], self._paths.new_zeros(len(starts), *self._paths.shape[1:])])
        self._has_path = torch.cat([self._has_path[kept], self._has_path.new_zeros(len(starts))])
        self.coefficients = torch.cat([self.coefficients[kept], coefficients.float()])
        self.starts = torch.cat([self.starts[kept], starts.long()])
        self._row[self.starts] = torch.arange(len(self.starts))

    def poses(self, start: Tensor, step: Tensor) -> Tensor:
        """``[N, P]`` pose states at ``step [N]`` of the curves that begin at global frames ``start [N]``."""
        return self._at(start, step, self._basis)

    def states(self, start: Tensor, step: Tensor) -> Tensor:
        """Humanoid states z ``[N, S]``, float32, joint velocities those of the curve."""
        poses = self.poses(start, step)
        return torch.cat([poses, self.joint_velocities(start, step)], dim=-1)

    def path(self, start: Tensor, step: Tensor) -> Tensor:
        """``[N, 3]`` x, y (m) and heading (rad) of the root, float64; each curve from the origin and along x.

        It is put together from the curve's own root velocities, once a curve.
        """
        row = self._rows(start)
        if not bool(self._has_path[row].all()):
            new = row[~self._has_path[row]].unique()
            self._paths[new], self._has_path[new] = self._integrated(self.coefficients[new]), True
        return self._paths[row, step.clamp(max=self.horizon)]

    def joint_velocities(self, start: Tensor, step: Tensor) -> Tensor:
        """``[N, D]`` rad/s."""
        angles = StateLayout.of_pose_size(self.coefficients.shape[-1]).joint_angles
        return self._at(start, step, self._slope, angles)

    def first_state(self, start: Tensor, reference: Tensor, joint_range: Array) -> tuple[Tensor, Tensor]:
        """``qpos [N, nq]`` and ``qvel [N, nv]`` at the curves' beginnings, standing and facing as ``reference``'s."""
        where = reference.double().numpy()
        states = self.states(start, torch.zeros_like(start)).double().numpy()
        placed = state_to_qpos(states, where[:, :2], rot.heading(where[:, 3:7]), joint_range)
        return torch.from_numpy(placed[0]), torch.from_numpy(placed[1])

    def _integrated(self, coefficients: Tensor) -> Tensor:
        """``[R, horizon + 1, 3]`` the paths of curves ``[R, K, P]``."""
        poses = (self._basis @ coefficients).double().numpy()
        still = np.zeros((*poses.shape[:2], self.size - poses.shape[2]))  # joint velocities move no root
        return torch.from_numpy(integrated_path(np.concatenate([poses, still], axis=-1), self._fps))

    def _rows(self, start: Tensor) -> Tensor:
        row = self._row[start]
        if bool((row < 0).any()):
            raise ValueError(f"no forecast begins at frame {int(start[row < 0][0])}")
        return row

    def _at(self, start: Tensor, step: Tensor, basis: Tensor, part: slice = slice(None)) -> Tensor:
        row = self._rows(start)
        weights = basis[step.clamp(max=self.horizon)]
        # A cubic spline has four weights at a step: the rest are zero.
        at = (weights != 0).float().argmax(dim=1).clamp(max=basis.shape[1] - 4)
        near = at[:, None] + torch.arange(4)
        curves = self.coefficients[row[:, None], near][..., part]
        return (weights.gather(1, near).unsqueeze(-1) * curves).sum(dim=1)


class ForecastReader(Protocol):
    """A transform that shows the curve a body follows, for those who step without an environment, too."""

    def known(self, entries: Mapping[str, Tensor]) -> Tensor:
        """``[N, W]`` what does not depend on the body, from ``episode_start`` and ``episode_step``, ``[N, 1]``."""
        ...

    def seen(self, known: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """What a policy reads; of operators that can be traced.

        Args:
            known: see :meth:`known`.
            state: ``[N, S]`` raw humanoid states.
            root: ``[N, 3]`` x, y (m) and heading (rad) of the bodies in the path's axes.
        """
        ...


class ForecastTargets(Transform):
    """Writes ``followed_targets [nu]``, rad from the rest pose: what a policy adds its actions to.

    They are the curve's joint angles at the next step, plus its velocity there times a part of a PD controller's lag.

    Args:
        forecasts: the curves.
        rest: ``[nu]`` rad.
        lag: ``[nu]`` s.
    """

    def __init__(self, forecasts: ReferenceForecasts, rest: Tensor, lag: Tensor) -> None:
        super().__init__(in_keys=["episode_start", "episode_step"], out_keys=["followed_targets"])
        self._forecasts, self._rest, self._lag = forecasts, rest, lag

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the episode's clock."""
        return tensordict.set(self.out_keys[0], self.known(tensordict))

    def known(self, entries: Mapping[str, Tensor]) -> Tensor:
        """See :class:`ForecastReader`."""
        start, step = entries["episode_start"].squeeze(-1), entries["episode_step"].squeeze(-1)
        following = self._forecasts.states(start, step + 1)
        layout = StateLayout.of_size(following.shape[-1])
        angles, rates = following[..., layout.joint_angles], following[..., layout.joint_velocities]
        return (angles.double() + self._lag * rates - self._rest).float()

    def seen(self, known: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """See :class:`ForecastReader`."""
        return {self.out_keys[0]: known}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        return _with_rows(observation_spec, {self.out_keys[0]: len(self._rest)})


class TrackForecast(Transform):
    """How a body differs from the curve it follows, and where that goes. To stand before
    :class:`egopose.envs.transforms.StateNormalizer`.

    It writes two entries. ``tracking_error [2 S]``, as :class:`egopose.envs.transforms.TrackingError`, is the state's
    scaled error against the curve, and the curve's scaled step to the next frame. ``visual_context`` holds the scaled
    poses of the steps ``ahead``.

    Args:
        forecasts: the curves.
        scale: ``[S]``, what a unit of each number is divided by (a deviation).
        clip: bound of the scaled errors.
        ahead: steps from the present one.
    """

    scale: Tensor

    def __init__(self, forecasts: ReferenceForecasts, scale: Tensor, clip: float, ahead: Sequence[int]) -> None:
        super().__init__(
            in_keys=["humanoid_state", "episode_start", "episode_step"], out_keys=["tracking_error", "visual_context"]
        )
        self._forecasts, self._clip, self._ahead = forecasts, clip, tuple(ahead)
        # A buffer: a policy must see other data in the units it was trained in.
        self.register_buffer("scale", scale)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state`` and the episode's clock."""
        now, following, later = self._curve(tensordict)
        tensordict.set("tracking_error", self._error(tensordict["humanoid_state"], now, following))
        return tensordict.set("visual_context", later)

    def known(self, entries: Mapping[str, Tensor]) -> Tensor:
        """See :class:`ForecastReader`."""
        return torch.cat(self._curve(entries), dim=-1)

    def seen(self, known: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """See :class:`ForecastReader`."""
        size = len(self.scale)
        now, following, later = known.split([size, size, known.shape[-1] - 2 * size], dim=-1)
        return {"tracking_error": self._error(state, now, following), "visual_context": later}

    def _curve(self, entries: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """The curve's states z ``[N, S]`` now and at the next step, and ``visual_context [N, P * steps ahead]``."""
        start, step = entries["episode_start"].squeeze(-1), entries["episode_step"].squeeze(-1)
        now, following = self._forecasts.states(start, step), self._forecasts.states(start, step + 1)
        scale = self.scale[StateLayout.of_size(len(self.scale)).pose]
        later = [self._forecasts.poses(start, step + ahead) / scale for ahead in self._ahead]
        return now, following, torch.cat(later, dim=-1)

    def _error(self, state: Tensor, now: Tensor, following: Tensor) -> Tensor:
        error = torch.stack([state - now, following - now], dim=-2).div_(self.scale)
        return error.clamp_(-self._clip, self._clip).flatten(-2)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        later = self._forecasts.coefficients.shape[-1] * len(self._ahead)
        return _with_rows(observation_spec, {"tracking_error": 2 * len(self.scale), "visual_context": later})


def _with_rows(observation_spec: TensorSpec, widths: Mapping[str, int]) -> TensorSpec:
    """``observation_spec`` with entries of these widths, float32."""
    assert isinstance(observation_spec, Composite)
    for key, width in widths.items():
        shape = (*observation_spec.shape, width)
        observation_spec[key] = Unbounded(shape, dtype=torch.float32, device=observation_spec.device)
    return observation_spec
