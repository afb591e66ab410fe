"""One recurrent forecaster of poses for two published methods that differ in how it is trained.

ERD (Fragkiadaki et al., ICCV 2015): encoder, LSTMs, decoder, noise on the input while training. acLSTM (Zhou et al.,
ICLR 2018): fed alternately with the truth and with its own output while training. A pose state is the first
``11 + D`` numbers of the humanoid state z without the joint velocities: root height, de-headed root quaternion, D
joint angles, the root's linear velocity (heading frame) and angular velocity (root frame).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

LstmStates = tuple[Tensor, Tensor]


def ground_truth_mask(length: int, truth: int, own: int, offset: int = 0) -> Tensor:
    """``[length]`` booleans: which inputs are the truth. ``truth`` frames of it, then ``own`` of the network's output.

    Zhou et al. 2018, section 3.2, with fixed lengths. The first ``offset`` frames (a context) are true besides.
    """
    frame = torch.arange(length) - offset
    return (frame < 0) | (frame % (truth + own) < truth)


class RecurrentForecaster(nn.Module):
    """From poses up to a frame to the pose of the next one; inside in units of the training frames' deviations.

    Args:
        mean, std: ``[P]`` of the pose states trained on; buffers, saved with the weights.
        encoder: widths of the layers before the LSTM.
        recurrent: units of each LSTM layer.
        layers: LSTM layers.
        decoder: widths of the layers after it.
        residual: the network's output is added to the last pose.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        mean: Tensor,
        std: Tensor,
        encoder: Sequence[int],
        recurrent: int,
        layers: int,
        decoder: Sequence[int],
        residual: bool,
    ) -> None:
        super().__init__()
        self.register_buffer("mean", mean.to(torch.float32, copy=True))
        self.register_buffer("std", std.to(torch.float32, copy=True))
        self.residual = residual
        self.encoder, width = _layers(len(mean), encoder)
        self.lstm = nn.LSTM(width, recurrent, layers, batch_first=True)
        hidden, width = _layers(recurrent, decoder)
        self.decoder = nn.Sequential(*hidden, nn.Linear(width, len(mean)))

    def normalise(self, poses: Tensor) -> Tensor:
        """Pose states ``[..., P]`` in their own units -> normalised, float32."""
        return ((poses - self.mean) / self.std).to(torch.float32)

    def denormalise(self, poses: Tensor) -> Tensor:
        """The opposite of :meth:`normalise`."""
        return poses * self.std + self.mean

    def forward(self, poses: Tensor, memory: LstmStates | None = None) -> tuple[Tensor, LstmStates]:
        """Normalised poses ``[B, T, P]`` -> the successor of each ``[B, T, P]``, and the LSTM's memory after all."""
        hidden, memory = self.lstm(self.encoder(poses), memory)
        out = self.decoder(hidden)
        return (poses + out if self.residual else out), memory

    def conditioned(self, poses: Tensor, truth: Tensor) -> Tensor:
        """As :meth:`forward` without memory, the input being the truth in some frames and the last output in others.

        Args:
            poses: normalised, ``[B, T, P]``.
            truth: ``[T]`` booleans, see :func:`ground_truth_mask`; the first must be true.
        """
        outputs: list[Tensor] = []
        memory: LstmStates | None = None
        t = 0
        while t < len(truth):
            stop = t + 1
            if truth[t]:  # a stretch of truth is one pass
                while stop < len(truth) and truth[stop]:
                    stop += 1
                given = poses[:, t:stop]
            else:
                given = outputs[-1][:, -1:]
            out, memory = self.forward(given, memory)
            outputs.append(out)
            t = stop
        return torch.cat(outputs, dim=1)

    @torch.no_grad()
    def forecast(self, context: Tensor, horizon: int) -> Tensor:
        """The poses after a context, each fed back as the next input.

        Args:
            context: pose states ``[B, C, P]`` in their own units.
            horizon: frames.

        Returns:
            ``[B, horizon, P]``, in their own units.
        """
        out, memory = self.forward(self.normalise(context))
        frames = [out[:, -1:]]
        for _ in range(horizon - 1):
            out, memory = self.forward(frames[-1], memory)
            frames.append(out)
        return self.denormalise(torch.cat(frames, dim=1))


def _layers(width: int, widths: Sequence[int]) -> tuple[nn.Sequential, int]:
    layers: list[nn.Module] = []
    for size in widths:
        layers += [nn.Linear(width, size), nn.ReLU()]
        width = size
    return nn.Sequential(*layers), width
