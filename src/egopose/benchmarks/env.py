"""The environment beside MuJoCo's own speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from egopose.benchmarks.raw_replay import StepRecorder, compare_with_raw
from egopose.benchmarks.scene_boxes import box_count, compare_with_boxes
from egopose.collection.collectors import CollectorSettings, base_env, build_collector, set_threads
from egopose.core.config import compose_config
from egopose.core.runtime import settle_heap
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks

_BOX_STEPS = 32  # control steps of all worlds, of a collected batch


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """The full collection loop beside raw ``mj_step`` of the same model, substeps, threads and states.

    The loop is training's own: policy network, physics, observation, reward, termination, resets, visual context,
    normaliser and TorchRL's collector, on the default clips. The context is noise: its values cost nothing.

    Args:
        overrides: of the training configuration (``sim=fast collector.num_envs=32``); ``scene.boxes=K`` also takes a
            batch's control steps among K boxes, beside the bare ones.
        rounds: interleaved; the median counts.

    Returns:
        See :func:`egopose.benchmarks.raw_replay.compare_with_raw`, and with boxes
        :func:`egopose.benchmarks.scene_boxes.compare_with_boxes`.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    ours = [word for word in overrides if word.startswith("scene.")]
    boxes = box_count(ours)
    config = compose_config("train", ["sim=paper", *(word for word in overrides if word not in ours)])
    dataset = motion_dataset(config)
    settings = CollectorSettings.from_config(config["collector"])
    set_threads(settings.threads)
    env = build_env(config, dataset, num_envs=settings.num_envs, threads=settings.physics_threads)
    actor, _ = build_networks(config, dataset, env)
    collector = build_collector(settings, lambda _: env, actor, int(config["algo"]["steps_per_iteration"]))
    settle_heap()
    batches, physics = iter(collector), base_env(env).physics
    try:
        result: dict[str, Any] = compare_with_raw(batches, physics, rounds)
        if boxes is not None:
            recorder = StepRecorder(physics)
            next(batches)
            steps = recorder.states[:_BOX_STEPS], recorder.ctrls[:_BOX_STEPS]
            result |= compare_with_boxes(dataset.humanoid, boxes, *steps, physics.threads, rounds)
        return result
    finally:
        collector.shutdown()
