"""Looking ahead beside the bare physics of the ways it tries."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from typing import Any

import torch

from egopose.benchmarks.raw_replay import RawReplay, StepRecorder
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.test_time import prepare_for_test
from egopose.inference.planners import build_planner, read_planner
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Plans of ``conf/planner`` for one body, evaluate's default, then the same control steps by ``mj_step`` alone.

    On the default clips, with untrained networks: what they cost does not depend on their weights' values.

    Args:
        overrides: of the training configuration (``sim=fast model=paper``); ``planner=NAME`` and ``planner.KEY=VALUE``
            are of the planner.
        rounds: of a second of frames each, interleaved; the median counts.

    Returns:
        ``plan_ms`` a frame, ``physics_ms`` of its control steps alone, ``ratio`` (the median round's), ``cpu_ratio``
        (of the processor's time, which other programs disturb less), ``control_steps`` a frame, ``substeps``,
        ``threads``, ``rounds``.

    Raises:
        InputError: a setting is unknown or out of range, or is for no planner.
    """
    ours = [word for word in overrides if word.startswith(("planner.", "planner="))]
    config = compose_config("train", ["sim=fast", *(word for word in overrides if word not in ours)])
    settings = read_planner(compose_config("evaluate", ["checkpoint=none", *ours])["planner"])
    if settings is None:
        raise InputError("bench plan", "planner", "none is no planner")
    threads = int(config["collector"]["physics_threads"])
    torch.set_num_threads(1)
    dataset = motion_dataset(config)
    options: dict[str, Any] = {"threads": threads, "whole_fragments": True, "falls_end": False}
    env = build_env(config, dataset, num_envs=1, **options)
    copies = build_env(config, dataset, num_envs=settings.samples, **options)
    actor, critic = build_networks(config, dataset, env)
    for one in (env, copies):
        prepare_for_test(one, actor, critic)
    env.reset()
    planner = build_planner(copies, actor, critic, settings)
    base, physics = env.base_env, copies.base_env.physics
    recorder, replay = StepRecorder(physics, in_turns=False), RawReplay(physics)

    frames = -(-30 // settings.every) * settings.every  # a second's, in whole plans
    planned, bare, ratios, cpu_ratios = [], [], [], []
    for _ in range(rounds + 1):
        recorder.clear()
        began, cpu = time.perf_counter(), time.process_time()
        for _ in range(frames):
            planner.perturbation(base)
        between, cpu_between = time.perf_counter(), time.process_time()
        seconds = replay.run(recorder.states, recorder.ctrls)
        planned.append(1e3 * (between - began) / frames)
        bare.append(1e3 * seconds / frames)
        ratios.append((between - began) / seconds)
        cpu_ratios.append((cpu_between - cpu) / (time.process_time() - cpu_between))
    replay.close()
    env.close()
    planner.close()
    columns = {"plan_ms": planned, "physics_ms": bare, "ratio": ratios, "cpu_ratio": cpu_ratios}
    return {
        **{name: statistics.median(column[1:]) for name, column in columns.items()},  # the first round warms up
        "control_steps": settings.control_steps,
        "substeps": physics.substeps,
        "threads": threads,
        "rounds": rounds,
    }
