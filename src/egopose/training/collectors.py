"""From environments and a policy to batches ``[N, T]``, and the state of both for a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv

from egopose.config import from_mapping
from egopose.errors import InputError


@dataclass(frozen=True)
class CollectorSettings:
    """See ``conf/collector``.

    Args:
        kind: ``sync`` in this process, or ``multi_sync`` in ``workers`` processes.
        worlds: of one environment.
        physics_threads: of one environment.
        workers: processes, each with an environment of its own.
        threads: torch threads while collecting; physics has threads of its own.
        update_threads: torch threads while the networks are updated.
    """

    kind: str
    worlds: int
    physics_threads: int
    workers: int
    threads: int
    update_threads: int

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/collector") -> CollectorSettings:
        """Raises InputError: a key is missing, unknown or out of range."""
        settings = from_mapping(cls, values, source)
        if settings.kind not in ("sync", "multi_sync"):
            raise InputError(source, "kind", f"must be sync or multi_sync, not {settings.kind!r}")
        for name in ("worlds", "physics_threads", "workers", "threads", "update_threads"):
            if getattr(settings, name) < 1:
                raise InputError(source, name, f"must be at least 1, not {getattr(settings, name)}")
        return settings


def build_collector(
    settings: CollectorSettings,
    make_env: Callable[[int], EnvBase],
    policy: TensorDictModuleBase,
    steps_per_iteration: int,
) -> Collector:
    """A TorchRL collector that never ends; one iteration gives ``steps_per_iteration`` control steps over all worlds.

    ``make_env`` gets the worker's number, to seed by.

    ``track_traj_ids=False`` and ``device=None`` because they are the quickest (measured; see docs/howto-bench.md).
    """
    if settings.kind == "sync":
        return Collector(
            make_env(0),
            policy,
            frames_per_batch=steps_per_iteration,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
    return Collector(
        [partial(make_env, worker) for worker in range(settings.workers)],
        policy,
        backend="process",
        num_collectors=settings.workers,
        sync=True,
        frames_per_batch=steps_per_iteration,
        total_frames=-1,
        cat_results=0,
        auto_register_policy_transforms=False,
    )


def is_in_process(collector: Any) -> bool:
    """Whether the environment lives in this process, so that its state can be saved and set again."""
    return isinstance(getattr(collector, "env", None), EnvBase)


def base_env(env: EnvBase) -> EnvBase:
    """The environment under all its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def transform_state(collector: Any) -> Mapping[str, Any]:
    """State of the environment's transforms (the normaliser's statistics); of worker 0 with several processes."""
    if is_in_process(collector):
        return collector.env.state_dict()
    return collector.state_dict()["worker0"]["env_state_dict"]


def load_transform_state(collector: Any, state: Mapping[str, Any]) -> None:
    """Set it, in every process."""
    if is_in_process(collector):
        collector.env.load_state_dict(state)
        return
    worker_states = collector.state_dict()
    for name in worker_states:
        if name.startswith("worker"):
            worker_states[name]["env_state_dict"] = state
    collector.load_state_dict(worker_states)


def simulation_state(collector: Any) -> dict[str, Any]:
    """Where every world stands: the base environment's own state and what the policy will see next.

    Empty where the environments live in other processes; training then goes on from fresh episodes.
    """
    if not is_in_process(collector):
        return {}
    # TorchRL keeps the observation after the last step, and nothing else tells it, in `_carrier`.
    carrier: TensorDictBase = collector._carrier
    seen = {".".join(_path(key)): value.clone() for key, value in carrier.items(True, True)}
    return {"carrier": seen, "worlds": dict(base_env(collector.env).state_dict())}


def load_simulation_state(collector: Any, state: Mapping[str, Any]) -> None:
    """The opposite of :func:`simulation_state`; does nothing with an empty state.

    Raises:
        InputError: the environment does not take the state, being of another size.
    """
    if not state:
        return
    carrier: TensorDictBase = collector._carrier
    entries = {tuple(key.split(".")): value for key, value in state["carrier"].items()}
    try:
        base_env(collector.env).load_state_dict(state["worlds"])
        carrier.update(TensorDict(entries, batch_size=carrier.batch_size))
    except (ValueError, KeyError, RuntimeError) as error:
        raise InputError("simulation", "worlds", str(error)) from None


def set_threads(count: int) -> None:
    """Torch's threads inside an operator, from now on."""
    if torch.get_num_threads() != count:
        torch.set_num_threads(count)


def _path(key: Any) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)
