"""Where forecasts begin: the state regressor's states on the frames seen, and on them alone.

The regressor reads video both ways in time, so its states of a whole take know what is to be forecast. Here each
context is a clip by itself (Yuan & Kitani 2019, section 3.2: z_1 is from estimation on V_{-f:0}).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from egopose.data.spans import Span
from egopose.models.predictions import Flow, predict_span
from egopose.models.regressor import StateRegressor


def context_states(
    model: StateRegressor, flow: Flow, first_frames: Sequence[int], context: int, encode_batch: int = 512
) -> Tensor:
    """Humanoid states z ``[W, context, S]`` of the frames ``first .. first + context - 1`` of each window.

    Args:
        model: trained, in evaluation mode.
        flow: of the whole store.
        first_frames: ``[W]`` global frames.
        context: frames.
        encode_batch: frames a pass through the encoder.
    """
    spans = [Span(first, first + context) for first in first_frames]
    return torch.stack([predict_span(model, flow, span, encode_batch)["humanoid_state"] for span in spans])
