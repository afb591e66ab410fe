"""The state regressor F (Yuan & Kitani 2019, section 3.3): the wearer's video to the humanoid's state, no physics.

Flow -> CNN -> visual features -> BiLSTM -> visual context -> MLP (300, 200) -> state z. It starts and, after a fall,
restarts the humanoid; its CNN and context, frozen, are the policy's eyes.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from egopose.models.context import BidirectionalContext
from egopose.models.policy import log_parameter_count

_log = logging.getLogger(__name__)


class StateRegressor(nn.Module):
    """F. The network works in normalised units; ``state_mean`` and ``state_std`` are buffers, saved with the weights.

    Args:
        encoder: flow ``[B, 2, H, W]`` -> visual features ``[B, D]``; None where features are the input.
        state_mean: ``[S]`` of the training frames.
        state_std: ``[S]`` of the training frames, floored (:func:`state_statistics`).
        feature_size: D.
        context_size: units a direction of the BiLSTM.
        hidden: widths of the MLP's hidden layers.
        dropout: in the MLP and on the context.
        feature_dropout: on the visual features.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(
        self,
        encoder: nn.Module | None,
        state_mean: Tensor,
        state_std: Tensor,
        feature_size: int = 128,
        context_size: int = 64,
        hidden: Sequence[int] = (300, 200),
        dropout: float = 0.0,
        feature_dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.context = BidirectionalContext(feature_size, context_size)
        self.feature_dropout = nn.Dropout(feature_dropout)
        self.context_dropout = nn.Dropout(dropout)
        self.head = MLP(
            self.context.output_size,
            len(state_mean),
            num_cells=list(hidden),
            activation_class=nn.ReLU,
            dropout=dropout or None,
        )
        self.register_buffer("state_mean", state_mean.to(torch.float32))
        self.register_buffer("state_std", state_std.to(torch.float32))
        log_parameter_count("state regressor", self)

    def encode(self, flow: Tensor) -> Tensor:
        """Flow ``[N, 2, H, W]`` -> visual features ``[N, D]``; features pass where there is no encoder."""
        return flow.to(torch.float32) if self.encoder is None else self.encoder(flow.to(torch.float32))

    def decode(self, context: Tensor) -> Tensor:
        """Visual context ``[..., C]`` -> state in normalised units ``[..., S]``."""
        return self.head(self.context_dropout(context))

    def forward(self, video: Tensor, lengths: Tensor | None = None, lookahead: int | None = None) -> dict[str, Tensor]:
        """The states seen in a batch of clips.

        Args:
            video: flow ``[B, T, 2, H, W]``, or features ``[B, T, D]`` where the regressor has no encoder.
            lengths: ``[B]`` valid frames a clip, or None where all are full (clips left-aligned).
            lookahead: None for the whole clip; else causal (:meth:`BidirectionalContext.causal`), full clips only.

        Returns:
            ``visual_features [B, T, D]``, ``visual_context [B, T, C]``, ``normalised_state [B, T, S]`` and
            ``humanoid_state [B, T, S]`` (z in its own units).
        """
        features = self.encode(video.flatten(0, 1)).unflatten(0, video.shape[:2])
        return self.from_features(features, lengths, lookahead)

    def from_features(
        self, features: Tensor, lengths: Tensor | None = None, lookahead: int | None = None
    ) -> dict[str, Tensor]:
        """As :meth:`forward`, from visual features ``[B, T, D]``."""
        seen = self.feature_dropout(features)
        context = self.context(seen, lengths) if lookahead is None else self.context.causal(seen, lookahead)
        normalised = self.decode(context)
        return {
            "visual_features": features,
            "visual_context": context,
            "normalised_state": normalised,
            "humanoid_state": normalised * self.state_std + self.state_mean,
        }

    def normalise(self, state: Tensor) -> Tensor:
        """z ``[..., S]`` -> normalised units, float32."""
        return ((state - self.state_mean) / self.state_std).to(torch.float32)


def state_statistics(states: Tensor, std_floor: float) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[S]`` of states ``[F, S]``, the latter no smaller than ``std_floor``.

    The floor (m, rad, m/s, rad/s alike) keeps numbers that hardly move in the training set, a hand's hinge for one,
    from being amplified into the loss.
    """
    states = states.to(torch.float64)
    return states.mean(0).float(), states.std(0, correction=0).clamp(min=std_floor).float()
