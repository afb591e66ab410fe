"""Policy, value and step of an estimate, by plain entries where that gives the same numbers for less.

For a single body the arithmetic of a frame is little: TensorDicts, distributions and rewards that nobody reads take
more than half of a frame's time.
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.modules import ValueOperator

from egopose.collection.lazy_rewards import GaussianSampler, draws_otherwise
from egopose.collection.stepping import Entries, TransformedEgoPoseEnv, parts_of, run_parts
from egopose.envs.env import EgoPoseEnv
from egopose.envs.test_time import Controller
from egopose.humanoid.physics import ALL


class Acting:
    """What a body does at test time, as TorchRL has it.

    Args:
        env: over :class:`EgoPoseEnv`.
        actor, critic: policy and value network.
    """

    def __init__(self, env: TransformedEnv, actor: Controller, critic: Controller) -> None:
        self._env, self._actor, self._critic = env, actor, critic
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        self._base = base

    def observed(self) -> Any:
        """The present observation, after bodies were placed."""
        return self._env.transform(self._base.observe())

    def act(self, observation: Any) -> Any:
        """The observation with ``action``, the mean one, and ``state_value``."""
        return self._critic(self._actor(observation))

    def step(self, observation: Any) -> Any:
        """The observation after a step under ``action``."""
        after: TensorDictBase = self._env.step(observation)["next"]
        return after.exclude("reward", "action")


class QuickActing(Acting):
    """The same to the bit, for parts that :func:`runs_quickly` approves. The environment's rewards are lazy from here
    on."""

    def __init__(self, env: TransformedEgoPoseEnv, actor: Any, critic: Any) -> None:
        super().__init__(env, actor, critic)
        # All but the distribution, whose mean is its first parameter.
        self._parts = [part for step in actor.module[:-1] for part in parts_of(step)] + parts_of(critic)
        env.make_rewards_lazy()

    def observed(self) -> Entries:
        return Entries(super().observed().items())

    def act(self, observation: Entries) -> Entries:
        run_parts(self._parts, observation)
        observation["action"] = observation["loc"]
        return observation

    def step(self, observation: Entries) -> Entries:
        action: Tensor = observation["action"]
        self._base.begin_step(action, ALL)
        after: Entries = self._env.transform._step(observation, Entries(self._base.end_step(ALL)))
        return after


def acting(env: TransformedEnv, actor: Controller, critic: Controller) -> Acting:
    """The quickest way of these."""
    if isinstance(env, TransformedEgoPoseEnv) and runs_quickly(actor, critic):
        return QuickActing(env, actor, critic)
    return Acting(env, actor, critic)


def runs_quickly(actor: Controller, critic: Controller) -> bool:
    """Whether the actor is a Gaussian one, and all parts of both read and write plain entries."""
    if not (isinstance(actor, TensorDictModuleBase) and isinstance(critic, TensorDictModuleBase)):
        return False
    if draws_otherwise(actor) is not None or GaussianSampler(actor).needs_tensordicts() is not None:
        return False
    parts = parts_of(critic)
    keys = [key for part in parts for key in (*part.in_keys, *part.out_keys)]
    return all(type(part) in (TensorDictModule, ValueOperator) for part in parts) and all(
        isinstance(key, str) for key in keys
    )
