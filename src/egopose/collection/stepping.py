"""The environment with its transforms, stepped at less than half of the time that TorchRL's own step takes."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import Transform

from egopose.envs.env import EgoPoseEnv
from egopose.humanoid.physics import ALL


class Entries(dict[Any, Any]):
    """Entries of equal first axis, with those methods of a TensorDict that transforms of observations need.

    A TensorDict checks and wraps at every entry it is given, which for 64 worlds costs more than the arithmetic.
    """

    @property
    def shape(self) -> torch.Size:
        """Of the first axis."""
        return self["done"].shape[:1]

    def get(self, key: Any, default: Any = None) -> Any:
        """The entry, or ``default``."""
        return super().get(key, default)

    def set(self, key: Any, value: Any) -> Entries:
        """Set an entry; returns itself."""
        self[key] = value
        return self

    def leaves(self) -> Iterator[tuple[Any, Tensor]]:
        """Keys and tensors, those of nested TensorDicts by tuples."""
        for key, value in self.items():
            if isinstance(value, TensorDictBase):
                yield from (((key, *key_path(inner)), leaf) for inner, leaf in value.items(True, True))
            else:
                yield key, value


def key_path(key: Any) -> tuple[Any, ...]:
    """A TensorDict's key as a tuple of its parts."""
    return key if isinstance(key, tuple) else (key,)


def parts_of(module: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    """The modules of a sequence in order, those of sequences inside it too."""
    if isinstance(module, TensorDictSequential):
        return [part for inner in module.module for part in parts_of(inner)]
    return [module]


def run_parts(parts: Sequence[TensorDictModuleBase], entries: MutableMapping[Any, Any]) -> None:
    """Write the entries of ``parts`` to a plain mapping, in a third of the time that a TensorDict takes."""
    for part in parts:
        out = part.module(*[entries[key] for key in part.in_keys])
        entries.update(zip(part.out_keys, out if isinstance(out, tuple) else (out,), strict=True))


class TransformedEgoPoseEnv(TransformedEnv):
    """A ``TransformedEnv`` around :class:`EgoPoseEnv` that steps and resets worlds in one go for a collector.

    TorchRL's step is made for any environment. It copies, checks and merges whole batches at every step, and again when
    a single world is reset. Here a step makes the next state, and a reset makes only the rows of the worlds being
    reset. The values are the same to the bit, with one exception: of the policy's entries only those under ``next``
    (hidden states) are carried to the next step. Every other method is TorchRL's.

    Args:
        env: the environment.
        *transforms: in order; any that only reads and writes observations at steps and resets.

    Attributes:
        fast: False leaves stepping to TorchRL altogether.
    """

    def __init__(self, env: EgoPoseEnv, *transforms: Transform) -> None:
        super().__init__(env, Compose(*transforms))
        self.fast = True

    def make_rewards_lazy(self) -> None:
        """See :meth:`EgoPoseEnv.make_rewards_lazy`."""
        self.base_env.make_rewards_lazy()
        self.empty_cache()

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """See ``EnvBase.step_and_maybe_reset``: the transition, and what the next step starts from."""
        if not self.fast:
            return super().step_and_maybe_reset(tensordict)
        written = tensordict.get("next", None)
        after = self.transform._step(tensordict, self.base_env._step(tensordict))
        if written is not None:
            after.update(written.exclude(*after.keys(include_nested=True)))
        tensordict.set("next", after)
        follows = after.copy()  # of the nested entries too, but not of the tensors
        del follows["reward"]
        for key, value in self._begun_anew(after, ALL).items():
            follows.set(key, value)
        return tensordict, follows

    def begin_step(self, action: Tensor, worlds: slice) -> None:
        """Have the physics' threads take a step of ``worlds``, a range, under ``action [n, A]``, while the caller works
        for others."""
        self.base_env.begin_step(action, worlds)

    def end_step(self, seen: Entries, worlds: slice) -> tuple[Entries, Entries]:
        """What the step that :meth:`begin_step` began from ``seen`` led to, and what the next one starts from.

        The values are those of :meth:`step_and_maybe_reset`, without a TensorDict around them.
        """
        after = self.transform._step(seen, Entries(self.base_env.end_step(worlds)))
        follows = Entries({**after, **self._begun_anew(after, worlds)})
        del follows["reward"]
        return after, follows

    def _begun_anew(self, after: TensorDictBase | Entries, worlds: slice) -> dict[Any, Tensor]:
        """Begin an episode in those of ``worlds`` that are done ``after`` a step; the entries that this changes."""
        done = after["done"]
        if not bool(done.any()):
            return {}
        rows = done.squeeze(-1).nonzero().squeeze(-1)
        base = self.base_env
        fresh = self.transform._reset(Entries(), Entries(base.begin(rows + (worlds.start or 0))))
        changed = base.ongoing(after, worlds)
        for key, value in fresh.leaves():
            # A hidden state is missing where the actions came from elsewhere.
            if key not in changed and (before := after.get(key, None)) is not None:
                changed[key] = before.index_copy(0, rows, value)
        return changed
