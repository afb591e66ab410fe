"""From an MP4 to stored flow, from flow to visual features: the two steps the store is filled by."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.vision.body_parts import BodyPartEstimator, Picture, as_plane, body_part_rows, small_picture
from egopose.vision.encoders import FlowEncoder
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import Frame, iter_frames, probe_video


def extract_flow(
    path: str | PathLike[str],
    cfg: Mapping[str, Any] | FlowConfig,
    fps: float = 30.0,
    offset: float = 0.0,
    count: int | None = None,
    camera: Camera | None = None,
    finder: BodyPartEstimator | None = None,
) -> NDArray[np.float16]:
    """Flow of a video in step with a motion, and body parts that are found in its pictures.

    Args:
        path: any MP4.
        cfg: ``vision.flow``, see :class:`FlowConfig`.
        fps: the motion's rate.
        offset: sync offset (s): what the motion shows at t, the video shows at t + offset.
        count: frames of the motion; None takes the video to its end.
        camera: lens, shutter and rate of a real camera, to be undone.
        finder: the body-part estimator; None for flow alone.

    Returns:
        ``[T, 2, S, S]`` float16, image widths per frame; frame t's is from t-1 to t, frame 0's is zero. With a finder
        ``[T, 3, S, S]``, see :func:`egopose.vision.body_parts.as_plane`.

    Raises:
        InputError: the video cannot be read or does not cover the motion.
    """
    config = cfg if isinstance(cfg, FlowConfig) else FlowConfig(**dict(cfg))
    frames = _frames(path, config, fps, offset, count, camera)
    pictures: list[Picture] = []
    if finder is not None:
        frames = _remembered(frames, pictures)
    flow = np.stack(list(flow_of_frames(frames, config)))
    if camera is not None and camera.delay:
        flow = undo_rolling_shutter(flow, camera.delay, 1.0 / fps)
    if finder is None:
        return flow
    return np.concatenate([flow, as_plane(body_part_rows(finder, pictures, flow), config.stored_size)], axis=1)


def extract_body_parts(
    path: str | PathLike[str],
    flow: NDArray[np.floating],
    cfg: FlowConfig,
    finder: BodyPartEstimator,
    fps: float,
    offset: float,
    camera: Camera | None,
) -> NDArray[np.float16]:
    """Body parts ``[T, 2 Q]`` of a video whose flow ``[T, 2, S, S]`` is there.

    See :func:`~egopose.vision.body_parts.body_part_rows`.

    Other arguments, and errors, as of :func:`extract_flow`.
    """
    pictures = [small_picture(frame) for frame in _frames(path, cfg, fps, offset, len(flow), camera)]
    return body_part_rows(finder, pictures, flow)


def _frames(
    path: str | PathLike[str], config: FlowConfig, fps: float, offset: float, count: int | None, camera: Camera | None
) -> Iterator[Frame]:
    """Frames at the motion's times, without what the lens does to them."""
    if camera is None:
        return iter_frames(path, fps, offset, count)
    info = probe_video(path)
    rectify = camera.rectifier(info.width, info.height, config.working_size)
    # The middle row, which stands for the frame, is exposed half a readout after its stamp.
    return map(rectify, iter_frames(path, fps, offset - 0.5 * camera.delay, count, camera.fps))


def _remembered(frames: Iterator[Frame], pictures: list[Picture]) -> Iterator[Frame]:
    for frame in frames:
        pictures.append(small_picture(frame))
        yield frame


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
