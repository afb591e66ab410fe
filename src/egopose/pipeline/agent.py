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

from egopose.checkpoint.checkpoint import (
    ComponentState,
    RunCheckpoint,
    find_checkpoint,
    read_json,
    require,
    verify,
)
from egopose.core.errors import InputError
from egopose.envs.target_window import window_size
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.config import HumanoidConfig
from egopose.models.policy import PolicySettings, build_actor, build_critic
from egopose.pipeline.dataset import run_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.forecaster import with_forecasts
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.tasks.imitation import WINDOW
from egopose.tasks.task import task_name, task_of

_STORE_GROUPS = {"data", "humanoid"}


@dataclass(frozen=True)
class Agent:
    """A trained policy and what it was trained on.

    Attributes:
        actor, critic: in evaluation mode.
        config: resolved, of its run.
        dataset: see :class:`Dataset`.
        make_env: ``make_env(split="test", num_envs=1, ...)`` as :func:`build_env`, with the normaliser as trained and
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


@dataclass(frozen=True)
class Policy:
    """A trained policy by itself, without the data it was trained on.

    Attributes:
        actor, critic: in evaluation mode. They read normalised observations.
        normalizer: of ``humanoid_state``, as trained and frozen.
        config: resolved, of its run.
        path: the checkpoint.
    """

    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    normalizer: StateNormalizer
    config: dict[str, Any]
    path: Path


def load_policy(path: str | Path, which: str = "best") -> Policy:
    """The networks of a checkpoint whose visual context comes with the observation; no data is prepared or read.

    Args:
        path: a checkpoint folder or a run directory.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.

    Raises:
        InputError: the checkpoint is damaged, or its networks read a table of the data (``model.context.source``);
            names the field.
    """
    folder = find_checkpoint(path, which)
    config = read_json(folder, "config")
    settings = PolicySettings.from_config(config["model"])
    if settings.context.source not in ("frozen", "none"):
        cause = f"{settings.context.source} reads the features of its data: load_agent brings both"
        raise InputError(folder, "model.context.source", cause)
    saved: dict[str, dict[str, Any]] = {"policy": {}, "transforms": {}}
    parts = {name: ComponentState(dict, state.update) for name, state in saved.items()}
    metadata = RunCheckpoint(parts).restore(folder, set(parts))
    normalizer = _normalizer(saved["transforms"], folder)
    ahead, actions = len(config["task"].get("ahead", ())), int(metadata["action_size"])
    widths = _observation_widths(settings, saved["policy"], len(normalizer.mean), actions, ahead, folder)
    joints = HumanoidConfig.from_mapping(config["humanoid"]).skeleton().joints
    names = [f"{joint.name}_{number}" for joint in joints for number in range(len(joint.dofs))]
    actor = build_actor(settings, widths, actions, dof_names=names)
    critic = build_critic(settings, widths)
    RunCheckpoint({"policy": actor, "critic": critic}).restore(folder, {"policy", "critic"})
    return Policy(actor.eval(), critic.eval(), normalizer, config, folder)


def load_actor(path: str | Path, dataset: Dataset | None = None, which: str = "best") -> TensorDictModuleBase:
    """The actor of a checkpoint; data is prepared only where it reads a table of it.

    Args:
        path: a checkpoint folder or a run directory.
        dataset: to run on, as :func:`load_agent`; without one only the actor's weights are read where that will do.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.

    Raises:
        InputError: see :func:`load_policy` and :func:`load_agent`.
    """
    folder = find_checkpoint(path, which)
    if dataset is None and read_json(folder, "config")["model"]["context"]["source"] in ("frozen", "none"):
        return load_policy(folder).actor
    return load_agent(folder, dataset).actor


def _normalizer(state: Mapping[str, Any], folder: Path) -> StateNormalizer:
    """The frozen normaliser among the states of an environment's transforms."""
    prefixes = [key.removesuffix("sum_of_squares") for key in state if key.endswith(".sum_of_squares")]
    if len(prefixes) != 1:
        raise InputError(folder, "transforms", f"holds {len(prefixes)} normalisers where one is expected")
    values = {name: state[f"{prefixes[0]}{name}"] for name in ("count", "mean", "sum_of_squares")}
    normalizer = StateNormalizer(len(values["mean"]), frozen=True)
    normalizer.load_state_dict(values)
    return normalizer


def _observation_widths(
    settings: PolicySettings, actor: Mapping[str, Any], state_size: int, action_size: int, ahead: int, folder: Path
) -> dict[str, int]:
    """The size of each observation's last axis; that of a visual context is the rest of the actor's first layer.

    ``ahead`` frames of the target motion are in the window of a policy that reads one.
    """
    widths = {
        "humanoid_state": state_size,
        WINDOW: window_size(action_size, ahead),
        "tracking_error": 2 * state_size,
        "followed_targets": action_size,
        "time_left": 1,
    }
    known = state_size if settings.memory is None else settings.memory.hidden_size
    if unknown := set(settings.inputs) - set(widths):
        raise InputError(folder, "model.inputs", f"{sorted(unknown)[0]!r}: its width is not known without the data")
    known += sum(widths[key] for key in settings.inputs)
    if settings.context.source == "none":
        return widths
    first = next((value for key, value in actor.items() if key.endswith("mean.0.weight")), None)
    if first is None or first.ndim != 2 or first.shape[1] <= known:
        raise InputError(folder, "policy.mean.0.weight", "is no first layer of an actor of this configuration")
    return {**widths, "visual_context": first.shape[1] - known}


def _other_store(own: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Whether ``config`` asks for other data than a run's own. The same data in another folder is not other data."""

    def parts(one: Mapping[str, Any]) -> list[Any]:
        place = dict.fromkeys(("folder", "store"))
        return [{**one[group], **place} if group == "data" else one[group] for group in sorted(_STORE_GROUPS)]

    return bool(parts(own) != parts(config))
