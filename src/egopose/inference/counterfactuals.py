"""What would have come had the fail-safe not reset: simulation carried on from the states in which it triggered."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.envs.env import EgoPoseEnv
from egopose.humanoid.physics import PER_WORLD

_WORLDS = 256  # carried on side by side: a method that falls a lot triggers thousands of times
_OF_EACH_WORLD = (*(f"physics.{name}" for name in PER_WORLD), "take", "start", "stop", "frame", "placed")


class CounterfactualRollouts:
    """States kept at triggers: physics, episode and what the policy sees, memory included."""

    def __init__(self) -> None:
        self._states: list[dict[str, Tensor]] = []
        self._seen: list[TensorDictBase] = []
        #: ``(world, global frame)`` of each fork, in the order they were kept.
        self.places: list[tuple[int, int]] = []

    def keep(self, base: EgoPoseEnv, observation: TensorDictBase, worlds: Tensor) -> None:
        """Keep the present state of ``worlds [n]``, which see ``observation [N]`` and have not been reset yet."""
        state = base.state_dict()
        for world in worlds.tolist():
            self._states.append({key: state[key][world].clone() for key in _OF_EACH_WORLD if key in state})
            self._seen.append(observation[world].clone())
            self.places.append((world, int(state["frame"][world])))

    @torch.no_grad()
    def frames_to_fall(
        self, make_env: Callable[[int], TransformedEnv], actor: Callable[[TensorDictBase], TensorDictBase], window: int
    ) -> list[int | None]:
        """Frames from each fork to the fall that comes without a reset, or to physics that break.

        Args:
            make_env: of so many worlds: the environment of the counterfactuals, with falls that do not end an episode
                and the normaliser frozen.
            actor: its mean action is taken.
            window: frames to look ahead; a take's end ends it sooner.

        Returns:
            1 to ``window`` for each fork, or None where the body stays up.
        """
        out: list[int | None] = []
        for first in range(0, len(self._states), _WORLDS):
            rows = slice(first, first + _WORLDS)
            env = make_env(len(self._states[rows]))
            out += _carry_on(env, actor, self._states[rows], torch.stack(self._seen[rows]), window)
            env.close()
        return out


def _carry_on(
    env: TransformedEnv,
    actor: Callable[[TensorDictBase], TensorDictBase],
    states: list[dict[str, Tensor]],
    observation: TensorDictBase,
    window: int,
) -> list[int | None]:
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    env.reset()
    rows = {key: torch.stack([state[key] for state in states]) for key in states[0]}
    base.load_state_dict({**base.state_dict(), **rows})
    left = rows["stop"] - 1 - rows["frame"]
    fall = torch.zeros(len(states), dtype=torch.int64)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(1, min(window, int(left.max())) + 1):
            after = env.step(actor(observation))["next"]
            down = (after["fallen"] | after["diverged"]).squeeze(-1)
            fall = torch.where((fall == 0) & down & (step <= left), step, fall)
            if (fall > 0).all():
                break
            observation = after.exclude("reward", "action")
    return [frames or None for frames in fall.tolist()]
