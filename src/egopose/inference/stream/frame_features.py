"""From frames to visual features, one at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.models.regressor import StateRegressor
from egopose.vision.body_parts import BodyPartEstimator, Picture, as_plane, pair_rows
from egopose.vision.film import PICTURE, small_picture
from egopose.vision.flow import FlowConfig, FlowEstimator, grey_square
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import Frame

# Many files' stamps are whole milliseconds: frames this near to a whole number of control frames lie that far apart.
_ROUNDING = 0.05


class FrameFeatures:
    """Lens, flow, shutter and encoder.

    Args:
        regressor: whose encoder it is, in eval mode.
        flow: as the regressor was trained with.
        camera: that takes the frames; its ``fps`` is the source's affair.
        rate: control frames a second.
        finder: of limbs, where the regressor sees them.
    """

    def __init__(
        self,
        regressor: StateRegressor,
        flow: FlowConfig,
        camera: Camera,
        rate: float,
        finder: BodyPartEstimator | None = None,
    ) -> None:
        self._regressor, self._size, self._camera, self._rate = regressor, flow.working_size, camera, rate
        self._estimator = FlowEstimator(flow)
        self._still = np.zeros((2, flow.stored_size, flow.stored_size), np.float32)
        self._rectify: Callable[[Frame], Frame] = lambda frame: frame
        self._shape: tuple[int, ...] = ()
        self._before: tuple[float, NDArray[np.uint8]] | None = None
        self._finder, self._picture = finder, np.zeros((PICTURE, PICTURE, 3), np.uint8)

    def flow(self, image: Frame, time: float) -> NDArray[np.float32]:
        """Flow ``[2, S, S]`` from the image given before to this one, in widths a control frame; the first's is zero.
        With a finder ``[3, S, S]``, as :func:`egopose.vision.features.extract_flow`.

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
        rectified = self._rectify(image)
        before, now = self._before, grey_square(rectified, self._size)
        self._before = time, now
        flow = self._still if before is None else self._moved(before, time, now)
        return flow if self._finder is None else self._with_limbs(flow, small_picture(rectified), before is None)

    def _moved(
        self, before: tuple[float, NDArray[np.uint8]], time: float, now: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        flow = self._estimator(before[1], now)
        interval = time - before[0]
        if self._camera.delay:
            flow = undo_rolling_shutter(flow, self._camera.delay, interval)
        passed = interval * self._rate
        whole = max(round(passed), 1)
        return flow.astype(np.float32) / np.float32(whole if abs(passed - whole) < _ROUNDING else passed)

    def _with_limbs(self, flow: NDArray[np.float32], picture: Picture, first: bool) -> NDArray[np.float32]:
        assert self._finder is not None
        before, self._picture = picture if first else self._picture, picture
        earlier, now = (torch.from_numpy(one).permute(2, 0, 1)[None] for one in (before, picture))
        rows = pair_rows(self._finder, earlier, now, torch.from_numpy(flow[None]))
        return np.concatenate([flow, as_plane(rows, flow.shape[-1])[0].astype(np.float32)])

    @torch.no_grad()
    def features(self, flow: NDArray[np.float32]) -> Tensor:
        """Visual features ``[D]`` of a flow."""
        return self._regressor.encode(torch.from_numpy(flow[None]))[0]
