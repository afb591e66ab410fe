"""What TorchRL's renderer asks for: an environment that shows the body from beside, and the trained policy.

As ``--env egopose.evaluation.torchrl_render:make_env --policy egopose.evaluation.torchrl_render:make_policy`` of
``torchrl.render``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from egopose.envs.env import EgoPoseEnv
from egopose.pipeline.agent import load_actor, load_agent
from egopose.tasks.dataset import Dataset
from egopose.vision.rendering import SceneRenderer


class SideView(Transform):
    """``pixels [N, S, S, 3]`` uint8: each body from beside, its root in the middle.

    Args:
        base: whose bodies are shown.
        size: side of the pictures, pixels.

    Raises:
        RuntimeError: no OpenGL here.
    """

    def __init__(self, base: EgoPoseEnv, size: int) -> None:
        super().__init__()
        self._base, self._size = base, size
        self._renderer = SceneRenderer(base.problem.humanoid.mj_model, size, size)
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._view.distance, self._view.elevation, self._view.azimuth = 3.2, -12.0, 120.0

    def _pictures(self) -> Tensor:
        out = []
        for qpos in self._base.body_state()["qpos"].numpy():
            self._view.lookat = [qpos[0], qpos[1], 0.85]
            out.append(self._renderer.render(qpos, self._view))
        return torch.from_numpy(np.stack(out))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("pixels", self._pictures())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("pixels", self._pictures())

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, self._size, self._size, 3)
        observation_spec["pixels"] = Unbounded(shape, dtype=torch.uint8)
        return observation_spec


def make_env(config: Any, size: int = 320, dataset: Dataset | None = None) -> TransformedEnv:
    """One world on the run's test fragments, with pictures.

    Args:
        config: of the renderer; its ``ckpt`` is a checkpoint folder.
        size: side of the pictures, pixels.
        dataset: to run on; None for the run's own.

    Raises:
        InputError: the checkpoint cannot be used.
        RuntimeError: no OpenGL here.
    """
    env = load_agent(config.ckpt, dataset).make_env("test", num_envs=1)
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    return TransformedEnv(env, SideView(base, size), auto_unwrap=False)


def make_policy(ckpt_path: str | Path, dataset: Dataset | None = None) -> TensorDictModuleBase:
    """The trained actor; the renderer takes its mean action.

    Raises:
        InputError: the checkpoint cannot be used.
    """
    return load_actor(ckpt_path, dataset)
