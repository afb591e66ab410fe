"""The state regressor F beside a kernel regression: ``share * F + share * kernel + rest * mean``.

A blended F is a :class:`StateRegressor` of other parts, so that whatever takes an F takes it: its encoder gives the
network's features, the flow's mean in a few cells and the output of the body-part estimator, its context the
network's context and what those others saw in the half second around, its head mixes what the two make of it. Beyond
Yuan & Kitani 2019, whose PoseReg it is not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from egopose.models.context import BidirectionalContext, LstmState
from egopose.models.kernel_regression import KernelRegression
from egopose.models.regressor import StateRegressor
from egopose.vision.encoders import FLOW_CHANNELS, FlowEncoder


def flow_cells(flow: Tensor, cells: int) -> Tensor:
    """Flow ``[B, 2, H, W]`` -> its mean in ``cells x cells`` parts of the picture, ``[B, 2 cells^2]`` float32."""
    return functional.adaptive_avg_pool2d(flow.to(torch.float32), cells).flatten(1)


def kernel_view(seen: Tensor, cells: int, limbs: int) -> Tensor:
    """What the kernel looks at of each frame, ``[B, 2 cells^2 + limbs]`` float32.

    Args:
        seen: flow ``[B, 2, H, W]``, with a third plane where there are limbs
            (:func:`egopose.vision.body_parts.as_plane`).
        cells: see :func:`flow_cells`.
        limbs: numbers of the third plane that count.

    Raises:
        ValueError: there is no third plane, or one too many.
    """
    if seen.shape[1] != FLOW_CHANNELS + bool(limbs):
        planes = "flow and limbs" if limbs else "flow alone"
        raise ValueError(f"this regressor looks at {planes}, got {list(seen.shape)}")
    flow = flow_cells(seen[:, :FLOW_CHANNELS], cells)
    return torch.cat([flow, seen[:, FLOW_CHANNELS:].flatten(1)[:, :limbs].to(torch.float32)], dim=1)


class CellEncoder(nn.Module):
    """A network's visual features and what the kernel looks at, side by side.

    Args:
        network: the encoder of F.
        cells, limbs: see :func:`kernel_view`.
    """

    def __init__(self, network: FlowEncoder, cells: int, limbs: int = 0) -> None:
        super().__init__()
        self.network, self.cells, self.limbs = network, cells, limbs
        self.features = network.features + FLOW_CHANNELS * cells**2 + limbs

    def forward(self, seen: Tensor) -> Tensor:
        """``[B, 2 or 3, H, W]`` -> ``[B, D + 2 cells^2 + limbs]`` float32."""
        return torch.cat([self.network(seen[:, :FLOW_CHANNELS]), kernel_view(seen, self.cells, self.limbs)], dim=1)


class TimeWindows(nn.Module):
    """Means of a row over Gaussian windows of time, at frames before and after; beyond an end its last frame stands.

    Args:
        reach: frames from the middle to the centre of the outermost window.
        step: frames from window to window; divides ``reach``.
        width: standard deviation of a window in frames.
        also: further sets of windows, each ``(reach, step, width)``; their means follow those of the first set.
    """

    weights: Tensor

    def __init__(self, reach: int, step: int, width: float, also: Sequence[tuple[int, int, float]] = ()) -> None:
        super().__init__()
        sets = [(reach, step, width), *also]
        #: Windows of each set.
        self.counts = [len(range(-reach, reach + 1, step)) for reach, step, _ in sets]
        #: Frames either side that count.
        self.radius = max(reach + math.ceil(3 * width) for reach, _, width in sets)
        self.count = sum(self.counts)
        frame = torch.arange(-self.radius, self.radius + 1, dtype=torch.float64)
        rows = torch.stack(
            [
                torch.exp(-0.5 * ((frame - centre) / width) ** 2)
                for reach, step, width in sets
                for centre in range(-reach, reach + 1, step)
            ]
        )
        self.register_buffer("weights", (rows / rows.sum(1, keepdim=True)).float(), persistent=False)

    def forward(self, padded: Tensor) -> Tensor:
        """``[B, T + 2 radius, D]`` -> ``[B, T, count * D]``."""
        batch, frames, size = padded.shape
        rows = padded.transpose(1, 2).reshape(batch * size, 1, frames)
        seen = functional.conv1d(rows, self.weights[:, None])
        return seen.reshape(batch, size, self.count, -1).permute(0, 3, 2, 1).flatten(2)

    def pad(self, row: Tensor, before: Tensor | None = None) -> Tensor:
        """``[B, T, D]`` with ``radius`` frames put to either end, ``before [B, radius, D]`` where they are known."""
        first = row[:, :1].expand(-1, self.radius, -1) if before is None else before
        return torch.cat([first, row, row[:, -1:].expand(-1, self.radius, -1)], dim=1)


class BlendedContext(BidirectionalContext):
    """Context of a network's features, then the time windows of the cells: as :class:`BidirectionalContext`.

    The causal forms know no frame past the look-ahead: the last one seen stands for those to come.

    Args:
        network: the context of F; its weights are taken.
        cell_size: numbers of the cells, behind the network's features.
        windows: of time.
    """

    def __init__(self, network: BidirectionalContext, cell_size: int, windows: TimeWindows) -> None:
        hidden = network.forward_lstm.hidden_size
        super().__init__(network.feature_size, hidden)
        self.load_state_dict(network.state_dict())
        self.windows = windows
        self.network_size, self.network_output = network.feature_size, network.output_size
        self.feature_size = network.feature_size + cell_size
        self.output_size = network.output_size + windows.count * cell_size

    def _split(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return features[..., : self.network_size], features[..., self.network_size :]

    def forward(self, visual_features: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Context of every frame from the whole row. Raises ValueError for rows of unequal length."""
        if lengths is not None:
            raise ValueError("a blended regressor reads whole rows")
        seen, cells = self._split(visual_features)
        return torch.cat([super().forward(seen), self.windows(self.windows.pad(cells))], dim=-1)

    def causal(self, visual_features: Tensor, lookahead: int = 10) -> Tensor:
        seen, cells = self._split(visual_features)
        frames, radius = cells.shape[1], self.windows.radius
        start = torch.arange(frames, device=cells.device)
        reach = start[:, None] + torch.arange(-radius, radius + 1, device=cells.device)
        reach = torch.minimum(reach, (start + lookahead).clamp(max=frames - 1)[:, None]).clamp(min=0)
        around = self.windows(cells[:, reach].flatten(0, 1)).reshape(len(cells), frames, -1)
        return torch.cat([super().causal(seen, lookahead), around], dim=-1)

    def causal_step(self, window: Tensor, state: LstmState | None = None) -> tuple[Tensor, LstmState]:
        contexts, state = self.causal_window(window, state)
        return contexts[:, 0], state

    def causal_window(self, window: Tensor, state: LstmState | None = None) -> tuple[Tensor, LstmState]:
        seen, cells = self._split(window)
        lstm, past = (None, None) if state is None else (state[:2], state[2])
        contexts, after = super().causal_window(seen, lstm)
        padded = self.windows.pad(cells, past)
        passed = padded[:, 1 : 1 + self.windows.radius]
        return torch.cat([contexts, self.windows(padded)], dim=-1), (*after, passed)


