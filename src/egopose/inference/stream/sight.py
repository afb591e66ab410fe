"""From frames to visual features, one at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.models.regressor import StateRegressor
from egopose.vision.flow import FlowConfig, FlowEstimator, grey_square
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import Frame

# Many files' stamps are whole milliseconds: frames this near to a whole number of control frames lie that far apart.
_ROUNDING = 0.05


class Sight:
    """Lens, flow, shutter and encoder.

    Args:
        regressor: whose encoder it is, in eval mode.
        flow: as the regressor was trained with.
        camera: that takes the frames; its ``fps`` is the source's affair.
        rate: control frames a second.
    """

    def __init__(self, regressor: StateRegressor, flow: FlowConfig, camera: Camera, rate: float) -> None:
        self._regressor, self._size, self._camera, self._rate = regressor, flow.working_size, camera, rate
        self._estimator = FlowEstimator(flow)
        self._still = np.zeros((2, flow.stored_size, flow.stored_size), np.float32)
        self._rectify: Callable[[Frame], Frame] = lambda frame: frame
        self._shape: tuple[int, ...] = ()
        self._before: tuple[float, NDArray[np.uint8]] | None = None

    def flow(self, image: Frame, time: float) -> NDArray[np.float32]:
        """Flow ``[2, S, S]`` from the image given before to this one, in widths a control frame; the first's is zero.

        Whatever the camera's rate, the flow is what the motion in it would give in a control frame: it is divided by
        the control frames that passed between the two.

        Args:
            image: RGB.
            time: s at which it was taken; only differences count.

        Raises:
            InputError: the camera's distortion is not of this lens.
        """
        if image.shape != self._shape:
            self._rectify = self._camera.rectifier(image.shape[1], image.shape[0], self._size)
            # A source that comes back in another size: nothing is known between the two.
            self._shape, self._before = image.shape, None
        before, now = self._before, grey_square(self._rectify(image), self._size)
        self._before = time, now
        if before is None:
            return self._still
        flow = self._estimator(before[1], now)
        interval = time - before[0]
        if self._camera.readout:
            flow = undo_rolling_shutter(flow, self._camera.readout, interval)
        passed = interval * self._rate
        whole = max(round(passed), 1)
        return flow.astype(np.float32) / np.float32(whole if abs(passed - whole) < _ROUNDING else passed)

    @torch.no_grad()
    def features(self, flow: NDArray[np.float32]) -> Tensor:
        """Visual features ``[D]`` of a flow."""
        return self._regressor.encode(torch.from_numpy(flow[None]))[0]
