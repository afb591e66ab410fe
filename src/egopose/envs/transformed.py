"""The environment with its transforms, stepped at less than half of TorchRL's own expense."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import Transform

from egopose.envs.env import EgoPoseEnv


class TransformedEgoPoseEnv(TransformedEnv):
    """A ``TransformedEnv`` around :class:`EgoPoseEnv` that steps and resets worlds in one go for a collector.

    TorchRL's way is made for any environment: it copies, checks and merges whole batches at every step, and once more
    when a single world is reset. Here a step makes the next state, and a reset the rows of the worlds that are reset.
    What comes out is the same to the bit, except that of what the policy wrote only that under ``next`` (hidden states)
    is carried to the next step. Every other method is TorchRL's.

    Args:
        env: the environment.
        *transforms: in order; any that only reads and writes observations at steps and resets.
    """

    def __init__(self, env: EgoPoseEnv, *transforms: Transform) -> None:
        super().__init__(env, Compose(*transforms))

    def defer_rewards(self) -> None:
        """See :meth:`EgoPoseEnv.defer_rewards`."""
        self.base_env.defer_rewards()
        self.empty_cache()

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """See ``EnvBase.step_and_maybe_reset``: the transition, and what the next step starts from."""
        written = tensordict.get("next", None)
        base = self.base_env
        after = self.transform._step(tensordict, base._step(tensordict))
        if written is not None:
            after.update(written.exclude(*after.keys(include_nested=True)))
        tensordict.set("next", after)
        done = after["done"]
        follows = after.copy()  # of the nested entries too, but not of the tensors
        del follows["reward"]
        if bool(done.any()):
            worlds = done.squeeze(-1).nonzero().squeeze(-1)
            fresh = base.begin(worlds)
            known = base.ongoing(after["fallen"] & ~done)
            fresh = self.transform._reset(fresh.empty(), fresh)
            for key, value in fresh.items(include_nested=True, leaves_only=True):
                # A hidden state is missing where the actions came from elsewhere.
                if key in known:
                    follows.set(key, known[key])
                elif (before := after.get(key, None)) is not None:
                    follows.set(key, before.index_copy(0, worlds, value))
        return tensordict, follows
