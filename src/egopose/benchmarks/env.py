"""The environment beside MuJoCo's own speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from egopose.benchmarks.raw_replay import compare_with_raw
from egopose.collection.collectors import CollectorSettings, base_env, build_collector, set_threads
from egopose.core.config import compose_config
from egopose.core.runtime import settle_heap
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """The full collection loop beside raw ``mj_step`` of the same model, substeps, threads and states.

    The loop is training's own: policy network, physics, observation, reward, termination, resets, visual context,
    normaliser and TorchRL's collector, on the default clips. The context is noise: its values cost nothing.

    Args:
        overrides: of the training configuration (``sim=fast collector.num_envs=32``).
        rounds: interleaved; the median counts.

    Returns:
        See :func:`egopose.benchmarks.raw_replay.compare_with_raw`.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    config = compose_config("train", ["sim=paper", *overrides])
    dataset = motion_dataset(config)
    settings = CollectorSettings.from_config(config["collector"])
    set_threads(settings.threads)
    env = build_env(config, dataset, num_envs=settings.num_envs, threads=settings.physics_threads)
    actor, _ = build_networks(config, dataset, env)
    collector = build_collector(settings, lambda _: env, actor, int(config["algo"]["steps_per_iteration"]))
    settle_heap()
    try:
        return compare_with_raw(iter(collector), base_env(env).physics, rounds)
    finally:
        collector.shutdown()
