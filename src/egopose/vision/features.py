"""From an MP4 to stored flow, from flow to visual features: the two steps the store is filled by."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.vision.encoders import FlowEncoder
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import iter_frames, probe_video


def extract_flow(
    path: str | PathLike[str],
    cfg: Mapping[str, Any] | FlowConfig,
    fps: float = 30.0,
    offset: float = 0.0,
    count: int | None = None,
    camera: Camera | None = None,
) -> NDArray[np.float16]:
    """Flow of a video in step with a motion.

    Args:
        path: any MP4.
        cfg: ``vision.flow``, see :class:`FlowConfig`.
        fps: the motion's rate.
        offset: sync offset (s): what the motion shows at t, the video shows at t + offset.
        count: frames of the motion; None takes the video to its end.
        camera: lens, shutter and rate of a real camera, to be undone.

    Returns:
        ``[T, 2, S, S]`` float16, image widths per frame; frame t's is from t-1 to t, frame 0's is zero.

    Raises:
        InputError: the video cannot be read or does not cover the motion.
    """
    config = cfg if isinstance(cfg, FlowConfig) else FlowConfig(**dict(cfg))
    if camera is None:
        return np.stack(list(flow_of_frames(iter_frames(path, fps, offset, count), config)))
    info = probe_video(path)
    rectify = camera.rectifier(info.width, info.height, config.working_size)
    # The middle row, which stands for the frame, is exposed half a readout after its stamp.
    frames = iter_frames(path, fps, offset - 0.5 * camera.readout, count, camera.fps)
    flow = np.stack(list(flow_of_frames(map(rectify, frames), config)))
    return undo_rolling_shutter(flow, camera.readout, 1.0 / fps) if camera.readout else flow


@torch.no_grad()
def encode(encoder: FlowEncoder, flow: NDArray[np.floating] | Tensor, batch: int) -> Tensor:
    """Visual features ``[T, features]`` float32 of flow ``[T, 2, S, S]``, ``batch`` frames at a time, in eval mode.

    The encoder is left in the mode it was in. The result does not depend on ``batch``.
    """
    training = encoder.training
    device = next(encoder.parameters()).device
    encoder.eval()
    parts = [encoder(torch.as_tensor(flow[i : i + batch]).to(device)).cpu() for i in range(0, len(flow), batch)]
    encoder.train(training)
    return torch.cat(parts) if parts else torch.zeros(0, encoder.features)
