"""From environments and a policy to batches ``[N, T]``, and the state of both for a checkpoint."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from egopose.collection.env_groups import GroupedCollector
from egopose.collection.lazy_rewards import Completion, GaussianSampler, draws_otherwise
from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.collection.workers import Workers, base_env, read_simulation, write_simulation
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.torch_settings import enable_onednn_matmul
from egopose.models.recurrent import is_recurrent

__all__ = [
    "CollectorSettings",
    "SlowPolicyWarning",
    "base_env",
    "build_collector",
    "load_simulation_state",
    "load_transform_state",
    "set_threads",
    "simulation_state",
    "transform_state",
]


class SlowPolicyWarning(UserWarning):
    """A policy cannot be called in the quick way."""


KINDS = ("sync", "multi_sync", "ray")


@dataclass(frozen=True)
class CollectorSettings:
    """See ``conf/collector``.

    Args:
        kind: ``sync`` in this process; ``multi_sync`` in processes, ``ray`` on machines of a Ray cluster: see
            :class:`egopose.collection.workers.Workers`.
        num_envs: of one environment.
        physics_threads: of one environment.
        workers: processes, each with an environment of its own.
        threads: torch threads while collecting; physics has threads of its own.
        update_threads: torch threads while the networks are updated.
        env_groups: groups of environments of ``sync`` that take turns, see
            :class:`egopose.collection.env_groups.GroupedCollector`. 1 steps all at once. None is 2 from
            ``env_groups_from`` physics steps a control step on, where turns cost less than they hide, and 1 below.
        env_groups_from: see ``env_groups``.
        address: of the Ray cluster, see :class:`egopose.collection.workers.Workers`.
        fast: of ``sync``: False collects by TorchRL's own rollout, with the same numbers at more expense.
    """

    kind: str
    num_envs: int
    physics_threads: int
    workers: int
    threads: int
    update_threads: int
    env_groups: int | None = 1
    env_groups_from: int = 8
    address: str | None = None
    fast: bool = True

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/collector") -> CollectorSettings:
        """Raises InputError: a key is missing, unknown or out of range."""
        settings = from_mapping(cls, values, source)
        if settings.kind not in KINDS:
            raise InputError(source, "kind", f"must be one of {', '.join(KINDS)}, not {settings.kind!r}")
        for name in (
            "num_envs",
            "physics_threads",
            "workers",
            "threads",
            "update_threads",
            "env_groups",
            "env_groups_from",
        ):
            if (value := getattr(settings, name)) is not None and value < 1:
                raise InputError(source, name, f"must be at least 1, not {value}")
        if settings.env_groups is not None and settings.env_groups > settings.num_envs:
            raise InputError(
                source, "env_groups", f"must be at most the worlds, {settings.num_envs}, not {settings.env_groups}"
            )
        return settings


def build_collector(
    settings: CollectorSettings,
    make_env: Callable[[int], EnvBase],
    policy: TensorDictModuleBase,
    steps_per_iteration: int,
) -> Collector | Workers:
    """An endless collector; one iteration gives ``steps_per_iteration`` control steps over all environments.

    ``make_env`` gets the worker's number, to seed by. ``sync`` takes the quick path (:mod:`egopose.collection`) unless
    ``settings.fast`` is off. It warns where a policy without a memory cannot be called in that way, with the reason.

    ``track_traj_ids=False`` and ``device=None`` because they are the quickest (measured; see docs/howto-bench.md).
    """
    enable_onednn_matmul()
    if settings.kind == "sync":
        env = make_env(0)
        if not settings.fast:
            return _torchrl_collector(env, policy, steps_per_iteration)
        reason = draws_otherwise(policy)
        acting = GaussianSampler(policy) if reason is None else policy
        collector: Callable[..., Collector] = Collector
        if isinstance(env, TransformedEgoPoseEnv):
            env.make_rewards_lazy()
            reason = acting.needs_tensordicts() if isinstance(acting, GaussianSampler) else reason
            if reason is None:
                env_groups = settings.env_groups or min(
                    settings.num_envs, 1 + (env.base_env.physics.substeps >= settings.env_groups_from)
                )
                collector = partial(GroupedCollector, env_groups=env_groups)
            elif not is_recurrent(policy):  # a memory is handed on in TorchRL's own way
                _warn_of_slow_policy(reason)
        return collector(
            env,
            acting,
            frames_per_batch=steps_per_iteration,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            postproc=Completion(env, acting),
        )
    return Workers(
        settings.kind,
        make_env,
        policy,
        workers=settings.workers,
        num_envs=settings.num_envs,
        steps_per_iteration=steps_per_iteration,
        threads=settings.threads,
        cpus=settings.physics_threads,
        address=settings.address,
    )


def _torchrl_collector(env: EnvBase, policy: TensorDictModuleBase, steps_per_iteration: int) -> Collector:
    """TorchRL's collector and its own way through an environment, step by step."""
    if isinstance(env, TransformedEgoPoseEnv):
        env.fast = False
    return Collector(
        env,
        policy,
        frames_per_batch=steps_per_iteration,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


def _warn_of_slow_policy(reason: str) -> None:
    """Once a reason and process, as warnings are."""
    warnings.warn(
        f"the policy is called in TorchRL's own way, which takes longer than the quick one: {reason}",
        SlowPolicyWarning,
        stacklevel=3,
    )


def transform_state(collector: Any) -> Mapping[str, Any]:
    """State of the environment's transforms: the normaliser's statistics of everything collected, by all workers."""
    return collector.transforms if isinstance(collector, Workers) else collector.env.state_dict()


def load_transform_state(collector: Any, state: Mapping[str, Any]) -> None:
    """Set it, in every process. With workers, before the first batch only."""
    if isinstance(collector, Workers):
        collector.load_transform_state(state)
    else:
        collector.env.load_state_dict(state)


def simulation_state(collector: Any) -> dict[str, Any]:
    """The state of every environment: the base environment's own, and the policy's next observation.

    With workers, that of each at the end of its last batch.
    """
    if isinstance(collector, Workers):
        return {f"worker{number}": state for number, state in enumerate(collector.simulation)}
    return read_simulation(collector)


def load_simulation_state(collector: Any, state: Mapping[str, Any]) -> None:
    """The opposite of :func:`simulation_state`. With workers, before the first batch only.

    Raises:
        InputError: the environments do not take the state, being of another size or number.
    """
    try:
        if isinstance(collector, Workers):
            collector.load_simulation_state([state[f"worker{number}"] for number in range(len(state))])
        else:
            # Runs from before rewards were deferred kept the last step's terms among what the policy sees.
            here = simulation_state(collector)["carrier"]
            seen = {
                key: value
                for key, value in state["carrier"].items()
                if key in here or not key.startswith("reward_terms.")
            }
            write_simulation(collector, {**state, "carrier": seen})
    except (ValueError, KeyError, RuntimeError) as error:
        raise InputError("simulation", "worlds", str(error)) from None


def set_threads(count: int) -> None:
    """Torch's threads inside an operator, from now on."""
    if torch.get_num_threads() != count:
        torch.set_num_threads(count)
