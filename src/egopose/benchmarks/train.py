"""Whole iterations of training beside MuJoCo's own speed."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from typing import Any

from egopose.benchmarks.iterations import Parts, build_iterations
from egopose.benchmarks.raw_replay import compare_with_raw
from egopose.collection.collectors import base_env


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Iterations beside raw ``mj_step`` of the control steps they took, turn about.

    Args:
        overrides: of the training configuration (``sim=fast collector.num_envs=512``).
        rounds: of one iteration and its raw replay each; the median counts.

    Returns:
        ``of_raw``: control steps a second of whole iterations over those of raw ``mj_step``. ``cpu_of_raw``: the same
        by processor time, which other programs disturb less. Both rates. ``collect_share``, ``advantages_share`` and
        ``update_share`` of an iteration's time. What was measured: ``steps`` and ``gradient_steps`` of an iteration,
        ``epochs``, ``minibatch_size``, ``bfloat16`` (what ``algo.autocast`` comes to), ``num_envs``, ``substeps``,
        ``threads``, ``rounds``.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    iterations = build_iterations(overrides)
    taken: list[Parts] = []

    def take() -> Iterator[Parts]:
        while True:
            taken.append(iterations.take())
            yield taken[-1]

    try:
        result = compare_with_raw(take(), base_env(iterations.env).physics, rounds)
    finally:
        iterations.collector.shutdown()
    measured = taken[1:]  # the first warms up
    ppo = iterations.ppo
    return {
        "of_raw": result["ratio"],
        "cpu_of_raw": result["cpu_ratio"],
        "control_steps_per_s": result["control_steps_per_s"],
        "raw_steps_per_s": result["raw_steps_per_s"],
        **{
            f"{part}_share": statistics.median(getattr(one, part) / one.seconds for one in measured)
            for part in ("collect", "advantages", "update")
        },
        "steps": measured[0].steps,
        "gradient_steps": iterations.gradient_steps(measured[0].steps),
        "epochs": ppo.settings.epochs,
        "minibatch_size": ppo.settings.minibatch_size,
        "bfloat16": ppo.in_bfloat16,
        **{name: result[name] for name in ("num_envs", "substeps", "threads", "rounds")},
    }
