"""Every world tried once, from starts that stay the same: what a survival figure needs of an environment.

Collectors hand over whichever episodes end first, which are the falls. In a trial all worlds end together, so that each
counts once, whoever collects them.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from egopose.envs.env import EgoPoseEnv
from egopose.envs.starts import Episodes, Starts, Unlearning

_FLAGS = ("running", "survived", "fell")


class SameStarts(Unlearning):
    """Deals the same episodes again and again.

    Args:
        starts: what deals them.
        seed: of the generator it is given, anew each time.
    """

    def __init__(self, starts: Starts, seed: int) -> None:
        self.starts, self.seed = starts, seed

    def __call__(self, worlds: Tensor, generator: torch.Generator) -> Episodes:
        return self.starts(worlds, torch.Generator().manual_seed(self.seed))


class Trial(Transform):
    """Ends all worlds at once: after ``steps``, or when each has come to an end of its own.

    Writes, ``[..., 1]`` bool: ``running``, whether a world's own episode still goes on; ``survived``, whether it came
    through this step of it; ``fell``, whether this step ended it by a fall. A world past its end earns no reward.

    Args:
        steps: of a trial.
    """

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        flags = torch.zeros(len(_FLAGS), *shape, dtype=torch.bool)
        flags[0] = True
        for name, flag in zip(_FLAGS, flags, strict=True):
            tensordict_reset.set(name, flag)
        return tensordict_reset.set("trial_step", torch.zeros(shape, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        was, step = tensordict["running"], tensordict["trial_step"] + 1
        fall, running = next_tensordict["terminated"], was & ~next_tensordict["done"]
        over = (step >= self.steps) | ~running.any()
        result = {"running": running, "survived": was & ~fall, "fell": was & fall, "trial_step": step}
        ends = {"done": over, "truncated": over.clone(), "terminated": torch.zeros_like(over)}
        reward = next_tensordict["reward"] * was
        for key, value in {**result, **ends, "reward": reward}.items():
            next_tensordict.set(key, value)
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, 1)
        for name in _FLAGS:
            observation_spec[name] = Binary(1, shape, dtype=torch.bool)
        observation_spec["trial_step"] = Unbounded(shape, dtype=torch.int64)
        return observation_spec


def trial_env(env: TransformedEnv, steps: int, seed: int) -> TransformedEnv:
    """``env`` for trials of ``steps`` from the starts that ``env.set_seed(seed)`` would give.

    Args:
        env: over :class:`EgoPoseEnv` with uniform starts and falls that end the episode.
        steps: the task's horizon less one.
        seed: of the starts.
    """
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    base.starts = SameStarts(base.starts, seed)
    return TransformedEnv(env, Trial(steps), auto_unwrap=False)


def trial_figures(batch: TensorDictBase) -> dict[str, float]:
    """Of the trajectories ``[worlds, T]`` of one trial: mean ``frames`` survived, share that ``fell``."""
    after, worlds = batch["next"], batch.batch_size[0]
    return {"frames": float(after["survived"].sum()) / worlds, "fell": float(after["fell"].sum()) / worlds}
