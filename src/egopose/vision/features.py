"""From an MP4 to stored flow, from flow to visual features: the two steps the store is filled by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.vision.body_parts import BodyPartEstimator, Picture, as_plane, body_part_rows
from egopose.vision.encoders import FlowEncoder
from egopose.vision.film import film_rows, frames_at, small_picture
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera


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
    rows = list(film_rows(path, config, fps, offset, count, camera, pictures=finder is not None))
    flow = np.stack([row[0] for row in rows])
    return flow if finder is None else with_body_parts(finder, [row[1] for row in rows if row[1] is not None], flow)


def with_body_parts(
    finder: BodyPartEstimator, pictures: Sequence[Picture], flow: NDArray[np.float16]
) -> NDArray[np.float16]:
    """Flow ``[T, 2, S, S]`` with what a finder makes of the clip as a third plane, ``[T, 3, S, S]``."""
    return np.concatenate([flow, as_plane(body_part_rows(finder, pictures, flow), flow.shape[-1])], axis=1)


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
    pictures = [small_picture(frame) for frame in frames_at(path, cfg.working_size, fps, offset, len(flow), camera)]
    return body_part_rows(finder, pictures, flow)


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
