"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from egopose.models.policy import PolicySettings, build_actor, build_critic
from egopose.tasks.dataset import Dataset


def build_networks(
    config: Mapping[str, Any], dataset: Dataset, env: EnvBase
) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Actor and critic for ``env``'s observations, their start drawn from torch's generator.

    Raises:
        InputError: ``config["model"]`` does not fit; names the setting.
    """
    settings = PolicySettings.from_config(config["model"])
    widths = {name: spec.shape[-1] for name, spec in env.observation_spec.items() if name != "reward_terms"}
    bounds = torch.stack([dataset.takes.offsets, dataset.takes.offsets + dataset.takes.lengths], dim=1)
    names = [f"{joint.name}_{k}" for joint in dataset.humanoid.skeleton.joints for k in range(len(joint.dofs))]
    actor = build_actor(settings, widths, env.action_spec.shape[-1], dataset.visual_features, bounds, dof_names=names)
    return actor, build_critic(settings, widths, dataset.visual_features, bounds)
