"""The PPO update beside the collection it learns from, and where an iteration's time goes."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from egopose.benchmarks.iterations import Iterations, build_iterations
from egopose.collection.collectors import base_env


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Whole iterations of training on the default clips: collect, advantages, update.

    The context is noise: its values cost nothing. One more iteration, which does not count, is taken apart.

    Args:
        overrides: of the training configuration (``sim=fast algo.epochs=3``).
        rounds: iterations; the median of each figure counts.

    Returns:
        ``update_share``: of advantages and update in an iteration; ``collect_s``, ``advantages_s``, ``update_s``;
        ``rows`` of an iteration, ``gradient_steps``, ``control_steps_per_s`` of whole iterations, ``worlds``,
        ``substeps``; ``parts``: seconds of the iteration by part.

    Raises:
        InputError: a setting is unknown or out of range.
    """
    iterations = build_iterations(overrides)
    try:
        iterations.take()
        measured = [iterations.take() for _ in range(rounds)]
        parts = _taken_apart(iterations)
    finally:
        iterations.collector.shutdown()
    collect, advantages, update, rows = (statistics.median(column) for column in zip(*measured, strict=True))
    return {
        "update_share": statistics.median(1 - one.collect / one.seconds for one in measured),
        "collect_s": collect,
        "advantages_s": advantages,
        "update_s": update,
        "rows": int(rows),
        "gradient_steps": iterations.gradient_steps(int(rows)),
        "control_steps_per_s": statistics.median(one.steps / one.seconds for one in measured),
        "num_envs": iterations.settings.num_envs,
        "substeps": base_env(iterations.env).physics.substeps,
        "parts": parts,
    }


def _taken_apart(iterations: Iterations) -> dict[str, float]:
    """Seconds of one iteration by part, each without the parts inside it.

    In collection these are the acting thread's: the physics' threads work beside it, and ``waiting_for_physics`` is
    what they still need when it is through. ``other_environment`` is what is left of a step, ``collector`` TorchRL's
    own and the assembling of the batch,
    ``gradients`` the way back through the networks, ``kl`` the divergence that the step size follows.
    """
    spent: dict[str, float] = defaultdict(float)
    open_parts: list[str] = []

    def timed(owner: Any, name: str, part: str) -> None:
        inner = getattr(owner, name)

        def outer(*args: Any, **kwargs: Any) -> Any:
            if "losses" in open_parts:  # the networks inside the loss
                return inner(*args, **kwargs)
            open_parts.append(part)
            start = time.perf_counter()
            try:
                return inner(*args, **kwargs)
            finally:
                elapsed = time.perf_counter() - start
                open_parts.pop()
                spent[part] += elapsed
                if open_parts:
                    spent[open_parts[-1]] -= elapsed

        object.__setattr__(owner, name, outer)

    env, ppo, collector = iterations.env, iterations.ppo, iterations.collector
    base = env.base_env
    timed(collector.policy, "act", "policy")
    timed(collector, "postproc", "policy")  # the actions' probabilities
    timed(base, "_reward_waiting", "reward")
    timed(env, "end_step", "other_environment")
    timed(env, "begin_step", "other_environment")
    timed(base.physics, "end_step", "waiting_for_physics")
    timed(base.problem, "observation", "observation")
    timed(env.transform, "_step", "transforms")
    timed(env.transform, "_reset", "resets")
    timed(base, "begin", "resets")
    timed(ppo, "_losses", "losses")
    timed(ppo, "divergence", "kl")
    for optimiser in (ppo.policy_optimizer, ppo.value_optimizer):
        timed(optimiser, "step", "optimisers")
    collect, advantages, update, _ = iterations.take()
    in_update = ("losses", "kl", "optimisers")
    spent["gradients"] = update - sum(spent[part] for part in in_update)
    in_collection = set(spent) - {*in_update, "gradients"}
    spent["collector"] = collect - sum(spent[part] for part in in_collection)
    spent["advantages"] = advantages
    return dict(spent)