class MeanOfKernels(nn.Module):
    """The mean of what several kernel regressions say, each of its own set of time windows.

    Args:
        kernels: one a set.
    """

    def __init__(self, kernels: Sequence[KernelRegression]) -> None:
        super().__init__()
        self.kernels = nn.ModuleList(kernels)
        self.sizes = [len(kernel.input_mean) for kernel in kernels]

    def forward(self, windows: Tensor) -> Tensor:
        """``[..., V]``, the sets one after another -> ``[..., S]``."""
        parts = windows.split(self.sizes, dim=-1)
        answers = [kernel(part) for kernel, part in zip(self.kernels, parts, strict=True)]
        return torch.stack(answers).mean(0)


class BlendedHead(nn.Module):
    """Context to state in normalised units, whose zero is the training mean.

    Args:
        network: the head of F.
        kernel: of the time windows.
        context_size: width of the network's own context.
        state_size: S.
    """

    network_share: Tensor
    kernel_share: Tensor

    def __init__(
        self, network: nn.Module, kernel: KernelRegression | MeanOfKernels, context_size: int, state_size: int
    ) -> None:
        super().__init__()
        self.network, self.kernel, self.context_size = network, kernel, context_size
        self.register_buffer("network_share", torch.zeros(state_size))
        self.register_buffer("kernel_share", torch.zeros(state_size))

    def forward(self, context: Tensor) -> Tensor:
        """``[..., C]`` -> ``[..., S]``."""
        own, windows = context[..., : self.context_size], context[..., self.context_size :]
        return self.network_share * self.network(own) + self.kernel_share * self.kernel(windows)


def blended_regressor(
    network: StateRegressor, kernels: Sequence[KernelRegression], cells: int, windows: TimeWindows, limbs: int = 0
) -> StateRegressor:
    """F of ``network``'s parts and the kernels; the shares of its head are zero until they are set.

    Args:
        network: trained, with its encoder; its parts become those of the answer.
        kernels: one a set of ``windows``, over ``cells``.
        cells, limbs: see :func:`kernel_view`.
        windows: of time.

    Raises:
        ValueError: the network has no encoder of flow, or kernels and sets of windows differ in number.
    """
    if len(kernels) != len(windows.counts):
        raise ValueError(f"{len(windows.counts)} sets of windows need as many kernels, not {len(kernels)}")
    if not isinstance(network.encoder, FlowEncoder):
        raise ValueError("a regressor of flow is needed")
    size, own = len(network.state_mean), network.context.output_size
    size_seen = FLOW_CHANNELS * cells**2 + limbs
    network.encoder = CellEncoder(network.encoder, cells, limbs)
    network.context = BlendedContext(network.context, size_seen, windows)
    kernel = kernels[0] if len(kernels) == 1 else MeanOfKernels(kernels)
    network.head = BlendedHead(network.head, kernel, own, size)
    return network.eval()
