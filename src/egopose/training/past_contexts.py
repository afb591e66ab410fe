"""What a blended F that has not seen a training frame makes of the frames up to it, as a clip by themselves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from egopose.core.torch_settings import torch_threads
from egopose.data.spans import Span, without_block
from egopose.humanoid.model import HumanoidModel
from egopose.models.blended import MeanOfKernels
from egopose.models.predictions import Flow
from egopose.models.regressor import StateRegressor
from egopose.models.regressor_settings import RegressorSettings
from egopose.training.blended_regressor import (
    KernelSettings,
    fit_kernels,
    importance_of,
    mirror_image,
    view_table,
    windowed,
)

_CONTEXTS = 64  # contexts that are regressed together


@torch.no_grad()
def past_contexts(
    model: StateRegressor,
    crossed_states: Tensor,
    flow: Flow,
    states: Tensor,
    takes: Sequence[Span],
    fragments: Sequence[Span],
    blocks: Sequence[Sequence[Span]],
    humanoid: HumanoidModel,
    settings: RegressorSettings,
    kernel_settings: KernelSettings,
    starts: Tensor,
    context: int,
) -> Tensor:
    """What is known at a training frame of it and the frames before, by kernels that have not seen them.

    A blended F looks ahead: a forecast learned from what it says of whole takes would know of what it forecasts. Of
    the network, whose cross-fitted forms are not kept, the states of whole takes stand in.

    Args:
        model: the blended F.
        crossed_states, flow, states, takes, fragments, blocks, humanoid, settings, kernel_settings: as for
            :func:`blend`.
        starts: ``[N]`` global frames of the blocks, the last ones of contexts that lie in their take.
        context: frames.

    Returns:
        ``[N, context, S]`` states z, each row as if its last frame were the clip's.
    """
    with torch_threads(settings.threads):
        views = view_table(flow, takes, kernel_settings, settings.encode_batch)
        seen = windowed(views, takes, kernel_settings)
        wanted, by_network = model.normalise(states), model.normalise(crossed_states)
        image = mirror_image(views, takes, states, model, humanoid, kernel_settings)
        importance, windows = importance_of(humanoid, model.state_std), kernel_settings.windows()
        out = torch.zeros(len(starts), context, len(model.state_std))
        margin = max(settings.margin, context)
        for block in blocks:
            mine = torch.cat([((starts >= s.start) & (starts < s.stop)).nonzero()[:, 0] for s in block])
            others = without_block(fragments, block, margin, margin)
            kernels = fit_kernels(seen, wanted, others, kernel_settings, importance, image)
            for kernel in kernels:
                kernel.exact = False
            left_out = MeanOfKernels(kernels)
            for part in mine.split(_CONTEXTS):
                frames = starts[part, None] + torch.arange(1 - context, 1)
                by_kernel = left_out(windows(windows.pad(views[frames])))
                out[part] = model.head.network_share * by_network[frames] + model.head.kernel_share * by_kernel
    return out * model.state_std + model.state_mean
