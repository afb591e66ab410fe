"""The body-part estimator: a small network that finds the wearer's own limbs in the picture, and their posture.

Yuan & Kitani 2019 use optical flow alone. Arms that hardly move the head leave no trace in it. This network looks at
the picture itself: two small frames and the flow between them. It is trained on rendered bodies in random postures
and rooms (``python -m egopose.train --config-name body_parts``), on no frame of any take that anything is judged on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from egopose.vision.film import PICTURE

#: Side of the flow (conf/vision/light.yaml's stored size).
FLOW = 32
#: Classes of the masks.
LIMBS = ("right arm", "left arm", "right leg", "left leg", "trunk")
#: Least and largest logarithm of a variance that an estimator gives.
LOG_VARIANCE = (-4.0, 3.0)
_FLOW_SCALE = 20.0  # as conf/vision/light.yaml: flow in widths a frame, times this, is of order one
_SUMMARY = 256
_BATCH = 64  # frames a forward pass: their features stay in a core's cache; 256 take 1.7 times as long
Picture = NDArray[np.uint8]


"""``[64, 64, 3]`` RGB, see :func:`egopose.vision.film.small_picture`."""


class _Residual(nn.Module):
    """Two convolutions past which the input goes on, the first one dilated."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.a = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
        self.b = nn.Conv2d(channels, channels, 3, padding=1)
        self.n, self.m = nn.GroupNorm(8, channels), nn.GroupNorm(8, channels)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.b(torch.relu(self.m(self.a(torch.relu(self.n(x))))))


class BodyPartEstimator(nn.Module):
    """Pictures and flow -> masks of the limbs, and their posture with its uncertainty.

    Args:
        numbers: Q, of a posture.
        channels: of the convolutions.
    """

    mean: Tensor
    std: Tensor
    place: Tensor
    mirror_index: Tensor
    mirror_sign: Tensor

    def __init__(self, numbers: int, channels: int = 64) -> None:
        super().__init__()
        self.numbers = numbers
        self.first = nn.Conv2d(8, 32, 5, stride=2, padding=2)
        self.second = nn.Conv2d(34, channels, 3, stride=2, padding=1)
        blocks = [_Residual(channels, dilation) for dilation in (1, 2, 4, 1)]
        self.trunk = nn.Sequential(*blocks, nn.GroupNorm(8, channels), nn.ReLU())
        self.mask = nn.Conv2d(channels, 4 * len(LIMBS), 1)
        self.summary = nn.Sequential(
            nn.Conv2d(channels, channels, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, 32, 1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * (PICTURE // 8) ** 2, _SUMMARY),
            nn.ReLU(),
        )
        self.posture = nn.Linear(_SUMMARY, 2 * numbers)
        axis = torch.linspace(-1, 1, PICTURE)
        self.register_buffer("place", torch.stack(torch.meshgrid(axis, axis, indexing="ij")), persistent=False)
        self.register_buffer("mean", torch.zeros(numbers))
        self.register_buffer("std", torch.ones(numbers))
        # Of the numbers, not of the weights: saved beside them.
        self.register_buffer("mirror_index", torch.arange(numbers), persistent=False)
        self.register_buffer("mirror_sign", torch.ones(numbers), persistent=False)

    def forward(self, before: Tensor, now: Tensor, flow: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What two frames show.

        Args:
            before, now: ``[B, 3, 64, 64]`` RGB in 0..255, any type.
            flow: ``[B, 2, 32, 32]`` from one to the other, image widths a frame.

        Returns:
            Logits of the share of each of 32 x 32 cells that a limb covers ``[B, 5, 32, 32]``; posture ``[B, Q]`` in
            training deviations from the training mean; logarithm of its variance ``[B, Q]``.
        """
        pictures = torch.cat([before, now], 1).to(torch.float32) / 127.5 - 1.0
        seen = torch.cat([pictures, self.place.expand(len(pictures), -1, -1, -1)], 1)
        seen = torch.cat([torch.relu(self.first(seen)), flow.to(torch.float32) * _FLOW_SCALE], 1)
        features = self.trunk(self.second(seen))
        posture, log_variance = self.posture(self.summary(features)).chunk(2, 1)
        return functional.pixel_shuffle(self.mask(features), 2), posture, log_variance.clamp(*LOG_VARIANCE)

    def mirrored_rows(self, rows: Tensor) -> Tensor:
        """Rows ``[..., 2 Q]`` (:func:`body_part_rows`) of a scene as rows of its mirror image, float32."""
        posture, log_variance = rows.to(torch.float32).chunk(2, -1)
        posture = self.mirror_sign * (posture * self.std + self.mean)[..., self.mirror_index]
        # A variance is in squares of its number's own deviation.
        scale = 2.0 * torch.log(self.std[self.mirror_index] / self.std)
        return torch.cat([(posture - self.mean) / self.std, log_variance[..., self.mirror_index] + scale], -1)


@torch.no_grad()
def body_part_rows(
    finder: BodyPartEstimator, pictures: Sequence[Picture] | NDArray[np.uint8], flow: NDArray
) -> NDArray:
    """What a finder makes of a clip: posture and logarithms of its variances, ``[T, 2 Q]`` float16.

    Args:
        finder: in evaluation mode.
        pictures: T of :func:`egopose.vision.film.small_picture`; nothing precedes the first.
        flow: ``[T, 2, S, S]`` of the same frames, each from the one before.
    """
    rows = []
    for first in range(0, len(flow), _BATCH):
        part = np.arange(first, min(first + _BATCH, len(flow)))
        before, now = (
            torch.from_numpy(np.stack([pictures[i] for i in frames.tolist()])).permute(0, 3, 1, 2)
            for frames in (np.maximum(part - 1, 0), part)
        )
        rows.append(pair_rows(finder, before, now, torch.from_numpy(np.asarray(flow[part]))))
    return np.concatenate(rows)


@torch.no_grad()
def pair_rows(finder: BodyPartEstimator, before: Tensor, now: Tensor, flow: Tensor) -> NDArray:
    """As :func:`body_part_rows` of pairs of pictures ``[B, 3, 64, 64]`` and the flow between them ``[B, 2, S, S]``."""
    if flow.shape[-1] != FLOW:
        flow = functional.interpolate(flow.float(), (FLOW, FLOW), mode="bilinear", antialias=True)
    _, posture, log_variance = finder(before, now, flow)
    return torch.cat([posture, log_variance], 1).to(torch.float16).numpy()


def as_plane(rows: NDArray, side: int) -> NDArray:
    """Rows ``[T, N]`` as a third plane ``[T, 1, S, S]`` beside flow ``[T, 2, S, S]``: in reading order, then zeros.

    So one array says of a frame all that a regressor looks at, whoever passes it on.

    Raises:
        ValueError: more numbers than the plane has places.
    """
    if rows.shape[1] > side**2:
        raise ValueError(f"{rows.shape[1]} numbers do not fit into a plane of side {side}")
    plane = np.zeros((len(rows), side**2), rows.dtype)
    plane[:, : rows.shape[1]] = rows
    return plane.reshape(len(rows), 1, side, side)
