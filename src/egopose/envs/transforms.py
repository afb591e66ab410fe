"""TorchRL transforms of the environment: the visual context of a frame, and the running normaliser of the state.

At a step they reckon on arrays: for its few rows an operator of torch costs several times what it works out.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform


def _clip(values: NDArray[np.floating], bound: float) -> NDArray[np.floating]:
    """``values`` brought within the bound in place; NaN stays."""
    return np.minimum(np.maximum(values, -bound, out=values), bound, out=values)


class VisualContext(Transform):
    """Looks up each world's row of a table over all frames of the store.

    The table belongs to the data, not to the learner: it is no part of the state dict and may be memory-mapped.
    Assign :attr:`table` to look up in another one.

    Args:
        table: ``[F, D]``, float32 features or context of every frame.
        key: of the row it writes, ``visual_context`` or ``visual_features``.
        frame_key: ``frame`` for the present frame; ``episode_start`` keeps the row of the first one (forecasting).
    """

    def __init__(self, table: Tensor, key: str = "visual_context", frame_key: str = "frame") -> None:
        super().__init__(in_keys=[frame_key], out_keys=[key])
        self.table = table

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return self.table.index_select(0, obs.flatten()).unflatten(0, obs.shape[:-1])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], self._apply_transform(next_tensordict[self.in_keys[0]]))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._step(tensordict, tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, self.table.shape[-1])
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=self.table.dtype, device=observation_spec.device)
        return observation_spec


class TrackingError(Transform):
    """How the body's state differs from the state regressor's, and where the regressor goes next.

    A controller that sees its error learns feedback with a nearly linear map; from state and context alone it has to
    find the regressor's state in the context first. To stand before :class:`StateNormalizer`, which changes the state.

    Args:
        table: ``[F, S]``, the regressor's states in their own units.
        following: ``[F]`` int64, the frame after each frame; of a take's last frame itself, where the regressor
            stands still.
        scale: ``[S]``, what a unit of each number is divided by (a deviation).
        clip: bound of the scaled numbers.
        key: of what it writes, ``[..., 2 S]``: the scaled error, the regressor's scaled step to the next frame.
    """

    scale: Tensor

    def __init__(
        self, table: Tensor, following: Tensor, scale: Tensor, clip: float, key: str = "tracking_error"
    ) -> None:
        super().__init__(in_keys=["humanoid_state", "frame"], out_keys=[key])
        self.table, self.following, self.clip = table, following, clip
        # A buffer: a policy must see other data in the units it was trained in.
        self.register_buffer("scale", scale)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state`` and ``frame``."""
        frame = tensordict["frame"].squeeze(-1)
        now = self.table.index_select(0, frame)
        ahead = self.table.index_select(0, self.following.index_select(0, frame))
        error = np.empty((*now.shape[:-1], 2, now.shape[-1]), dtype=np.float32)
        np.subtract(tensordict["humanoid_state"].numpy(), now.numpy(), out=error[..., 0, :])
        np.subtract(ahead.numpy(), now.numpy(), out=error[..., 1, :])
        error /= self.scale.numpy()
        _clip(error, self.clip)
        return tensordict.set(self.out_keys[0], torch.from_numpy(error.reshape(*now.shape[:-1], -1)))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, 2 * self.table.shape[-1])
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=self.table.dtype, device=observation_spec.device)
        return observation_spec


class RawState(Transform):
    """Keeps the humanoid state in its own units beside the normalised one. To stand before :class:`StateNormalizer`.

    Args:
        key: of what it writes, ``[..., S]``.
    """

    def __init__(self, key: str = "raw_state") -> None:
        super().__init__(in_keys=["humanoid_state"], out_keys=[key])

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return obs.clone()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        observation_spec[self.out_keys[0]] = observation_spec["humanoid_state"].clone()
        return observation_spec


class StateNormalizer(Transform):
    """Running mean and deviation of an observation, normalised in place and clipped (the papers' online z-filter).

    Sums are float64 and merged by Chan's rule (Chan, Golub & LeVeque 1979), which keeps constant and large features
    exact where E[x^2] - E[x]^2 does not. Every new observation counts once: all worlds at a step, and at a reset only
    the worlds that were reset. The statistics are buffers and so part of the state dict.

    Args:
        size: D of the observation ``[..., D]``.
        key: of the observation.
        clip: bound of the normalised values (5 in the authors' program).
        frozen: start without updates, see :meth:`freeze`.
    """

    count: Tensor
    mean: Tensor
    sum_of_squares: Tensor

    def __init__(self, size: int, key: str = "humanoid_state", clip: float = 5.0, frozen: bool = False) -> None:
        super().__init__(in_keys=[key], out_keys=[key])
        self.clip, self.frozen = clip, frozen
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("sum_of_squares", torch.zeros(size, dtype=torch.float64))

    @property
    def std(self) -> Tensor:
        """``[D]`` sample deviation; ones before two observations were seen."""
        count = int(self.count)
        return (self.sum_of_squares / (count - 1)).sqrt() if count > 1 else torch.ones_like(self.mean)

    def freeze(self, frozen: bool = True) -> StateNormalizer:
        """Stop (or take up again) the updates; normalising goes on."""
        self.frozen = frozen
        return self

    def update(self, values: Tensor) -> None:
        """Count the rows of ``values [n, D]``."""
        n = values.shape[0]
        if n == 0:
            return
        rows, mean, squares = values.numpy().astype(np.float64), self.mean.numpy(), self.sum_of_squares.numpy()
        theirs = np.add.reduce(rows) / n
        before = int(self.count)
        total = before + n
        delta = theirs - mean
        rows -= theirs
        rows *= rows
        squares += np.add.reduce(rows) + delta * delta * (before * n / total)
        mean += delta * (n / total)
        self.count.add_(n)

    def normalize(self, values: Tensor) -> Tensor:
        """``values [..., D]`` by the present statistics, in their own dtype."""
        # The floor keeps a constant feature's rounding noise from being blown up.
        scaled = (values.to(torch.float64) - self.mean).div_(self.std.add_(1e-8))
        return scaled.clamp_(-self.clip, self.clip).to(values.dtype)

    def _normalize_rows(self, values: Tensor) -> Tensor:
        """:meth:`normalize` to the bit, on arrays."""
        count, squares = int(self.count), self.sum_of_squares.numpy()
        scaled = values.numpy() - self.mean.numpy()
        scaled /= (np.sqrt(squares / (count - 1)) if count > 1 else 1.0) + 1e-8
        return torch.from_numpy(_clip(scaled, self.clip)).to(values.dtype)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return self.normalize(obs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Normalise without counting (outside an environment)."""
        return tensordict.set(self.out_keys[0], self.normalize(tensordict[self.in_keys[0]]))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = next_tensordict[self.in_keys[0]]
        if not self.frozen:
            self.update(values.reshape(-1, values.shape[-1]))
        return next_tensordict.set(self.out_keys[0], self._normalize_rows(values))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = tensordict_reset[self.in_keys[0]]
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if not self.frozen:
            fresh = values.reshape(-1, values.shape[-1])
            self.update(fresh if mask is None else fresh[mask.reshape(-1)])
        return tensordict_reset.set(self.out_keys[0], self._normalize_rows(values))
