"""A collector that keeps all cores busy: while the physics steps some environments, the policy acts for the others."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from egopose.collection.lazy_rewards import GaussianSampler
from egopose.collection.stepping import Entries, TransformedEgoPoseEnv

_STEPS_PUT_AT_ONCE = 16
_TURN = (
    5e-5  # s; measured, with two env_groups on two cores: 4 % more steps/s than at Python's 5e-3, as much as at 1e-5
)


class GroupedCollector(Collector):
    """TorchRL's collector for small environments, stepped in groups that take turns.

    If all environments step together, the physics' threads wait for the policy and the policy waits for them. Here the
    physics of one group runs while observations, actions and resets of another are computed. The order is fixed, so the
    result does not depend on timing. Each group's step enters the running normaliser when it is made.

    Args:
        env: the environments that are divided into groups.
        policy: without a memory, see :meth:`GaussianSampler.needs_tensordicts`.
        env_groups: number of groups.
        **settings: of TorchRL's collector.
    """

    def __init__(
        self, env: TransformedEgoPoseEnv, policy: GaussianSampler, *, env_groups: int, **settings: Any
    ) -> None:
        super().__init__(env, policy, use_buffers=False, return_same_td=True, **settings)
        if settings.get("exploration_type", ExplorationType.RANDOM) != ExplorationType.RANDOM:
            raise ValueError("actions are drawn at random here")
        bounds = [env.batch_size[0] * number // env_groups for number in range(env_groups + 1)]
        self._groups = [slice(*ends) for ends in pairwise(bounds)]

    def rollout(self) -> TensorDictBase:
        """``[N, T]``: the next T steps of every world."""
        seen = [Entries(self._carrier[worlds].items()) for worlds in self._groups]
        with _quick_turns(), torch.inference_mode():
            batch, follows = self._steps(seen)
        for key in set(follows[0]) & set(self._carrier.keys()):
            # Outside of inference mode, whose tensors cannot be learned from.
            self._carrier.set(key, torch.cat([group[key] for group in follows]))
        return batch

    def _steps(self, standing: list[Entries]) -> tuple[TensorDict, list[Entries]]:
        """From the observations of each group: the batch ``[N, T]``, and the observations after it."""
        columns = [_Columns(worlds, self.frames_per_batch) for worlds in self._groups]
        batch: TensorDict | None = None
        for seen, worlds in zip(standing, self._groups, strict=True):
            self._begin(seen, worlds)
        for left in range(self.frames_per_batch - 1, -1, -1):
            for number, worlds in enumerate(self._groups):
                seen = standing[number]
                after, standing[number] = self.env.end_step(seen, worlds)
                if left:
                    self._begin(standing[number], worlds)
                if batch is None:
                    batch = _empty_batch(seen, after, self.env.batch_size[0], self.frames_per_batch)
                columns[number].append(seen, after, batch)
        assert batch is not None
        return batch, standing

    def _begin(self, seen: Entries, worlds: slice) -> None:
        self.policy.act(seen)
        self.env.begin_step(seen["action"], worlds)


class _Columns:
    """Puts the steps of a group into the batch, several at a time, while the physics goes on."""

    def __init__(self, worlds: slice, steps: int) -> None:
        self._worlds, self._steps, self._put = worlds, steps, 0
        self._waiting: list[tuple[Entries, Entries]] = []

    def append(self, seen: Entries, after: Entries, batch: TensorDict) -> None:
        """One step: observation and action, and the result."""
        self._waiting.append((seen, after))
        end = self._put + len(self._waiting)
        if len(self._waiting) < _STEPS_PUT_AT_ONCE and end < self._steps:
            return
        for part, rows in enumerate((batch, batch["next"])):
            for key, column in rows.items():
                if key != "next":
                    steps = [step[part][key] for step in self._waiting]
                    column[self._worlds, self._put : end] = torch.stack(steps, dim=1)
        self._put = end
        self._waiting.clear()


def _empty_batch(seen: Entries, after: Entries, num_envs: int, steps: int) -> TensorDict:
    """Room for ``[num_envs, steps]`` of observations and actions, and under ``next`` of their results."""
    size = torch.Size([num_envs, steps])
    with torch.inference_mode(False):  # to be learned from
        first, then = (
            {key: torch.empty(*size, *entry.shape[1:], dtype=entry.dtype) for key, entry in entries.items()}
            for entries in (seen, after)
        )
        return TensorDict({**first, "next": TensorDict(then, batch_size=size)}, batch_size=size)


@contextmanager
def _quick_turns() -> Iterator[None]:
    """Python's threads give way to each other within microseconds.

    A physics thread needs the interpreter for a moment after every environment. By default it gets it only when the
    acting thread has to wait: up to 5 ms on an idle core.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(_TURN)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
