"""From frames to visual features, one at a time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.models.regressor import StateRegressor
from egopose.vision.flow import FlowConfig, FlowEstimator, grey_square
from egopose.vision.video import Frame


class Sight:
    """Flow and encoder.

    Args:
        regressor: whose encoder it is, in eval mode.
        flow: as the regressor was trained with.
    """

    def __init__(self, regressor: StateRegressor, flow: FlowConfig) -> None:
        self._regressor, self._size = regressor, flow.working_size
        self._estimator = FlowEstimator(flow)
        self._still = np.zeros((2, flow.stored_size, flow.stored_size), np.float16)
        self._before: NDArray[np.uint8] | None = None

    def flow(self, image: Frame) -> NDArray[np.float16]:
        """Flow ``[2, S, S]`` from the image given before to this one (widths); the first image's is zero."""
        before, self._before = self._before, grey_square(image, self._size)
        return self._still if before is None else self._estimator(before, self._before)

    @torch.no_grad()
    def features(self, flow: NDArray[np.float16], intervals: int = 1) -> Tensor:
        """Visual features ``[D]`` of a flow over ``intervals`` control frames, by its mean over them."""
        per_frame = torch.from_numpy(flow[None]).float()
        return self._regressor.encode(per_frame if intervals == 1 else per_frame / intervals)[0]
