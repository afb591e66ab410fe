"""Visual context (phi in Yuan & Kitani 2019, section 3.1): recurrent networks over per-frame visual features (psi).

Estimation reads the video with a bidirectional LSTM, one context vector a frame; forecasting reads the past with a
forward LSTM, one vector a window. Time is the second axis here, the batch the first.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

LstmState = tuple[Tensor, ...]


def reverse_in_time(sequence: Tensor, lengths: Tensor | None = None) -> Tensor:
    """Each row's first ``lengths`` frames in the opposite order.

    Args:
        sequence: ``[B, T, D]``, rows left-aligned.
        lengths: ``[B]`` int64 in 1..T, or None where all rows are full.

    Returns:
        ``[B, T, D]``; what lies behind a row's length repeats its first frame and means nothing.
    """
    if lengths is None:
        return sequence.flip(1)
    order = (lengths[:, None] - 1 - torch.arange(sequence.shape[1], device=sequence.device)).clamp_(min=0)
    return sequence.gather(1, order[:, :, None].expand(-1, -1, sequence.shape[2]))


class BidirectionalContext(nn.Module):
    """BiLSTM from ``visual_features [B, T, feature_size]`` to ``visual_context [B, T, 2 * hidden_size]``.

    The two directions are two LSTMs, so that rows of unequal length need no packing and the backward one can be run
    over a short look-ahead alone (:meth:`causal`). SPEC: 128 -> 64 a direction -> 128.

    Args:
        feature_size: width of a frame's visual features.
        hidden_size: units a direction.
    """

    def __init__(self, feature_size: int = 128, hidden_size: int = 64) -> None:
        super().__init__()
        self.feature_size = feature_size
        self.output_size = 2 * hidden_size
        self.forward_lstm = nn.LSTM(feature_size, hidden_size, batch_first=True)
        self.backward_lstm = nn.LSTM(feature_size, hidden_size, batch_first=True)

    def forward(self, visual_features: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Context of every frame from the whole row.

        Args:
            visual_features: ``[B, T, feature_size]``, rows left-aligned.
            lengths: ``[B]`` int64 valid frames a row, or None where all are full.

        Returns:
            ``[B, T, output_size]``; frames behind a row's length hold nothing of meaning.
        """
        ahead, _ = self.forward_lstm(visual_features)
        back, _ = self.backward_lstm(reverse_in_time(visual_features, lengths))
        return torch.cat([ahead, reverse_in_time(back, lengths)], dim=-1)

    def causal(self, visual_features: Tensor, lookahead: int = 10) -> Tensor:
        """Context of every frame with a fixed latency of ``lookahead`` frames.

        Output ``t`` is exactly output ``t`` of :meth:`forward` run on frames ``0 .. min(t + lookahead, T - 1)``: the
        forward direction has seen ``0 .. t`` (one pass over the row), the backward direction only
        ``t .. t + lookahead`` (started from a zero state at each frame). O(T * lookahead), not O(T^2).

        Args:
            visual_features: ``[B, T, feature_size]``.
            lookahead: future frames each output may see; 10 is 1/3 s at 30 Hz.

        Returns:
            ``[B, T, output_size]``.
        """
        batch, frames, _ = visual_features.shape
        ahead, _ = self.forward_lstm(visual_features)
        start = torch.arange(frames, device=visual_features.device)
        last = (start + lookahead).clamp(max=frames - 1)
        order = last[:, None] - torch.arange(lookahead + 1, device=start.device)
        windows = visual_features[:, order.clamp(min=0)].flatten(0, 1)
        outputs, _ = self.backward_lstm(windows)
        outputs = outputs.unflatten(0, (batch, frames))
        return torch.cat([ahead, outputs[:, start, last - start]], dim=-1)

    def causal_step(self, window: Tensor, state: LstmState | None = None) -> tuple[Tensor, LstmState]:
        """The stream's form of :meth:`causal`: one frame's context, the forward direction's state carried on.

        Args:
            window: ``[B, W, feature_size]`` the features of frames ``t .. t + W - 1``; W is the look-ahead + 1, less
                only where the video ends.
            state: of the forward direction after frame ``t - 1``; None before the first frame.

        Returns:
            Context ``[B, output_size]`` of frame ``t`` and the state after it.
        """
        ahead, state = self.forward_lstm(window[:, :1], state)
        back, _ = self.backward_lstm(window.flip(1))
        return torch.cat([ahead[:, -1], back[:, -1]], dim=-1), state

    def causal_window(self, window: Tensor, state: LstmState | None = None) -> tuple[Tensor, LstmState]:
        """As :meth:`causal_step`, with the contexts of all frames of the window as they appear at its end.

        Returns:
            Contexts ``[B, W, output_size]`` and the state after the window's first frame.
        """
        first, state = self.forward_lstm(window[:, :1], state)
        ahead = [first]
        if window.shape[1] > 1:
            ahead.append(self.forward_lstm(window[:, 1:], state)[0])
        back, _ = self.backward_lstm(window.flip(1))
        return torch.cat([torch.cat(ahead, dim=1), back.flip(1)], dim=-1), state


class ForwardContext(nn.Module):
    """Forward LSTM whose last output is the context of a whole window: forecasting sees only the past.

    Args:
        feature_size: width of a frame's visual features.
        hidden_size: units, the width of the context (SPEC: 128; 512 across subjects).
    """

    def __init__(self, feature_size: int = 128, hidden_size: int = 128) -> None:
        super().__init__()
        self.feature_size = feature_size
        self.output_size = hidden_size
        self.lstm = nn.LSTM(feature_size, hidden_size, batch_first=True)

    def forward(self, visual_features: Tensor) -> Tensor:
        """``[B, T, feature_size]`` -> ``[B, hidden_size]``, the output at the last frame."""
        outputs, _ = self.lstm(visual_features)
        return outputs[:, -1]
