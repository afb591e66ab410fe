"""Environments in processes of their own, on this machine or on many: one collector over TorchRL's two.

The learner sends messages only between two batches, while a worker is idle: TorchRL's busy workers drop their batch
when a message arrives. The worker then gives the statistics of its normaliser and the state of its environments. It
gets the statistics of all workers back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase, TransformedEnv

from egopose.collection.moments import merge_states, without_counts
from egopose.collection.stepping import key_path
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.core.torch_settings import enable_onednn_matmul

State = dict[str, Any]

#: Ray's collector ends at a number of frames and takes no "never"; at a million a second this is 290 thousand years.
_ENDLESS = 2**63 - 1


class WorkerLost(RuntimeError):
    """A process that collects has ended."""


def base_env(env: EnvBase) -> EnvBase:
    """The environment under all its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def read_simulation(collector: Collector) -> State:
    """The state of every environment of a collector, and the policy's next observation."""
    # TorchRL keeps the observation after the last step, and nothing else tells it, in `_carrier`. Beside it stand the
    # numbers of the episodes: workers draw them from one pool, whoever comes first, and nothing here reads them.
    # Sorted: in which order they stand depends on how often the worlds were stepped.
    seen = {".".join(key_path(key)): value.clone() for key, value in collector._carrier.items(True, True)}
    seen = {name: seen[name] for name in sorted(seen) if not name.startswith("collector.")}
    return {"carrier": seen, "worlds": dict(base_env(collector.env).state_dict())}


def write_simulation(collector: Collector, state: Mapping[str, Any]) -> None:
    """The opposite of :func:`read_simulation`.

    Raises:
        ValueError, KeyError, RuntimeError: the environment does not take the state, being of another size.
    """
    carrier: TensorDictBase = collector._carrier
    entries = {tuple(key.split(".")): value for key, value in state["carrier"].items()}
    base_env(collector.env).load_state_dict(state["worlds"])
    carrier.update(TensorDict(entries, batch_size=carrier.batch_size))


class WorkerCollector(Collector):
    """The collector inside a worker, with what the learner asks of it between two batches."""

    def report(self) -> State:
        """``transforms``: state of the environment's transforms; ``simulation``: worlds, what the policy sees next, and
        the random numbers (``rng``) its actions are drawn by. All packed.
        """
        simulation = {**read_simulation(self), "rng": torch.get_rng_state()}
        return _packed({"transforms": dict(self.env.state_dict()), "simulation": simulation})

    def load_transform_state(self, packed: State) -> None:
        """Set what a report gives as ``transforms``."""
        self.env.load_state_dict(_unpacked(packed))

    def load_simulation_state(self, packed: State) -> None:
        """Set what a report gives as ``simulation``."""
        state = _unpacked(packed)
        write_simulation(self, state)
        torch.set_rng_state(state["rng"])

    def policy_state(self) -> State:
        """The parameters it acts by, packed."""
        return _packed(self.policy.state_dict())


