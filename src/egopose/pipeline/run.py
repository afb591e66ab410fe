"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from egopose.checkpoint.checkpoint import find_checkpoint, has_component, require, verify
from egopose.collection.collectors import CollectorSettings, build_collector, transform_state
from egopose.core.errors import InputError
from egopose.core.runtime import settle_heap
from egopose.envs.mdp.observations import humanoid_state
from egopose.models.recurrent import collecting_policy
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.training.adversarial import AdversarialPPO, DiscriminatorSettings
from egopose.training.loop import Evaluation, LoopSettings, Run, interrupts_held
from egopose.training.ppo import PPO, PPOSettings
from egopose.training.survival import frames_survived

_LOOP_IN_ALGO = ("iterations", "steps_per_iteration", "critic_first")
_LOOP_IN_TRAINING = ("total_steps", "max_seconds", "checkpoint_every", "keep_last", "evaluate_every")


def build_run(config: Mapping[str, Any], folder: Path, dataset: Dataset) -> Run:
    """The run ``config`` describes, not yet begun.

    Raises:
        InputError: a setting is missing, unknown or out of range.
    """
    algo, training = dict(config["algo"]), config["training"]
    algo.setdefault("critic_first", 0)  # runs from before this setting
    loop = {name: algo.pop(name, ...) for name in _LOOP_IN_ALGO}
    loop |= {name: training.get(name, ...) for name in _LOOP_IN_TRAINING}
    settings = LoopSettings.from_config(loop)
    dataset.keep_regressor(folder)
    dataset.keep_provenance(folder)
    collector_settings = CollectorSettings.from_config(config["collector"])
    ppo_settings = PPOSettings.from_config(algo)

    for seed in (torch.manual_seed, random.seed, np.random.seed):
        seed(int(config["seed"]) % 2**32)
    probe = build_env(config, dataset, num_envs=1)
    actor, critic = build_networks(config, dataset, probe)
    action_size = int(probe.action_spec.shape[-1])
    probe.close()
    with interrupts_held():
        collector = build_collector(
            collector_settings,
            partial(_training_env, config, dataset, collector_settings, folder),
            collecting_policy(actor, critic),
            settings.steps_per_iteration,
        )
    if "discriminator" in algo:
        ppo: PPO = _adversarial(config, dataset, actor, critic, ppo_settings)
    else:
        ppo = PPO(actor, critic, ppo_settings)
    settle_heap()
    return Run(ppo, collector, settings, collector_settings, folder, config, action_size)


def start_from(run: Run, path: str) -> None:
    """Begin with the policy, the normaliser and, where there is one, the critic of another run; not its optimisers.

    Args:
        run: not yet begun.
        path: a run directory, whose latest checkpoint is taken, or a checkpoint.

    Raises:
        InputError: there is no such run, or its networks are of another shape.
    """
    folder = find_checkpoint(path, "latest")
    require(verify(folder), folder, action_size=run.action_size)
    critic = {"critic"} if has_component(folder, "critic") else set()
    run.checkpoint().restore(folder, {"policy", "transforms"} | critic)
    run.collector.update_policy_weights_()


def _adversarial(
    config: Mapping[str, Any],
    dataset: Dataset,
    actor: TensorDictModuleBase,
    critic: TensorDictModuleBase,
    settings: PPOSettings,
) -> AdversarialPPO:
    """VGAIL's learner: the discriminator's examples are the reference's states on the training frames."""
    if dataset.visual_context is None or config["model"]["context"]["source"] != "frozen":
        raise InputError("configuration", "model.context.source", "a discriminator needs frozen visual context")
    offsets = dataset.takes.offsets
    frames = torch.cat([torch.arange(f.start, f.stop) + offsets[f.take] for f in dataset.train])
    states = humanoid_state(dataset.reference[frames]).float()
    discriminator = DiscriminatorSettings.from_config(config["algo"]["discriminator"])
    contexts, floor = torch.as_tensor(dataset.visual_context[frames]), float(config["regressor"]["std_floor"])
    return AdversarialPPO(actor, critic, settings, discriminator, states, contexts, floor)


def _training_env(
    config: Mapping[str, Any], dataset: Dataset, settings: CollectorSettings, folder: Path, worker: int
) -> TransformedEnv:
    return build_env(
        config,
        dataset,
        num_envs=settings.num_envs,
        threads=settings.physics_threads,
        seed=int(config["seed"]) * 1000 + worker,
        dump_dir=folder / "diverged",
    )


def build_evaluation(run: Run, dataset: Dataset) -> Evaluation:
    """A look at the mean action while training: frames survived on the test fragments, from starts that stay the same.

    Its ``score`` is the mean number of frames survived. A policy that follows a run's forecasts is looked at on the
    training fragments: there alone are forecasts, cross-fitted ones.
    """
    config = run.config
    training = config["training"]
    # Adaptive starts would seek out what falls, and each look would be harder than the one before.
    uniform = {**config, "task": {**config["task"], "starts": {"kind": "uniform"}}}
    env = build_env(
        uniform,
        dataset,
        "test" if dataset.forecasts is None else "train",
        num_envs=int(training["evaluation_num_envs"]),
        threads=int(config["collector"]["physics_threads"]),
    )

    def evaluate(iteration: int) -> dict[str, float]:
        env.load_state_dict(transform_state(run.collector))
        survival = frames_survived(env, copy.deepcopy(run.ppo.actor), int(training["evaluation_seed"]))
        return {"score": survival.mean, "falls": float(survival.fell.double().mean())}

    return evaluate
