"""What each part of an iteration costs on this machine, for the model of many cores in ``experiments/scaling``.

Parts that one thread computes are timed by the processor's clock, which others' work on the machine hardly moves; what
several processes do together by the wall's, of which the quickest round counts.
"""

from __future__ import annotations

import io
import os
import pickle
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import MemoryMappedTensor, TensorDictBase
from torchrl.envs import EnvBase

from egopose.benchmarks.process_memory import mapped_mb, private_mb, proportional_mb
from egopose.collection.collectors import CollectorSettings, base_env, build_collector, set_threads
from egopose.core.config import compose_config
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.training.ppo import PPO, PPOSettings

_WORLDS = (8, 32, 64)  # batch sizes between which the Python part's fixed and growing costs are told apart
_STEPS = 48  # batched steps a measurement of collection
_POOLS = (1, 2, 4)  # workers
_FEATURE_ROWS = 400_000  # of 128 float32: 195 MiB, 3.7 hours at 30 Hz
_REPEATS = 20  # of what takes milliseconds


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Cost of every part, in seconds, each measured by itself; and whole iterations with 1 and 2 workers beside them.

    Args:
        overrides: of the training configuration (``sim=paper algo.epochs=10``).
        rounds: of whole iterations; the quickest counts.

    Returns:
        ``physics_s`` a world and control step, one thread, with its spread ``physics_cv`` over batched steps of 32
        worlds (deviation over mean); ``python_fixed_s`` and ``python_world_s`` a batched step: observation, reward,
        resets, transforms, TorchRL; ``policy_fixed_s``, ``policy_world_s`` likewise; ``join_s`` a frame: the pieces of
        workers of this machine made one batch; ``pack_s``, ``unpack_s`` and ``frame_bytes`` a frame: between machines;
        ``weights_s`` and ``exchange_s`` a worker and iteration, ``weights_bytes``, ``exchange_bytes``;
        ``gae_s`` a row, ``update_s`` a row and epoch, on one thread; ``epochs``, ``minibatch_size``,
        ``steps_per_iteration``, ``worlds`` (of a worker), ``substeps``.
        ``measured_sync_1``, ``measured_multi_sync_2`` ...: control steps/s of whole iterations, with the kind and the
        workers; ``worked_sync_1`` ...: those that the processor time of the same iterations (the busiest worker's and
        the learner's) allows where no one else uses the machine. ``workers_mb_N``: memory of N workers together (PSS);
        ``worker_private_mb_N``: what each holds for itself; ``features_mb``: a memory-mapped table all of whose rows
        each worker reads; ``features_copied_mb_N``: the most that one worker holds of it for itself;
        ``problem_frame_bytes``: what each environment holds for itself of every frame of reference motion.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    config = compose_config("train", ["collector=multi_sync", "collector.update_threads=1", *overrides])
    dataset = motion_dataset(config)
    settings = CollectorSettings.from_config(config["collector"])
    algo = config["algo"]
    make_env = partial(_make_env, config, dataset)
    set_threads(settings.threads)

    out: dict[str, Any] = {
        "num_envs": settings.num_envs,
        "epochs": int(algo["epochs"]),
        "minibatch_size": algo["minibatch_size"],
        "steps_per_iteration": int(algo["steps_per_iteration"]),
    }
    env = make_env(settings.num_envs, 0)
    torch.manual_seed(0)
    actor, critic = build_networks(config, dataset, env)
    out["substeps"] = env.base_env.physics.substeps
    out["problem_frame_bytes"] = _own_frame_bytes(env.base_env.problem)
    out |= _collection(make_env, actor)
    ppo = PPO(actor, critic, PPOSettings.from_config(algo))
    batch = _batch(make_env, actor, int(algo["steps_per_iteration"]), settings.num_envs)
    out |= _transfer(batch)
    out |= _learning(ppo, batch, rounds)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "features.memmap"
        width = dataset.visual_context.shape[1]  # type: ignore[union-attr]
        table = MemoryMappedTensor.zeros((_FEATURE_ROWS, width), dtype=torch.float32, filename=str(file))
        out["features_mb"] = file.stat().st_size / 2**20
        mapped = partial(_make_env, config, replace(dataset, visual_context=table))
        for count in _POOLS:
            out |= _workers(count, replace(settings, workers=count), mapped, ppo, file, out, rounds)
    return out | _whole_iterations("sync_1", replace(settings, kind="sync", workers=1), make_env, ppo, out, rounds)


def _make_env(config: Mapping[str, Any], dataset: Any, num_envs: int, number: int) -> EnvBase:

    # Every row is read, as in hours of training.
    float(dataset.visual_context.sum())
    return build_env(config, dataset, num_envs=num_envs, threads=1, seed=number)


def _own_frame_bytes(problem: Any) -> float:
    """Bytes a frame of the tables that a problem has made for itself."""
    held = vars(problem).values()
    tables = [table for one in held for table in (one.values() if isinstance(one, dict) else [one])]
    own = [t for t in tables if isinstance(t, torch.Tensor) and not isinstance(t, MemoryMappedTensor)]
    return float(sum(t[0].numel() * t.element_size() for t in own if t.ndim and len(t) == problem.n_frames))


def _worked_s(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _cpu_s(act: Callable[[], Any], repeats: int) -> float:
    """Median seconds of this process's processor time."""
    return statistics.median(_times(act, repeats, time.process_time))


def _quickest_s(act: Callable[[], Any], repeats: int) -> float:
    """Shortest seconds by the wall's clock."""
    return min(_times(act, repeats, time.perf_counter))


def _times(act: Callable[[], Any], repeats: int, clock: Callable[[], float]) -> list[float]:
    times = []
    for _ in range(repeats):
        start = clock()
        act()
        times.append(clock() - start)
    return times


def _collection(make_env: Callable[[int, int], EnvBase], actor: Any) -> dict[str, float]:
    """Physics, Python and policy in this process with one thread, at several batch sizes."""
    physics, python, policy = {}, {}, {}
    for worlds in _WORLDS:
        env = make_env(worlds, 0)
        engine = base_env(env).physics
        steps: list[float] = []
        collector = build_collector(_sync(worlds), lambda _, env=env: env, actor, worlds * _STEPS)  # type: ignore[misc]
        take = engine._run

        def timed(numbers: Any, take: Any = take, steps: list[float] = steps) -> None:
            start = time.thread_time()
            take(numbers)
            steps.append(time.thread_time() - start)

        engine._run = timed
        batches = iter(collector)
        batch = next(batches)
        steps.clear()
        whole = _cpu_s(lambda batches=batches: next(batches), 3) / _STEPS  # type: ignore[misc]
        seen = batch[:, 0].select(*actor.in_keys)
        with torch.no_grad():
            policy[worlds] = _cpu_s(lambda seen=seen: actor(seen.copy()), _REPEATS)  # type: ignore[misc]
        physics[worlds] = np.array(steps)
        python[worlds] = whole - float(physics[worlds].mean()) - policy[worlds]
        collector.shutdown()
    sizes = np.array(_WORLDS, dtype=float)
    python_world, python_fixed = np.polyfit(sizes, [python[n] for n in _WORLDS], 1)
    policy_world, policy_fixed = np.polyfit(sizes, [policy[n] for n in _WORLDS], 1)
    middle = physics[_WORLDS[1]]
    return {
        "physics_s": float(np.median(middle)) / _WORLDS[1],
        "physics_cv": float(middle.std() / middle.mean()),
        "python_fixed_s": float(python_fixed),
        "python_world_s": max(float(python_world), 0.0),
        "policy_fixed_s": float(policy_fixed),
        "policy_world_s": max(float(policy_world), 0.0),
    }


def _sync(num_envs: int) -> Any:

    return CollectorSettings("sync", num_envs, 1, 1, 1, 1)


def _batch(make_env: Callable[[int, int], EnvBase], actor: Any, steps: int, num_envs: int) -> TensorDictBase:

    collector = build_collector(_sync(num_envs), lambda number: make_env(num_envs, number), actor, steps)
    try:
        return next(iter(collector)).clone()
    finally:
        collector.shutdown()


def _transfer(batch: TensorDictBase) -> dict[str, float]:
    """A batch between processes of one machine (copied together) and between machines (packed, unpacked)."""
    halves = batch.chunk(2)
    packed = io.BytesIO()
    pickle.dump(batch, packed, protocol=5)
    data = packed.getvalue()
    frames = batch.numel()
    return {
        "join_s": _cpu_s(lambda: torch.cat(halves), _REPEATS) / frames,
        "pack_s": _cpu_s(lambda: pickle.dumps(batch, protocol=5), 5) / frames,
        "unpack_s": _cpu_s(lambda: pickle.loads(data), 5) / frames,
        "frame_bytes": len(data) / frames,
    }


def _learning(ppo: Any, batch: TensorDictBase, rounds: int) -> dict[str, float]:
    rows = ppo.advantages(batch.clone())
    gae = _cpu_s(lambda: ppo.advantages(batch.clone()), rounds) - _cpu_s(batch.clone, rounds)
    update = _cpu_s(lambda: ppo.update(rows), rounds)
    return {"gae_s": gae / len(rows), "update_s": update / len(rows) / ppo.settings.epochs}


def _workers(
    count: int, settings: Any, make_env: Any, ppo: Any, file: Path, known: Mapping[str, Any], rounds: int
) -> dict[str, float]:
    """Memory of so many workers, what it costs to speak to them, and whole iterations where each has a core."""
    steps = int(known["steps_per_iteration"])
    pool = build_collector(settings, partial(make_env, settings.num_envs), ppo.actor, steps)
    try:
        batches = iter(pool)
        next(batches)
        pids = [process.pid for process in pool._collector.procs]
        copied = [mapped_mb(pid, file) for pid in pids]
        assert all(resident > 0.99 * known["features_mb"] for resident, _ in copied)
        out = {
            f"workers_mb_{count}": sum(map(proportional_mb, pids)),
            f"worker_private_mb_{count}": max(map(private_mb, pids)),
            f"features_copied_mb_{count}": max(altered for _, altered in copied),
        }
        if count == 2:
            out["weights_s"] = _quickest_s(pool.update_policy_weights_, _REPEATS) / count
            out["exchange_s"] = _quickest_s(pool._exchange_all, _REPEATS) / count
            out["weights_bytes"] = float(sum(p.numel() * p.element_size() for p in ppo.actor.parameters()))
            state = (pool.transforms, pool.simulation[0])
            out["exchange_bytes"] = float(len(pickle.dumps(state, protocol=5)))
        if count <= 2:
            out |= _rate(f"multi_sync_{count}", pool, batches, ppo, settings, rounds)
        return out
    finally:
        pool.shutdown()


def _whole_iterations(
    name: str, settings: Any, make_env: Any, ppo: Any, known: Mapping[str, Any], rounds: int
) -> dict[str, float]:

    steps = int(known["steps_per_iteration"])
    collector = build_collector(settings, partial(make_env, settings.num_envs), ppo.actor, steps)
    try:
        batches = iter(collector)
        next(batches)
        return _rate(name, collector, batches, ppo, settings, rounds)
    finally:
        collector.shutdown()


def _rate(name: str, collector: Any, batches: Any, ppo: Any, settings: Any, rounds: int) -> dict[str, float]:
    """Control steps/s of iterations as training takes them; ``name`` is the kind and the workers."""
    pids = [process.pid for process in getattr(getattr(collector, "_collector", None), "procs", ())]
    frames = 0

    def iterate() -> None:
        nonlocal frames
        set_threads(settings.threads)
        batch = next(batches)
        set_threads(settings.update_threads)
        ppo.update(ppo.advantages(batch))
        collector.update_policy_weights_()
        frames = batch.numel()

    begun, here = [_worked_s(pid) for pid in pids], time.process_time()
    seconds = _quickest_s(iterate, rounds)
    learner = (time.process_time() - here) / rounds
    workers = [(_worked_s(pid) - start) / rounds for pid, start in zip(pids, begun, strict=True)]
    set_threads(settings.threads)
    needed = max(workers, default=0.0) + learner
    return {f"measured_{name}": frames / seconds, f"worked_{name}": frames / needed}
