"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from egopose.checkpoint.checkpoint import RunCheckpoint, find_checkpoint, read_json, require, verify
from egopose.core.errors import InputError
from egopose.envs.transforms import StateNormalizer
from egopose.pipeline.dataset import run_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.forecaster import with_forecasts
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import task_name, task_of

_STORE_GROUPS = {"data", "humanoid"}


@dataclass(frozen=True)
class Agent:
    """A trained policy and what it was trained on.

    Attributes:
        actor, critic: in evaluation mode.
        config: resolved, of its run.
        dataset: see :class:`Dataset`.
        make_env: ``make_env(split="test", worlds=1, ...)`` as :func:`build_env`, with the normaliser as trained and
            frozen.
        path: the checkpoint.
    """

    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    config: dict[str, Any]
    dataset: Dataset
    make_env: Callable[..., TransformedEnv]
    path: Path

    def followed_states(self) -> torch.Tensor:
        """``[F, S]`` humanoid states of the regressor as the policy follows them, smoothed as ``task.action`` says.

        Raises:
            InputError: there is no regressor.
        """
        states = task_of(self.config).followed(self.config, self.dataset).states
        if states is None:
            raise InputError(self.path, "regressor", "the policy starts from the state regressor, and there is none")
        return states


def load_agent(
    path: str | Path, dataset: Dataset | None = None, which: str = "best", overrides: Mapping[str, Any] | None = None
) -> Agent:
    """Networks and environment from a checkpoint.

    Args:
        path: a checkpoint folder or a run directory.
        dataset: to run on; None for the data its configuration names, seen by the run's own state regressor.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.
        overrides: whole config groups in place of the run's own (``{"data": {...}}``).

    Raises:
        InputError: the checkpoint is damaged, or does not fit the dataset; the run was trained on other data, or its
            state regressor is gone; names the field.
    """
    folder = find_checkpoint(path, which)
    metadata = verify(folder)
    own = read_json(folder, "config")
    config = {**own, **(overrides or {})}
    if dataset is None:
        same_store = not _other_store(own, config)
        dataset = run_dataset(config, folder.resolve().parent.parent, same_store)
    dataset = with_forecasts(config, dataset, folder.resolve().parent.parent)
    env = build_env(config, dataset, num_envs=1)
    require(metadata, folder, task=task_name(config), action_size=int(env.action_spec.shape[-1]))
    actor, critic = build_networks(config, dataset, env)
    RunCheckpoint({"policy": actor, "critic": critic, "transforms": env}).restore(folder)
    statistics = copy.deepcopy(env.state_dict())
    env.close()

    def make_env(split: str = "test", *, num_envs: int = 1, **options: Any) -> TransformedEnv:
        made = build_env(config, dataset, split, num_envs=num_envs, **options)
        made.load_state_dict(statistics)
        for module in made.transform.modules():
            if isinstance(module, StateNormalizer):
                module.freeze()
        return made

    return Agent(actor.eval(), critic.eval(), config, dataset, make_env, folder)


def _other_store(own: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Whether ``config`` asks for other data than a run's own, and not for the same that lies elsewhere by now."""

    def parts(one: Mapping[str, Any]) -> list[Any]:
        place = dict.fromkeys(("folder", "store"))
        return [{**one[group], **place} if group == "data" else one[group] for group in sorted(_STORE_GROUPS)]

    return bool(parts(own) != parts(config))
