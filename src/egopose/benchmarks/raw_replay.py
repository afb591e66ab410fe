"""How much of MuJoCo's own speed is left in the full collection loop."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from egopose.humanoid.physics import STATE, Array, BatchedPhysics


@dataclass
class StepRecorder:
    """Keeps the states and controls of every control step a physics takes while it is switched on.

    Args:
        physics: whose steps are kept.
        in_turns: whether ranges of worlds take turns, in order: a step is then one of all worlds. Else each range's is
            a step.
    """

    physics: BatchedPhysics
    in_turns: bool = True
    states: list[Array] = field(default_factory=list)
    ctrls: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        begin: Any = self.physics._begin
        parts: list[tuple[Array, Array]] = []

        def recorded(ctrl: Array, worlds: slice) -> Any:
            parts.append((self.physics.state[worlds].copy(), ctrl.copy()))
            if not self.in_turns or sum(len(part) for _, part in parts) == self.physics.num_envs:
                for record, columns in zip((self.states, self.ctrls), zip(*parts, strict=True), strict=True):
                    record.append(np.concatenate(columns))
                parts.clear()
            return begin(ctrl, worlds)

        self.physics._begin = recorded  # type: ignore[method-assign]

    def clear(self) -> None:
        """Forget what was recorded."""
        self.states.clear()
        self.ctrls.clear()


class RawReplay:
    """The same control steps by ``mj_step`` alone: as many threads, one ``MjData`` each (64 of them miss the cache).

    Every control step starts at the recorded state with the solver's warm start of the world's last step, so that the
    bodies do in it what they did in the loop, at the least cost.
    """

    def __init__(self, physics: BatchedPhysics) -> None:
        self._model, self._substeps = physics.model, physics.substeps
        self._warm_starts = np.zeros((physics.num_envs, physics.model.nv))
        # Every thread has its part of the first worlds too: some steps are of those alone.
        self._shares = [range(first, physics.num_envs, physics.threads) for first in range(physics.threads)]
        self._pool = ThreadPoolExecutor(physics.threads)

    def run(self, states: list[Array], ctrls: list[Array]) -> float:
        """Seconds to take the recorded steps of all worlds."""
        start = time.perf_counter()
        list(self._pool.map(lambda share: self._run_share(share, states, ctrls), self._shares))
        return time.perf_counter() - start

    def _run_share(self, worlds: range, states: list[Array], ctrls: list[Array]) -> None:
        model, substeps = self._model, self._substeps
        data = mujoco.MjData(model)
        held, warm = data.ctrl, data.qacc_warmstart
        for state, ctrl in zip(states, ctrls, strict=True):
            for i in range(worlds.start, len(state), worlds.step):
                mujoco.mj_setState(model, data, state[i], STATE)
                held[:], warm[:] = ctrl[i], self._warm_starts[i]
                mujoco.mj_step(model, data, substeps)
                self._warm_starts[i] = warm

    def close(self) -> None:
        """Stop the threads."""
        self._pool.shutdown()


def compare_with_raw(batches: Iterator[Any], physics: BatchedPhysics, rounds: int) -> dict[str, float | int]:
    """Collection beside raw ``mj_step`` of the same model, substeps, threads and states, turn about.

    Args:
        batches: a collector's iterator over batches; one is drawn a round, and one before the first to warm up.
        physics: that the collector's environment steps.
        rounds: of one collected batch and its raw replay each.

    Returns:
        ``ratio`` (the median round's), ``cpu_ratio`` (of the processor's time in the place of the clock's, which other
        programs disturb less), ``control_steps_per_s``, ``raw_steps_per_s`` (medians), ``substeps``, ``worlds``,
        ``threads``, ``rounds``.
    """
    recorder, replay = StepRecorder(physics), RawReplay(physics)
    next(batches)
    loop_rates, raw_rates, cpu_ratios = [], [], []
    for _ in range(rounds):
        recorder.clear()
        start, cpu = time.perf_counter(), time.process_time()
        next(batches)
        elapsed, between = time.perf_counter() - start, time.process_time()
        steps = len(recorder.states) * physics.num_envs
        loop_rates.append(steps / elapsed)
        raw_rates.append(steps / replay.run(recorder.states, recorder.ctrls))
        cpu_ratios.append((time.process_time() - between) / (between - cpu))
    replay.close()
    return {
        "ratio": statistics.median(a / b for a, b in zip(loop_rates, raw_rates, strict=True)),
        "cpu_ratio": statistics.median(cpu_ratios),
        "control_steps_per_s": statistics.median(loop_rates),
        "raw_steps_per_s": statistics.median(raw_rates),
        "substeps": physics.substeps,
        "num_envs": physics.num_envs,
        "threads": physics.threads,
        "rounds": rounds,
    }
