"""From a policy and the wearer's video to motion: one pass over whole takes, all takes side by side.

Yuan & Kitani 2019, sections 3.1 and 3.3: the first state is the regressor's, placed where the person stands and faces;
from there the policy's mean action drives the humanoid. Where the fail-safe triggers at frame t, the humanoid restarts
at frame t + 1 from the regressor's state, at its own place and heading. With a planner, which is beyond the paper, the
mean action is where planning begins, and V(s_t) is what the best plan is worth.
"""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import TransformedEnv

from egopose.envs.transforms import StateNormalizer
from egopose.models.episode_context import EpisodeContext

#: What writes ``action`` (an actor: its mean action is taken) or ``state_value`` into an observation.
Controller = Callable[[TensorDictBase], TensorDictBase]


def prepare_for_test(env: TransformedEnv, *controllers: Controller, lookahead: int | None = None) -> None:
    """Freeze the state normaliser and let trainable contexts see a take in one pass: each frame's to the take's end, or
    ``lookahead`` frames ahead and no more."""
    for module in env.transform.modules():
        if isinstance(module, StateNormalizer):
            module.freeze()
    for network in controllers:
        if not isinstance(network, nn.Module):
            continue
        network.eval()
        for module in network.modules():
            if isinstance(module, EpisodeContext):
                module.horizon, module.lookahead = None, lookahead
