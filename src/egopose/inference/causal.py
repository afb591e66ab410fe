"""What the state regressor says of each frame when only a few frames after it have been seen.

The result of frame t depends on the frames up to ``t + lookahead`` and no more (Yuan & Kitani 2019, section 5: 10
frames, a fixed latency of 1/3 s). The forward direction is carried on; the backward direction is run again over the
look-ahead. The work of a frame does not depend on how many there were.

Runs with a regressor smoothed in time (``task.action.smoothing``) get the same Gaussian here, inside the same
look-ahead. Frames after t count as they appear at ``t + lookahead``, those before as they were given out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.humanoid.state_layout import StateLayout
from egopose.models.context import LstmState
from egopose.models.regressor import StateRegressor


@dataclass(frozen=True)
class Later:
    """What is known of the frames of a look-ahead, as they look at its end; their own look-aheads are not in.

    Attributes:
        visual_context: ``[K, C]``, as in :class:`Seen`; so are the others.
        humanoid_state: ``[K, S]``.
        joint_targets: ``[K, nu]`` rad.
    """

    visual_context: Tensor
    humanoid_state: Tensor
    joint_targets: Tensor


@dataclass(frozen=True)
class Seen:
    """What is known of a frame once its look-ahead is in.

    Attributes:
        frame: control frames since the start.
        window: ``[W, D]`` visual features of this frame and those of its look-ahead.
        visual_context: ``[C]`` as a policy with a frozen context reads it.
        humanoid_state: ``[S]`` the regressor's, in its own units.
        joint_targets: ``[nu]`` rad, its joint angles within the joints' range.
        later: of the frames after it, where a planner asks for them.
    """

    frame: int
    window: Tensor
    visual_context: Tensor
    humanoid_state: Tensor
    joint_targets: Tensor
    later: Later | None = None


class CausalRegression:
    """Visual features in, one frame at a time; :class:`Seen` out, ``lookahead`` frames later.

    Args:
        regressor: trained, in eval mode.
        joint_range: ``[nu, 2]`` rad.
        lookahead: frames.
        context_of_states: policies read the regressor's normalised state for a context (runs on cross-fitted tables).
        smoothing: standard deviation in frames of the Gaussian over what was seen; 0 for none.
        tells_later: say of each frame what is known of those after it.
    """

    def __init__(
        self,
        regressor: StateRegressor,
        joint_range: Tensor,
        lookahead: int,
        context_of_states: bool = False,
        smoothing: float = 0.0,
        tells_later: bool = False,
    ) -> None:
        self._tells_later = tells_later
        self._regressor, self._lookahead, self._context_of_states = regressor, lookahead, context_of_states
        self._low, self._high = joint_range.float().T
        self._state: LstmState | None = None
        self._weights = _gaussian(smoothing, lookahead) if smoothing > 0 and lookahead > 0 else None
        #: Frames whose look-ahead is not in, with their features ``[D]``.
        self.pending: deque[tuple[int, Tensor]] = deque(maxlen=lookahead + 1)
        #: Rows given out before they were smoothed, as far as smoothing looks back.
        self.past: deque[Tensor] = deque(maxlen=lookahead if self._weights is not None else 0)

    def push(self, frame: int, features: Tensor) -> Seen | None:
        """Take in a frame's features ``[D]``; what is now known of the frame ``lookahead`` before it, if there is."""
        self.pending.append((frame, features))
        return self._next() if len(self.pending) > self._lookahead else None

    def drain(self) -> Iterator[Seen]:
        """The last frames, whose look-ahead the end has cut short."""
        while self.pending:
            yield self._next()

    @torch.no_grad()
    def _next(self) -> Seen:
        window = torch.stack([features for _, features in self.pending])
        frame, _ = self.pending.popleft()
        if self._weights is None and not self._tells_later:
            context, self._state = self._regressor.context.causal_step(window[None], self._state)
            rows = self._rows(context)
        else:
            contexts, self._state = self._regressor.context.causal_window(window[None], self._state)
            rows = self._rows(contexts[0])
        if self._weights is not None:
            rows = self._smooth(rows)
        states, joints = self._regressor.state_mean.shape[0], self._low.shape[0]
        state, angles, read = rows.split([states, joints, rows.shape[1] - states - joints], dim=1)
        later = Later(read[1:], state[1:], angles[1:]) if self._tells_later else None
        return Seen(frame, window, read[0], state[0], angles[0], later)

    def _rows(self, context: Tensor) -> Tensor:
        """``[W, S + nu + C]``: state, joint targets and what the policy reads, of contexts ``[W, C]``."""
        states = self._regressor.decode(context) * self._regressor.state_std + self._regressor.state_mean
        angles = states[:, StateLayout(len(self._low)).joint_angles].clamp(self._low, self._high)
        read = self._regressor.normalise(states) if self._context_of_states else context
        return torch.cat([states, angles, read], dim=-1)

    def _smooth(self, rows: Tensor) -> Tensor:
        """Rows ``[W, N]`` smoothed over them and the past; beyond either end the outermost row stands. The first alone,
        unless those after it are asked for."""
        assert self._weights is not None
        count = len(rows) if self._tells_later else 1
        before = [self.past[0] if self.past else rows[0]] * (self._lookahead - len(self.past)) + list(self.past)
        after = rows[-1:].expand(max(self._lookahead + count - len(rows), 0), -1)
        self.past.append(rows[0])
        table = torch.cat([torch.stack(before), rows, after]).double()
        size = len(self._weights)
        return torch.stack([self._weights @ table[at : at + size] for at in range(count)]).to(rows.dtype)


def _gaussian(deviation: float, radius: int) -> Tensor:
    """``[2 radius + 1]`` float64 weights of sum 1."""
    weights = [math.exp(-0.5 * (k / deviation) ** 2) for k in range(-radius, radius + 1)]
    return torch.tensor(weights, dtype=torch.float64) / sum(weights)
