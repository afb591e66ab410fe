"""A kinematic forecast of motion: from the states a context shows to a smooth curve of poses, all frames in one go.

Recurrent forecasters feed their own output back and drift; a curve in a spline basis has nothing to feed back, is
smooth by construction, and shrinks to the mean motion as far as the context is uncertain. (Mao et al., ICCV 2019,
forecast coefficients of a cosine basis likewise; its curves have no slope at their ends, where a forecast begins.)

A pose is the first ``P = 11 + D`` numbers of the humanoid state z: root height, de-headed root quaternion, D joint
angles, root linear velocity (heading frame) and root angular velocity (root frame).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from egopose.models.baselines.recurrent import RecurrentForecaster
from egopose.models.kernel_regression import KernelRegression


def spline_basis(frames: int, spacing: int, fps: float) -> tuple[Tensor, Tensor]:
    """Cubic B-splines over steps ``0 .. frames - 1``: values ``[frames, K]``, and their derivatives (1/s).

    Args:
        frames: steps.
        spacing: frames between knots, about; the ends are knots.
        fps: frames per second.

    Raises:
        ValueError: fewer than two frames, or a spacing that is not positive.
    """
    knots = _knots(frames, spacing)
    count = len(knots) - 4
    at = np.arange(frames, dtype=np.float64)
    spline = scipy.interpolate.BSpline(knots, np.eye(count), 3)
    return torch.from_numpy(spline(at)).float(), torch.from_numpy(spline.derivative()(at) * fps).float()


def spline_times(frames: int, spacing: int) -> Tensor:
    """The steps ``[K]`` at which the coefficients of :func:`spline_basis` stand (Greville's abscissae): a straight line
    has its own values there as coefficients.

    Raises:
        ValueError: as :func:`spline_basis`.
    """
    knots = _knots(frames, spacing)
    return torch.from_numpy((knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3.0).float()


def _knots(frames: int, spacing: int) -> NDArray[np.float64]:
    if frames < 2 or spacing < 1:
        raise ValueError(f"a spline needs two frames and a positive spacing, got {frames} and {spacing}")
    inner = np.linspace(0.0, frames - 1.0, max(1, round((frames - 1) / spacing)) + 1)
    return np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])


class MotionForecaster(nn.Module):
    """Context of poses -> spline coefficients of the poses from its last frame on; inside in the training deviations.

    The curve is a share of the last pose and of the context's mean pose, learned for each coefficient and number, plus
    what a recurrent network adds.

    Args:
        mean, std: ``[P]`` of the pose states trained on; buffers, saved with the weights.
        recurrent: units of the network's GRU.
        hidden: units of the layer after it.
        dropout: before and after that layer.
        coefficients: K.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, mean: Tensor, std: Tensor, recurrent: int, hidden: int, dropout: float, coefficients: int
    ) -> None:
        super().__init__()
        size = len(mean)
        self.register_buffer("mean", mean.to(torch.float32, copy=True))
        self.register_buffer("std", std.to(torch.float32, copy=True))
        self.gru = nn.GRU(size, recurrent, batch_first=True)
        out = nn.Linear(hidden, coefficients * size)
        nn.init.zeros_(out.weight)
        nn.init.zeros_(out.bias)
        self.head = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(recurrent, hidden), nn.ReLU(), nn.Dropout(dropout), out
        )
        #: ``[2, K, P]``: shares of the last and of the mean pose.
        self.kept = nn.Parameter(torch.full((2, coefficients, size), 0.25))

    def normalise(self, poses: Tensor) -> Tensor:
        """Pose states ``[..., P]`` in their own units -> in deviations, float32."""
        return ((poses - self.mean) / self.std).to(torch.float32)

    def forward(self, context: Tensor) -> Tensor:
        """Context ``[B, C, P]`` in deviations -> coefficients ``[B, K, P]``."""
        seen, _ = self.gru(context)
        added = self.head(seen[:, -1]).unflatten(-1, self.kept.shape[1:])
        return context[:, -1:] * self.kept[0] + context.mean(dim=1, keepdim=True) * self.kept[1] + added


class KernelForecaster(nn.Module):
    """As :class:`MotionForecaster`, but that moments of training like the context add to the shares of its poses.

    Args:
        mean, std: ``[P]``, see :class:`MotionForecaster`.
        bins: the context's frames from the last one back, in so many parts, whose mean poses are compared.
        coefficients: K.
        kernel: ``[bins * P]`` -> ``[K * P]``.
    """

    mean: Tensor
    std: Tensor
    kept: Tensor

    def __init__(
        self, mean: Tensor, std: Tensor, bins: Sequence[int], coefficients: int, kernel: KernelRegression
    ) -> None:
        super().__init__()
        self.register_buffer("mean", mean.to(torch.float32, copy=True))
        self.register_buffer("std", std.to(torch.float32, copy=True))
        #: ``[2, K, P]``: shares of the last and of the mean pose.
        self.register_buffer("kept", torch.zeros(2, coefficients, len(mean)))
        self.bins, self.kernel = tuple(bins), kernel

    def parts(self, context: Tensor) -> Tensor:
        """Mean poses of the parts of contexts ``[B, C, P]``, the latest first, ``[B, bins * P]``."""
        return torch.cat([part.mean(1) for part in context.flip(1).split(self.bins, dim=1)], dim=-1)

    def forward(self, context: Tensor) -> Tensor:
        """Context ``[B, C, P]`` in deviations -> coefficients ``[B, K, P]``."""
        added = self.kernel(self.parts(context)).unflatten(-1, self.kept.shape[1:])
        return context[:, -1:] * self.kept[0] + context.mean(dim=1, keepdim=True) * self.kept[1] + added


class ContinuedForecaster(nn.Module):
    """As :class:`MotionForecaster`, but that a network goes on frame by frame, each fed back as the next input.

    The curve is the one nearest to its frames and to the last pose seen.

    What feeds back knows how a motion goes on in the next moments, and drifts later.

    Args:
        network: trained on poses of the same kind.
        frames: of the curve, the last one seen among them.
        spacing, fps: see :func:`spline_basis`.
    """

    nearest: Tensor

    def __init__(self, network: RecurrentForecaster, frames: int, spacing: int, fps: float) -> None:
        super().__init__()
        self.network, self.frames = network, frames
        inverse = torch.linalg.pinv(spline_basis(frames, spacing, fps)[0].double())
        self.register_buffer("nearest", inverse.float(), persistent=False)

    @property
    def mean(self) -> Tensor:
        """``[P]``, as the others'."""
        return self.network.mean

    @property
    def std(self) -> Tensor:
        """``[P]``, as the others'."""
        return self.network.std

    def forward(self, context: Tensor) -> Tensor:
        """Context ``[B, C, P]`` in deviations -> coefficients ``[B, K, P]``."""
        after = self.network.forecast(self.network.denormalise(context), self.frames - 1)
        return self.nearest @ torch.cat([context[:, -1:], self.network.normalise(after)], dim=1)
