"""Where things of the world lie in each picture, near the body: a scaled orthographic camera for every frame.

It is fitted to the body's own keypoints, so it needs no lens. Far from the body it is off by perspective.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.motion.rotations import Array

_SMOOTH = 0.2  # s: a body's distance changes no faster


@dataclass(frozen=True)
class Projection:
    """A point X of the world lies at matrix X + origin: ``matrix [T, 2, 3]`` px per m, ``origin [T, 2]`` px."""

    matrix: Array
    origin: Array

    def pixels(self, points: Array) -> Array:
        """``[T, K, 2]`` px of points ``[T, K, 3]`` (m) in each frame's picture."""
        return np.einsum("tij,tkj->tki", self.matrix, points) + self.origin[:, None]

    def at(self, t: int) -> Projection:
        """Of one frame."""
        return Projection(self.matrix[t : t + 1], self.origin[t : t + 1])


def camera_poses(projection: Projection, points: Array, focal: float) -> tuple[Array, Array]:
    """Where a camera stood and how it was turned, if it looked straight at the body.

    Args:
        projection: of ``T`` frames.
        points: ``[T, 3]`` m, what it looks at: a root.
        focal: px, its focal length.

    Returns:
        Places ``[T, 3]`` m, as far away as the body's size in the picture says, and ``[T, 3, 3]``: the picture's right,
        down and ahead as rows, world axes.
    """
    length = np.linalg.norm(projection.matrix, axis=2)
    right, down = (projection.matrix[:, k] / length[:, k, None] for k in (0, 1))
    ahead = np.cross(right, down)
    distance = focal / np.sqrt(length[:, 0] * length[:, 1])
    return points - distance[:, None] * ahead, np.stack([right, down, ahead], axis=1)


def fit_projection(points: Array, pixels: Array, weight: Array, to_world: Array, fps: float) -> Projection:
    """The projection that puts points of the body onto their pixels.

    Args:
        points: ``[T, K, 3]`` m, world.
        pixels: ``[T, K, 2]`` px of each frame's picture; NaN where unknown.
        weight: ``[T, K]``; 0 leaves a keypoint out.
        to_world: ``[T, 3, 3]`` from each frame's camera axes to the world's.
        fps: frames per second.
    """
    weight = np.where(np.isfinite(pixels).all(axis=-1), weight, 0.0)
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    seen = np.where(weight[..., None] > 0, pixels, 0.0)
    axes = to_world.transpose(0, 2, 1)[:, :2]
    flat = np.einsum("tij,tkj->tki", axes, points)
    from_middle, to_middle = ((x * weight[..., None]).sum(axis=1) / total for x in (flat, seen))
    a, b = flat - from_middle[:, None], seen - to_middle[:, None]
    over = (a * b * weight[..., None]).sum(axis=(1, 2))
    under = np.maximum((a * a * weight[..., None]).sum(axis=(1, 2)), 1e-9)
    scale = over / under
    good = (weight > 0).sum(axis=1) >= 4
    good &= scale > 0
    frames = np.arange(len(scale))
    if good.any():
        scale = np.exp(np.interp(frames, frames[good], np.log(scale[good])))
        scale = np.exp(gaussian_filter1d(np.log(scale), _SMOOTH * fps, mode="nearest"))
    matrix = scale[:, None, None] * axes
    origin = to_middle - np.einsum("tij,tj->ti", matrix, (points * weight[..., None]).sum(axis=1) / total)
    if good.any():
        origin = np.stack([np.interp(frames, frames[good], axis[good]) for axis in origin.T], axis=1)
    return Projection(matrix, origin)
