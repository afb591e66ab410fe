"""The PPO update beside the collection it learns from, and where an iteration's time goes."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch

from egopose.collection.collectors import CollectorSettings, base_env, build_collector, set_threads
from egopose.core.config import compose_config
from egopose.core.runtime import settle_heap
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.training.ppo import PPO, PPOSettings


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
    batches = iter(collector)

    def iterate() -> tuple[float, float, float, int]:
        clock = [time.perf_counter()]
        set_threads(settings.threads)
        batch = next(batches)
        clock.append(time.perf_counter())
        set_threads(settings.update_threads)
        rows = ppo.advantages(batch)
        clock.append(time.perf_counter())
        ppo.update(rows)
        clock.append(time.perf_counter())
        return clock[1] - clock[0], clock[2] - clock[1], clock[3] - clock[2], len(rows)

    try:
        iterate()
        measured = [iterate() for _ in range(rounds)]
        collect, advantages, update, rows = (statistics.median(column) for column in zip(*measured, strict=True))
        parts = _taken_apart(iterate, env, ppo, collector)
    finally:
        collector.shutdown()
    per_epoch = 1 if ppo.settings.minibatch_size is None else max(1, int(rows) // ppo.settings.minibatch_size)
    return {
        "update_share": statistics.median((a + u) / (c + a + u) for c, a, u, _ in measured),
        "collect_s": collect,
        "advantages_s": advantages,
        "update_s": update,
        "rows": int(rows),
        "gradient_steps": ppo.settings.epochs * per_epoch,
        "control_steps_per_s": statistics.median(n / (c + a + u) for c, a, u, n in measured),
        "num_envs": settings.num_envs,
        "substeps": base_env(env).physics.substeps,
        "parts": parts,
    }


def _taken_apart(
    iterate: Callable[[], tuple[float, float, float, int]], env: Any, ppo: Any, collector: Any
) -> dict[str, float]:
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
    collect, advantages, update, _ = iterate()
    in_update = ("losses", "kl", "optimisers")
    spent["gradients"] = update - sum(spent[part] for part in in_update)
    in_collection = set(spent) - {*in_update, "gradients"}
    spent["collector"] = collect - sum(spent[part] for part in in_collection)
    spent["advantages"] = advantages
    return dict(spent)