class Workers:
    """Batches ``[workers * worlds, T]`` from environments in other processes; see ``conf/collector``.

    Args:
        kind: ``multi_sync``: processes of this machine. ``ray``: on any machine of a Ray cluster. With both all workers
            are in step, on the newest weights.
        make_env: makes the environment of the worker of that number, in its process.
        policy: whose parameters :meth:`update_policy_weights_` sends.
        workers: how many.
        num_envs: of each environment.
        steps_per_iteration: control steps an iteration, over all workers; rounded up to whole steps of all worlds.
        threads: of torch in a worker.
        cpus: that Ray keeps for a worker.
        address: of the Ray cluster, ``auto`` for the one this machine belongs to; None starts one here.

    Raises:
        InputError: Ray is not installed, not found, or has not the cores.
    """

    def __init__(
        self,
        kind: str,
        make_env: Callable[[int], EnvBase],
        policy: TensorDictModuleBase,
        *,
        workers: int,
        num_envs: int,
        steps_per_iteration: int,
        threads: int,
        cpus: int,
        address: str | None = None,
    ) -> None:
        self.kind, self.policy, self.count = kind, policy, workers
        self._end_ray: Callable[[], None] | None = None
        frames = -(-steps_per_iteration // (workers * num_envs)) * num_envs
        # Each process would begin with the same random numbers otherwise, and all draw the same actions.
        makers = [partial(_seeded, make_env, torch.initial_seed(), number) for number in range(workers)]
        if kind == "ray":
            self._end_ray = _join_ray(workers * cpus, address)
            self._collector = _ray_collector(makers, policy, frames, threads, cpus)
        else:
            self._collector = MultiSyncCollector(
                makers,
                policy,
                frames_per_batch=frames * workers,
                total_frames=-1,
                cat_results=0,
                use_buffers=True,
                num_sub_threads=threads,
                num_threads=torch.get_num_threads(),
                collector_class=WorkerCollector,
                auto_register_policy_transforms=False,
            )
        self.update_policy_weights_()
        reports = self.reports()
        self.simulation: list[State] = [report["simulation"] for report in reports]
        # What the workers' first resets counted is still theirs to report.
        self.transforms = without_counts(reports[0]["transforms"])
        self._given = [self.transforms] * workers

    def __iter__(self) -> Iterator[TensorDictBase]:
        batches = iter(self._collector)
        while True:
            with self._ray_watch():
                batch = next(batches)
            self._exchange_all()
            yield batch.flatten(0, 1) if self.kind == "ray" else batch

    def update_policy_weights_(self) -> None:
        """Send the policy's present parameters to all workers."""
        with self._ray_watch():
            self._collector.update_policy_weights_(self.policy)

    def load_transform_state(self, state: Mapping[str, Any]) -> None:
        """Give all workers these statistics. Before the first batch only: a busy worker would lose its batch."""
        self._call_all("load_transform_state", [(_packed(state),)] * self.count)
        self.transforms = dict(state)
        self._given = [self.transforms] * self.count

    def load_simulation_state(self, states: Sequence[Mapping[str, Any]]) -> None:
        """Put every worker into its state at the end of its last batch. Before the first batch only.

        Raises:
            ValueError: there are more or fewer workers than states.
        """
        if len(states) != self.count:
            raise ValueError(f"is of {len(states)} workers, this run has {self.count}")
        self._call_all("load_simulation_state", [(_packed(state),) for state in states])
        self.simulation = [dict(state) for state in states]

    def reports(self) -> list[State]:
        """What every worker holds, see :meth:`WorkerCollector.report`. Not while one is busy."""
        return [_unpacked(report) for report in self._call_all("report")]

    def policy_states(self) -> list[State]:
        """The parameters every worker acts by. Not while one is busy."""
        return [_unpacked(state) for state in self._call_all("policy_state")]

    def shutdown(self) -> None:
        """End the workers, and the Ray cluster where it was started for them."""
        self._collector.shutdown()
        if self._end_ray is not None:
            self._end_ray()

    def _exchange_all(self) -> None:
        reports = self.reports()
        states = [report["transforms"] for report in reports]
        merged = merge_states(self.transforms, states, self._given)
        self._call_all("load_transform_state", [(_packed(merged),)] * self.count)
        # Last: if a worker is missed before this, the saved state is that of the end of the previous iteration.
        self.simulation = [report["simulation"] for report in reports]
        self.transforms = merged
        self._given = [merged] * self.count

    def _call_all(self, method: str, arguments: list[tuple[Any, ...]] | None = None) -> list[Any]:
        with self._ray_watch():
            return list(self._collector.map_fn(method, arguments))

    @contextmanager
    def _ray_watch(self) -> Iterator[None]:
        """Raises :class:`WorkerLost` where Ray has lost a worker; of processes here the loop hears by itself."""
        if self.kind != "ray":
            yield
            return
        from ray.exceptions import RayActorError

        try:
            yield
        except (RayActorError, RuntimeError) as error:
            # Weights take another way than Ray's own, on which only a connection breaks: Ray knows who lives.
            gone = error if isinstance(error, RayActorError) else self._ray_says()
            if gone is None:
                raise
            raise WorkerLost(f"a worker of Ray ended: {str(gone).splitlines()[0]}") from error

    def _ray_says(self) -> Exception | None:
        """What Ray answers where one of its workers is gone."""
        from ray.exceptions import RayActorError

        try:
            self._collector.get_distant_attr("closed")
        except RayActorError as error:
            return error
        return None


def _seeded(make_env: Callable[[int], EnvBase], seed: int, number: int) -> EnvBase:
    end_with_parent()  # of itself it would look only after its batch; Ray ends its workers by its own means
    enable_onednn_matmul()
    torch.manual_seed((seed * 1000 + 1 + number) % 2**63)
    return make_env(number)


def _threaded(make_env: Callable[[], EnvBase], threads: int) -> EnvBase:
    torch.set_num_threads(threads)
    return make_env()


def _join_ray(cpus: int, address: str | None) -> Callable[[], None] | None:
    """Connect to a Ray cluster that has the cores; returns what ends it, None where it was there before."""
    try:
        import ray
    except ImportError:
        raise InputError("conf/collector", "kind", "ray needs Ray: pip install 'egopose[ray]'") from None
    there = ray.is_initialized()
    if not there:
        # A cluster made here is told of as many cores as are wanted: threads share them, Ray only counts. Its workers
        # are not to give way to all else on the machine, by 15 as Ray would have it: the training waits for them.
        here: dict[str, Any] = {"num_cpus": cpus, "_system_config": {"worker_niceness": 0}}
        place = here if address is None else {"address": address}
        # What runtime.prepare_runtime sets here, for processes that this one does not start.
        environment = {"env_vars": {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}}
        try:
            ray.init(**place, include_dashboard=False, log_to_driver=False, runtime_env=environment)
        except ConnectionError as error:
            raise InputError("conf/collector", "address", f"no Ray cluster answers at {address!r}: {error}") from None
    free = ray.available_resources().get("CPU", 0)
    if free < cpus:
        # Ray would wait, for as long as it takes, for others to end or machines to join.
        raise InputError("conf/collector", "workers", f"want {cpus} cores, the Ray cluster has {free:g} free")
    return None if there else ray.shutdown


def _ray_collector(
    makers: Sequence[Callable[[], EnvBase]], policy: TensorDictModuleBase, frames: int, threads: int, cpus: int
) -> Any:

    return RayCollector(
        [partial(_threaded, make, threads) for make in makers],
        policy,
        frames_per_batch=frames * len(makers),
        total_frames=_ENDLESS,
        sync=True,
        collector_class=WorkerCollector,
        collector_kwargs=[{"auto_register_policy_transforms": False, "track_traj_ids": False} for _ in makers],
        remote_configs={"num_cpus": cpus},
    )


def _packed(state: Mapping[str, Any]) -> State:
    """Arrays in the place of tensors: torch would send each tensor as a file of shared memory, many times slower."""
    return {key: _packed(value) if isinstance(value, Mapping) else value.numpy() for key, value in state.items()}


def _unpacked(state: Mapping[str, Any]) -> State:
    # Copied: what Ray brings is read-only.
    return {
        key: _unpacked(value) if isinstance(value, Mapping) else torch.from_numpy(np.array(value))
        for key, value in state.items()
    }
