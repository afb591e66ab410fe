"""Rewards and log-probabilities are computed once per batch, not per step while the physics' cores wait."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal

from egopose.collection.stepping import TransformedEgoPoseEnv, parts_of, run_parts


class GaussianSampler(TensorDictModuleBase):
    """Draws a Gaussian actor's actions without their probabilities: the same actions from the same random numbers.

    It writes the actor's entries except ``action_log_prob``, which :class:`Completion` adds.

    Args:
        actor: see :func:`draws_otherwise`.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential) -> None:
        super().__init__()
        self.actor = actor
        self._network = actor.module[:-1]
        self._parts = [part for step in self._network for part in parts_of(step)]
        self.in_keys = actor.in_keys
        self.out_keys = [key for key in actor.out_keys if key != "action_log_prob"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``action [N, A]``, ``loc``, ``scale``."""
        for part in self._network:
            tensordict = part(tensordict)
        return tensordict.set("action", torch.normal(tensordict["loc"], tensordict["scale"]))

    def needs_tensordicts(self) -> str | None:
        """Why :meth:`act` cannot replace :meth:`forward`, naming the part.

        None if it can: every part reads and writes plain entries.
        """
        for part in self._parts:
            if type(part) is not TensorDictModule:
                return f"its part {type(part).__name__} is no plain TensorDictModule"
            if nested := [key for key in (*part.in_keys, *part.out_keys) if not isinstance(key, str)]:
                return f"its part {type(part.module).__name__} reads or writes the nested entry {nested[0]}"
        return None

    def act(self, entries: MutableMapping[Any, Any]) -> None:
        """:meth:`forward` on a plain mapping, at a third of its expense."""
        run_parts(self._parts, entries)
        entries["action"] = torch.normal(entries["loc"], entries["scale"])


def draws_otherwise(policy: TensorDictModuleBase) -> str | None:
    """Why ``policy`` is no actor as :func:`egopose.models.policy.build_actor` makes it; None where it is one."""
    if not isinstance(policy, ProbabilisticTensorDictSequential):
        return f"it is a {type(policy).__name__} and no ProbabilisticActor"
    if getattr(policy.module[-1], "distribution_class", None) is not IndependentNormal:
        return "its last part draws from no IndependentNormal"
    if "action_log_prob" not in policy.out_keys:
        return "it does not write action_log_prob"
    return None


class Completion:
    """Adds to a collected batch ``[N, T]`` the entries that its steps left out.

    These are ``next/reward`` and ``next/reward_terms`` of an environment that defers them, and ``action_log_prob`` if a
    :class:`GaussianSampler` acted.

    Args:
        env: the collector's.
        policy: the collector's.
    """

    def __init__(self, env: EnvBase, policy: TensorDictModuleBase) -> None:
        self._env = env.base_env if isinstance(env, TransformedEgoPoseEnv) else None
        self._actor = policy.actor if isinstance(policy, GaussianSampler) else None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        batch = batch.copy()  # not of the tensors: the collector uses its own again
        if self._env is not None:
            terms = self._env.rewards_due()
            batch["next", "reward"] = terms.pop("reward")
            batch["next", "reward_terms"] = TensorDict(terms, batch_size=batch.batch_size)
        if self._actor is not None:
            batch["action_log_prob"] = self._actor.build_dist_from_params(batch).log_prob(batch["action"])
        return batch
