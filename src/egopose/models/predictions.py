"""What the trained state regressor sees in whole takes, and how far off it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from egopose.core.torch_settings import torch_threads
from egopose.data.spans import Span
from egopose.models.regressor import StateRegressor
from egopose.models.regressor_settings import RegressorSettings

Flow = Any
"""``[F, 2, S, S]`` (or features ``[F, D]``), a tensor or a NumPy memory map, indexed by frames a batch at a time."""


def take_frames(flow: Flow, frames: np.ndarray) -> Tensor:
    """Rows ``frames [N]`` as float32, a copy."""
    rows = flow[torch.as_tensor(frames)] if isinstance(flow, Tensor) else torch.from_numpy(np.asarray(flow[frames]))
    return rows.to(torch.float32, copy=True)


@torch.no_grad()
def predict_span(
    model: StateRegressor, flow: Flow, span: Span, encode_batch: int, lookahead: int | None = None
) -> dict[str, Tensor]:
    """F over one stretch ``[T, ...]`` as a clip by itself; :meth:`StateRegressor.forward` names the keys.

    The model must be in eval mode: ``encode_batch`` frames at a time pass the encoder.
    """
    parts = [np.arange(at, min(at + encode_batch, span.stop)) for at in range(span.start, span.stop, encode_batch)]
    features = torch.cat([model.encode(take_frames(flow, part)) for part in parts])
    return {k: v[0] for k, v in model.from_features(features[None], lookahead=lookahead).items()}


def predict_takes(
    model: StateRegressor, flow: Flow, takes: Sequence[Span], settings: RegressorSettings, causal: bool = False
) -> dict[str, Tensor]:
    """F over whole takes (or any stretches), each a clip by itself.

    Args:
        model: trained; put in eval mode.
        flow: of the whole store.
        takes: stretches in global frames; what lies in none of them is zero in the answer.
        settings: ``encode_batch``, ``lookahead``, ``threads``.
        causal: each output sees ``lookahead`` frames ahead and no more.

    Returns:
        Float32 ``visual_features [F, D]``, ``visual_context [F, C]``, ``humanoid_state [F, S]`` (z in its own units).
    """
    model.eval()
    widths = {
        "visual_features": model.context.feature_size,
        "visual_context": model.context.output_size,
        "humanoid_state": len(model.state_mean),
    }
    tables = {key: torch.zeros(len(flow), width) for key, width in widths.items()}
    with torch_threads(settings.threads):
        for span in takes:
            outputs = predict_span(model, flow, span, settings.encode_batch, settings.lookahead if causal else None)
            for key, table in tables.items():
                table[span.start : span.stop] = outputs[key]
    return tables
