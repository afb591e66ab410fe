"""Kinematic forecasts as an environment follows them: curves of poses, by the frame they begin at."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from egopose.humanoid.state_layout import StateLayout
from egopose.models.motion_forecast import spline_basis
from egopose.models.pose_regression import state_to_qpos
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

    Raises:
        ValueError: coefficients of another number than the splines have, or a start outside the store.
    """

    def __init__(
        self, coefficients: Tensor, starts: Tensor, frames: int, horizon: int, spacing: int, fps: float
    ) -> None:
        self.horizon, self.frames = horizon, frames
        self._basis, self._slope = spline_basis(horizon + 1, spacing, fps)
        if coefficients.shape[:2] != (len(starts), self._basis.shape[1]):
            raise ValueError(f"curves {tuple(coefficients.shape)} of {len(starts)} starts do not fit the splines")
        if len(starts) and not 0 <= int(starts.min()) <= int(starts.max()) < frames:
            raise ValueError(f"curves begin outside the store's {frames} frames")
        self.coefficients, self.starts = coefficients.float(), starts.long()
        self._row = torch.full((frames,), -1, dtype=torch.int64)
        self._row[self.starts] = torch.arange(len(starts))

    def put(self, coefficients: Tensor, starts: Tensor) -> None:
        """Other curves ``[R, K, P]`` for these starts ``[R]``; those of other starts stay."""
        kept = ~torch.isin(self.starts, starts)
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

    def _at(self, start: Tensor, step: Tensor, basis: Tensor, part: slice = slice(None)) -> Tensor:
        row = self._row[start]
        if bool((row < 0).any()):
            raise ValueError(f"no forecast begins at frame {int(start[row < 0][0])}")
        weights = basis[step.clamp(max=self.horizon)]
        # A cubic spline has four weights at a step: the rest are zero.
        at = (weights != 0).float().argmax(dim=1).clamp(max=basis.shape[1] - 4)
        near = at[:, None] + torch.arange(4)
        curves = self.coefficients[row[:, None], near][..., part]
        return (weights.gather(1, near).unsqueeze(-1) * curves).sum(dim=1)


class TrackForecast(Transform):
    """What a policy needs to follow a curve. To stand before :class:`egopose.envs.transforms.StateNormalizer`.

    It writes three entries. ``followed_targets [nu]``, rad from the rest pose, are the curve's joint angles at the next
    step, plus its velocity there times a part of a PD controller's lag. ``tracking_error [2 S]``, as
    :class:`egopose.envs.transforms.TrackingError`, is the state's scaled error against the curve, and the curve's
    scaled step to the next frame. ``visual_context`` holds the scaled poses of the steps ``ahead``.

    Args:
        forecasts: the curves.
        scale: ``[S]``, what a unit of each number is divided by (a deviation).
        rest: ``[nu]`` rad.
        lag: ``[nu]`` s.
        clip: bound of the scaled errors.
        ahead: steps from the present one.
    """

    scale: Tensor

    def __init__(
        self, forecasts: ReferenceForecasts, scale: Tensor, rest: Tensor, lag: Tensor, clip: float, ahead: Sequence[int]
    ) -> None:
        super().__init__(
            in_keys=["humanoid_state", "episode_start", "episode_step"],
            out_keys=["followed_targets", "tracking_error", "visual_context"],
        )
        self.forecasts, self.rest, self.lag, self.clip, self.ahead = forecasts, rest, lag, clip, tuple(ahead)
        # A buffer: a policy must see other data in the units it was trained in.
        self.register_buffer("scale", scale)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state`` and the episode's clock."""
        start, step = tensordict["episode_start"].squeeze(-1), tensordict["episode_step"].squeeze(-1)
        now, following, targets, later = self.curve(start, step)
        tensordict.set("followed_targets", targets)
        tensordict.set("tracking_error", self.error(tensordict["humanoid_state"], now, following))
        return tensordict.set("visual_context", later)

    def curve(self, start: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What does not depend on the body, at ``step [N]`` of the curves that begin at global frames ``start [N]``.

        Returns:
            The curve's states z ``[N, S]`` there and at the next step, ``followed_targets [N, nu]`` and
            ``visual_context [N, P * steps ahead]``.
        """
        now, following = self.forecasts.states(start, step), self.forecasts.states(start, step + 1)
        layout = StateLayout.of_size(following.shape[-1])
        angles, rates = following[..., layout.joint_angles], following[..., layout.joint_velocities]
        targets = (angles.double() + self.lag * rates - self.rest).float()
        later = [self.forecasts.poses(start, step + ahead) / self.scale[layout.pose] for ahead in self.ahead]
        return now, following, targets, torch.cat(later, dim=-1)

    def error(self, state: Tensor, now: Tensor, following: Tensor) -> Tensor:
        """``tracking_error [N, 2 S]`` of the raw ``state [N, S]`` against the curve's, see :meth:`curve`."""
        error = torch.stack([state - now, following - now], dim=-2).div_(self.scale)
        return error.clamp_(-self.clip, self.clip).flatten(-2)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        size = self.forecasts.coefficients.shape[-1]
        widths = (len(self.rest), 2 * len(self.scale), size * len(self.ahead))
        for key, width in zip(self.out_keys, widths, strict=True):
            shape = (*observation_spec.shape, width)
            observation_spec[key] = Unbounded(shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
