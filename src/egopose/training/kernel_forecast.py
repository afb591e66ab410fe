"""The kernel forecaster's training: what was seen up to moments of training, and the motion that followed each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.data.spans import Span
from egopose.models.kernel_regression import KernelRegression, fit_kernel_regression
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import KernelForecaster, spline_basis
from egopose.models.regressor import state_statistics
from egopose.training.forecaster_settings import ForecasterSettings


@dataclass(frozen=True)
class Contexts:
    """What has been seen up to some frames, pose states.

    Args:
        rows: ``[R, context, P]``.
        row: ``[F]`` which of them ends at a frame, -1 for none.
    """

    rows: Tensor
    row: Tensor

    @classmethod
    def at(cls, rows: Tensor, starts: Tensor, frames: int) -> Contexts:
        """Rows of the frames ``starts [R]`` of ``frames``."""
        row = torch.full((frames,), -1, dtype=torch.int64)
        row[starts] = torch.arange(len(starts))
        return cls(rows, row)

    def __getitem__(self, now: Tensor) -> Tensor:
        """``[B, context, P]`` up to the frames ``now [B]``, each of which has one."""
        return self.rows[self.row[now]]


def blank_kernel_forecaster(
    settings: ForecasterSettings, mean: Tensor, std: Tensor, fps: float, centres: int = 0
) -> KernelForecaster:
    """One that knows nothing yet, for pose states of these statistics ``[P]`` and as many moments to remember."""
    assert settings.kernel is not None
    count, size = spline_basis(settings.horizon + 1, settings.spacing, fps)[0].shape[1], len(mean)
    inputs = len(settings.kernel.bins) * size
    kernel = KernelRegression(inputs, min(settings.kernel.axes, inputs), centres, count * size)
    return KernelForecaster(mean, std, settings.kernel.bins, count, kernel)


def fit_kernel_forecaster(
    contexts: Contexts,
    poses: Tensor,
    fragments: Sequence[Span],
    mirror: StateMirror,
    settings: ForecasterSettings,
    fps: float,
) -> KernelForecaster:
    """The kernel forecaster of the contexts in ``fragments`` and their mirror images.

    Args:
        contexts: see :class:`ForecastLearner`.
        poses: ``[F, P]`` true ones.
        fragments: training stretches, in global frames.
        mirror: of pose states.
        settings: with a kernel's.
        fps: frames per second.

    Raises:
        InputError: no fragment holds a context and the least of a future.
    """
    kernel = settings.kernel
    assert kernel is not None
    spans = [s for s in fragments if s.stop - s.start >= settings.context + kernel.least]
    if not spans:
        cause = f"none is longer than {settings.context} + {kernel.least} frames"
        raise InputError("forecaster", "fragments", cause)
    now = torch.cat([torch.arange(s.start + settings.context - 1, s.stop - kernel.least) for s in spans])
    stop = torch.cat([torch.full((s.stop - s.start - settings.context - kernel.least + 1,), s.stop) for s in spans])
    chosen = torch.linspace(0, len(now) - 1, min(kernel.centres // 2, len(now))).round().long()
    now, stop = now[chosen], stop[chosen]
    true = torch.cat([poses[s.start : s.stop] for s in spans])
    mean, std = state_statistics(torch.cat([true, mirror.state(true)]), settings.std_floor)
    model = blank_kernel_forecaster(settings, mean, std, fps)
    basis = spline_basis(settings.horizon + 1, settings.spacing, fps)[0]
    frames = torch.minimum(now[:, None] + torch.arange(len(basis)), stop[:, None] - 1)
    seen = contexts[now]
    seen, future = ((torch.cat([rows, mirror.state(rows)]) - model.mean) / model.std for rows in (seen, poses[frames]))
    wanted = torch.linalg.pinv(basis) @ future
    # Shares of the last and the mean pose, for each coefficient and number of its own.
    given = torch.stack([seen[:, -1], seen.mean(1)], dim=-1)
    square = torch.einsum("npa,npb->pab", given, given) / len(given)
    square += kernel.kept_ridge * torch.diag_embed(square.diagonal(dim1=-2, dim2=-1)) + 1e-6 * torch.eye(2)
    product = torch.einsum("npa,nkp->pak", given, wanted) / len(given)
    model.kept.copy_(torch.linalg.solve(square, product).permute(1, 2, 0))
    rest = wanted - torch.einsum("npa,akp->nkp", given, model.kept)
    model.kernel = fit_kernel_regression(
        model.parts(seen),
        kernel.added * rest.flatten(1),
        axes=kernel.axes,
        whitening=kernel.whitening,
        ridge=kernel.ridge,
        length=kernel.length,
    )
    return model.eval()
