"""Whole iterations of training as the benchmarks take them: collect, advantages, update."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase

from egopose.collection.collectors import CollectorSettings, build_collector, set_threads
from egopose.core.config import compose_config
from egopose.core.runtime import settle_heap
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.training.ppo import PPO, PPOSettings


class Parts(NamedTuple):
    """Seconds of an iteration by its three parts, and the control steps it took."""

    collect: float
    advantages: float
    update: float
    steps: int

    @property
    def seconds(self) -> float:
        """Of the whole iteration."""
        return self.collect + self.advantages + self.update


@dataclass
class Iterations:
    """What training is made of, without logs and checkpoints; :meth:`take` goes on by an iteration."""

    env: Any
    ppo: PPO
    collector: Any
    settings: CollectorSettings
    _batches: Iterator[TensorDictBase]

    def take(self) -> Parts:
        """One iteration."""
        clock = [time.perf_counter()]
        set_threads(self.settings.threads)
        batch = next(self._batches)
        clock.append(time.perf_counter())
        set_threads(self.settings.update_threads)
        rows = self.ppo.advantages(batch)
        clock.append(time.perf_counter())
        self.ppo.update(rows)
        clock.append(time.perf_counter())
        collect, advantages, update = (after - before for before, after in pairwise(clock))
        return Parts(collect, advantages, update, batch.numel())

    def gradient_steps(self, rows: int) -> int:
        """Of an iteration over so many rows."""
        size = self.ppo.settings.minibatch_size
        return self.ppo.settings.epochs * (1 if size is None else max(1, rows // size))


def build_iterations(overrides: Sequence[str]) -> Iterations:
    """Training on the default clips at ``sim=paper``; the context is noise, whose values cost nothing.

    Args:
        overrides: of the training configuration (``sim=fast algo.epochs=3``).

    Raises:
        InputError: a setting is unknown or out of range.
    """
    config = compose_config("train", ["sim=paper", *overrides])
    dataset = motion_dataset(config)
    settings = CollectorSettings.from_config(config["collector"])
    torch.manual_seed(0)
    set_threads(settings.threads)
    env = build_env(config, dataset, num_envs=settings.num_envs, threads=settings.physics_threads)
    actor, critic = build_networks(config, dataset, env)
    ppo = PPO(actor, critic, PPOSettings.from_config(config["algo"]))
    collector = build_collector(settings, lambda _: env, actor, int(config["algo"]["steps_per_iteration"]))
    settle_heap()
    return Iterations(env, ppo, collector, settings, iter(collector))
