"""What a forecasting environment adds to the observation: hidden states of recurrent networks, and the time left."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform


class RecurrentStates(Transform):
    """Zeros where an episode begins; from there the networks write their own under ``next``.

    (TorchRL's ``TensorDictPrimer`` does this for whole batches; here the reset of a few worlds makes only their rows.)

    Args:
        sizes: key -> H; each is ``[..., 1, H]`` float32.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        super().__init__()
        self.sizes = dict(sizes)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key, size in self.sizes.items():
            tensordict_reset.set(key, torch.zeros(*tensordict_reset.shape, 1, size))
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        for key, size in self.sizes.items():
            observation_spec[key] = Unbounded((*observation_spec.shape, 1, size), device=observation_spec.device)
        return observation_spec


class TimeLeft(Transform):
    """``time_left [1]``: the share of the horizon still to come, (T - t) / T, never below zero.

    The reward decays by it (Yuan & Kitani 2019, equation 7), so a value cannot be known without it.

    Args:
        horizon: T, steps.
    """

    def __init__(self, horizon: int) -> None:
        super().__init__(in_keys=["episode_step"], out_keys=["time_left"])
        self.horizon = horizon

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return (1.0 - obs.float() / self.horizon).clamp_min_(0.0)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        observation_spec["time_left"] = Unbounded((*observation_spec.shape, 1), device=observation_spec.device)
        return observation_spec
