"""Put the ground at z = 0: one vertical offset for a whole clip, so nothing of the motion changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def ground_height(points: Array, *, percentile: float) -> float:
    """Height of the ground under a clip, m: a low percentile over time of each frame's lowest point.

    A percentile rather than the minimum, so that single frames in which markers slipped through the floor do not lift
    the whole clip; of the lowest point, so that flights and kicks of the other foot do not count.

    Args:
        points: ``[T, K, 3]`` world positions of points that touch the ground (soles, toes), m, z up.
        percentile: 0 (the very lowest frame) to 100.

    Raises:
        ValueError: ``points`` is not ``[T, K, 3]`` with a frame and a point at least, or not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 3 or points.shape[-1] != 3 or 0 in points.shape:
        raise ValueError(f"points must be [T, K, 3], none of them 0, got {list(points.shape)}")
    if not np.isfinite(points).all():
        raise ValueError(f"points are not finite at frame {int(np.argwhere(~np.isfinite(points))[0, 0])}")
    return float(np.percentile(points[..., 2].min(axis=1), percentile))


def raised(motion: Motion, height: float) -> Motion:
    """The same motion ``height`` metres higher (lower if negative)."""
    qpos = motion.qpos.copy()
    qpos[:, 2] += height
    return replace(motion, qpos=qpos)


def on_ground(motion: Motion, points: Array, *, percentile: float) -> Motion:
    """The motion moved up or down so that :func:`ground_height` of its ``points [T, K, 3]`` is 0.

    ``meta["ground_offset"]`` adds up the metres it was raised by.
    """
    height = ground_height(points, percentile=percentile)
    offset = float(motion.meta.get("ground_offset", 0.0)) - height
    return replace(raised(motion, -height), meta={**motion.meta, "ground_offset": offset})
