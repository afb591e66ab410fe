"""Kernel ridge regression: what was seen is compared with every moment of training, and the likest ones answer.

With minutes of video it errs less than a network trained on the same frames, and it is solved in seconds. The kernel is
``exp(-length * distance)`` (Laplacian: it trusts near neighbours more than a Gaussian one) on principal axes of the
input.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: Standard deviations: an input further from the training mean counts as so far.
_INPUT_CLIP = 5.0
#: Centres are compared with so many inputs at a time.
_ROWS = 4096


class KernelRegression(nn.Module):
    """``[..., V] -> [..., S]``; all it knows are buffers, blank until :func:`fit_kernel_regression`.

    Args:
        input_size: V.
        axes: principal axes kept.
        centres: moments of training that are remembered.
        output_size: S.
    """

    input_mean: Tensor
    input_std: Tensor
    projection: Tensor
    centres: Tensor
    coefficients: Tensor
    output_mean: Tensor
    length: Tensor

    def __init__(self, input_size: int, axes: int, centres: int, output_size: int) -> None:
        super().__init__()
        self.register_buffer("input_mean", torch.zeros(input_size))
        self.register_buffer("input_std", torch.ones(input_size))
        self.register_buffer("projection", torch.zeros(input_size, axes))
        self.register_buffer("centres", torch.zeros(centres, axes))
        self.register_buffer("coefficients", torch.zeros(centres, output_size))
        self.register_buffer("output_mean", torch.zeros(output_size))
        self.register_buffer("length", torch.ones(()))
        #: Matrix products are some times as fast, but their rounding tells a batch from its rows.
        self.exact = True

    def project(self, inputs: Tensor) -> Tensor:
        """``[N, V]`` -> ``[N, axes]``."""
        return ((inputs - self.input_mean) / self.input_std).clamp(-_INPUT_CLIP, _INPUT_CLIP) @ self.projection

    def forward(self, inputs: Tensor) -> Tensor:
        """``[..., V]`` -> ``[..., S]`` float32."""
        rows = inputs.reshape(-1, inputs.shape[-1])
        parts = [self._answer(rows[i : i + _ROWS]) for i in range(0, len(rows), _ROWS)]
        return torch.cat(parts).reshape(*inputs.shape[:-1], -1)

    def _answer(self, rows: Tensor) -> Tensor:
        how = "donot_use_mm_for_euclid_dist" if self.exact else "use_mm_for_euclid_dist"
        distance = torch.cdist(self.project(rows), self.centres, compute_mode=how)
        return (-self.length * distance).exp() @ self.coefficients + self.output_mean


def fit_kernel_regression(
    inputs: Tensor,
    outputs: Tensor,
    *,
    axes: int,
    whitening: float,
    ridge: float,
    length: float,
    importance: Tensor | None = None,
    metric_rows: int = 600,
) -> KernelRegression:
    """The regression of ``outputs`` on ``inputs``, every row a centre.

    Args:
        inputs: ``[N, V]``.
        outputs: ``[N, S]``.
        axes: principal axes kept; fewer where there are not so many.
        whitening: each axis is divided by its standard deviation to this power: 0 leaves them, 1 makes all count alike.
        ridge: added to the kernel's diagonal, which is 1.
        length: of the kernel, in medians of the distances between centres.
        importance: ``[S]`` of the outputs for the metric, or None to leave all directions of the axes alike. With it a
            first fit tells along which directions the outputs change, and a second one measures distances by that: one
            step of a recursive feature machine (Radhakrishnan et al., Science 2024).
        metric_rows: rows at which the first fit's slopes are taken, evenly chosen.

    Raises:
        ValueError: fewer than two rows.
    """
    if len(inputs) < 2:
        raise ValueError(f"two rows are needed, there are {len(inputs)}")
    kept = min(axes, inputs.shape[1])
    model = KernelRegression(inputs.shape[1], kept, len(inputs), outputs.shape[1])
    model.input_mean.copy_(inputs.mean(0))
    model.input_std.copy_(inputs.std(0).clamp(min=1e-6))
    model.projection = torch.eye(inputs.shape[1])
    standard = model.project(inputs).double()
    variances, directions = torch.linalg.eigh(standard.T @ standard / len(standard))
    variances, directions = variances[-kept:].clamp(min=1e-9), directions[:, -kept:]
    model.projection = (directions * variances ** (-whitening / 2)).float()
    _solve(model, inputs, outputs, ridge, length)
    if importance is not None:
        rows = torch.linspace(0, len(inputs) - 1, min(metric_rows, len(inputs))).round().long()
        model.projection = model.projection @ _slopes(model, rows, importance)
        _solve(model, inputs, outputs, ridge, length)
    return model.eval()


def _solve(model: KernelRegression, inputs: Tensor, outputs: Tensor, ridge: float, length: float) -> None:
    """Centres and coefficients of ``model`` for its projection."""
    model.centres = model.project(inputs)
    distances = torch.cdist(model.centres.double(), model.centres.double())
    model.length = (length / distances.median().clamp(min=1e-9)).float()
    wanted = outputs.double()
    model.output_mean = wanted.mean(0).float()
    kernel = (-model.length.double() * distances).exp()
    kernel.diagonal().add_(ridge)
    factor = torch.linalg.cholesky(kernel)
    model.coefficients = torch.cholesky_solve(wanted - wanted.mean(0), factor).float()


def _slopes(model: KernelRegression, rows: Tensor, importance: Tensor) -> Tensor:
    """``[axes, axes]`` square root of the square root of the mean outer product of the outputs' slopes at ``rows``."""
    points, centres = model.centres[rows], model.centres
    distance = torch.cdist(points, centres)
    pull = model.length * (-model.length * distance).exp() / distance.clamp(min=1e-6)
    pull[torch.arange(len(rows)), rows] = 0.0  # the kernel has a peak and no slope at its centre
    total = torch.zeros(centres.shape[1], centres.shape[1], dtype=torch.float64)
    for column in importance.nonzero()[:, 0].tolist():
        weight = importance[column] * model.coefficients[:, column, None]
        slope = pull @ (weight * centres) - points * (pull @ weight)
        total += (slope.T @ slope).double()
    variances, directions = torch.linalg.eigh(total * len(total) / total.trace().clamp(min=1e-12))
    return ((directions * variances.clamp(min=0.0) ** 0.25) @ directions.T).float()
