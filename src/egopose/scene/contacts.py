"""Which foot touches something, from 2D keypoints of the legs: a network that sees a second of film around each frame.

After Yu, Park & Lee 2021, section 4, whose own network (:mod:`egopose.scene.window_contacts`) sees nine frames. This
one is a temporal convolution (Bai, Kolter & Koltun 2018). It reads how the joints lie and move, the camera undone.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from torch import Tensor, nn

from egopose.motion.rotations import Array

#: Keypoints 8 to 14 of OpenPose's BODY_25, in its order.
LOWER_BODY = ("mid_hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")
FEET = ("right", "left")
#: Columns of :data:`LOWER_BODY` in the mirror image.
MIRROR = (0, 4, 5, 6, 1, 2, 3)
_JOINTS = len(LOWER_BODY)
#: Of every frame: places and movements of the joints, their confidences, and 1 where there is a frame.
FEATURES = 2 * 2 * _JOINTS + _JOINTS + 1
_MOVEMENTS = slice(2 * _JOINTS, 4 * _JOINTS)
_CONFIDENCES = slice(4 * _JOINTS, 5 * _JOINTS)
#: Of the residual blocks.
_DILATIONS = (1, 2, 4)
#: Movements are in tenths of a leg's length a frame, and cut here: a foot's fastest is about 1.5.
_TENTHS, _MOST = 10.0, 2.0
#: Frames over which the leg's length in the picture is averaged.
_LENGTH_FRAMES = 15


class ContactEstimator(Protocol):
    """What tells the contacts of both feet."""

    def probabilities(self, keypoints: Array, confidence: Array, camera: Array | None = None) -> Array:
        """See :meth:`ContactNetwork.probabilities`."""


class ContactNetwork(nn.Module):
    """A temporal convolution over :func:`contact_features`; of each frame it sees the 16 before and the 16 after.

    Args:
        widths: one number, the channels of every layer.
        dropout: in each block.
        input_noise: standard deviation added to places and movements in training.
    """

    def __init__(self, widths: tuple[int, ...] = (64,), dropout: float = 0.2, input_noise: float = 0.01) -> None:
        super().__init__()
        self.input_noise = input_noise
        (channels,) = widths
        first = [nn.Conv1d(FEATURES, channels, 5, padding=2), nn.BatchNorm1d(channels), nn.ReLU()]
        blocks = [_Block(channels, dilation, dropout) for dilation in _DILATIONS]
        self.layers = nn.Sequential(*first, *blocks, nn.Conv1d(channels, len(FEET), 1))

    def forward(self, features: Tensor) -> Tensor:
        """Logits ``[N, T, 2]`` of ``[N, T, 36]``."""
        if self.training:
            noise = self.input_noise * torch.randn_like(features)
            noise[..., 4 * _JOINTS :] = 0.0
            features = features + noise * features[..., -1:]
        out: Tensor = self.layers(features.transpose(1, 2)).transpose(1, 2)
        return out

    def probabilities(self, keypoints: Array, confidence: Array, camera: Array | None = None) -> Array:
        """Probability ``[T, 2]`` that the right and the left foot touch something.

        The network must be in evaluation mode, and the film have the 30 frames/s that it learned from.

        Args:
            keypoints, confidence, camera: see :func:`contact_features`.

        Raises:
            ValueError: see :func:`contact_features`.
        """
        features = torch.from_numpy(contact_features(keypoints, confidence, camera))
        with torch.no_grad():
            out: Array = self(features[None])[0].sigmoid().double().numpy()
        return out


class _Block(nn.Module):
    """What is added to its input: five frames, some apart, then one."""

    def __init__(self, channels: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv1d(channels, channels, 5, padding=2 * dilation, dilation=dilation),
            nn.BatchNorm1d(channels),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Conv1d(channels, channels, 1),
            nn.BatchNorm1d(channels),
            nn.ReLU(),
        )

    def forward(self, rows: Tensor) -> Tensor:
        """``[N, C, T]`` to ``[N, C, T]``."""
        out: Tensor = rows + self.layers(rows)
        return out


def contact_features(keypoints: Array, confidence: Array, camera: Array | None = None) -> np.ndarray:
    """The network's inputs, in lengths of a leg in the picture, with the axes of each frame's own picture.

    Places are relative to the frame's pelvis. Movements lead to the next frame, its camera turned back to this one's;
    the last frame has none. A keypoint of confidence 0 is interpolated in time.

    Args:
        keypoints: ``[T, 7, 2]`` in the order of :data:`LOWER_BODY`, x right, y down, any unit.
        confidence: ``[T, 7]``, 0 for a joint that is not seen.
        camera: ``[T, 3, 3]``: takes each picture's homogeneous points into one common picture. None: not undone.

    Returns:
        ``[T, 36]`` float32: seven places, seven movements, seven confidences, 1.

    Raises:
        ValueError: the shapes do not agree, or a seen keypoint is not finite.
    """
    keypoints, seen = checked_keypoints(keypoints, confidence, camera)
    frames = len(keypoints)
    to_common = np.tile(np.eye(3), (frames, 1, 1)) if camera is None else np.asarray(camera, dtype=np.float64)
    from_common = np.linalg.inv(to_common).astype(np.float64)
    common = _interpolated(_mapped(to_common, keypoints), seen)
    own = _mapped(from_common, common)
    movements = np.zeros_like(own)
    movements[:-1] = _mapped(from_common[:-1], common[1:]) - own[:-1]
    length = _leg_length(own)[:, None, None]
    places = (own - own[:, :1]) / length
    movements = np.clip(_TENTHS * movements / length, -_MOST, _MOST)
    rows = [places.reshape(frames, -1), movements.reshape(frames, -1), confidence, np.ones((frames, 1))]
    return np.concatenate(rows, axis=1).astype(np.float32)


def checked_keypoints(keypoints: Array, confidence: Array, camera: Array | None) -> tuple[Array, NDArray[np.bool_]]:
    """Keypoints ``[T, 7, 2]``, 0 where unseen, and which are seen ``[T, 7]``. Raises as :func:`contact_features`."""
    keypoints, confidence = np.asarray(keypoints, dtype=np.float64), np.asarray(confidence, dtype=np.float64)
    frames = len(keypoints)
    if keypoints.shape != (frames, _JOINTS, 2) or confidence.shape != (frames, _JOINTS) or not frames:
        raise ValueError(f"keypoints must be [T, 7, 2], confidence [T, 7]: {keypoints.shape}, {confidence.shape}")
    if camera is not None and np.shape(camera) != (frames, 3, 3):
        raise ValueError(f"camera must be [{frames}, 3, 3], got {list(np.shape(camera))}")
    seen = confidence > 0
    if not np.isfinite(keypoints[seen]).all():
        raise ValueError("a keypoint with confidence is not finite")
    return np.where(seen[..., None], keypoints, 0.0), seen


def without_last_movement(features: Tensor) -> Tensor:
    """Features ``[T, 36]`` of a piece that ends a film: nothing is known of the frame after it."""
    out = features.clone()
    out[-1, _MOVEMENTS] = 0.0
    return out


def mirrored_features(features: Tensor) -> Tensor:
    """Features ``[..., 36]`` of the mirror image, in which left and right change places."""
    columns = list(MIRROR)
    points = features[..., : 4 * _JOINTS].unflatten(-1, (2, _JOINTS, 2))[..., columns, :]
    points = (points * points.new_tensor([-1.0, 1.0])).flatten(-3)
    return torch.cat([points, features[..., _CONFIDENCES][..., columns], features[..., -1:]], dim=-1)


def _mapped(maps: Array, points: Array) -> Array:
    homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    out = homogeneous @ maps.transpose(0, 2, 1)
    return np.asarray(out[..., :2] / out[..., 2:])


def _interpolated(points: Array, seen: NDArray[np.bool_]) -> Array:
    """Unseen points between their joint's sights; a joint that is never seen stands in the middle of the others."""
    out, times = points.copy(), np.arange(len(points))
    for joint in np.flatnonzero(seen.any(axis=0) & ~seen.all(axis=0)):
        known = seen[:, joint]
        for axis in range(2):
            out[~known, joint, axis] = np.interp(times[~known], times[known], points[known, joint, axis])
    never = ~seen.any(axis=0)
    if never.any() and not never.all():
        out[:, never] = out[:, ~never].mean(axis=1, keepdims=True)
    return out


def _leg_length(points: Array) -> Array:
    """``[T]`` the longer leg, by its two bones in the picture, averaged in time; 1 where there is none."""
    bones = np.linalg.norm(np.diff(points[:, 1:].reshape(-1, 2, 3, 2), axis=2), axis=-1).sum(axis=2)
    length: Array = uniform_filter1d(bones.max(axis=1), _LENGTH_FRAMES, mode="nearest")
    return np.where(length > 0, length, 1.0)
