"""Contact labels of points on a moving body, from their height and speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array


def contact_labels(
    points: Array, fps: float, *, height: float | Array, speed: float, min_frames: int = 2
) -> NDArray[np.bool_]:
    """Which points touch the ground: low and slow, both.

    Args:
        points: ``[T, K, 3]`` world positions, m, z up, the ground at z = 0 (see :mod:`egopose.motion.ground`).
        fps: frames per second.
        height: a point is low at or below this, m; one value or one for each point ``[K]``.
        speed: a point is slow at or below this, m/s.
        min_frames: shorter contacts, and then shorter gaps between contacts, are taken for noise.

    Returns:
        ``[T, K]`` booleans.

    Raises:
        ValueError: ``points`` is not ``[T, K, 3]`` or not finite, ``fps`` or ``min_frames`` is not positive.
    """
    low = _checked(points)[..., 2] <= np.asarray(height)
    labels = low & (point_speeds(points, fps) <= speed)
    if min_frames < 1:
        raise ValueError(f"min_frames must be at least 1, got {min_frames}")
    return ~without_short_runs(~without_short_runs(labels, min_frames), min_frames)


def point_speeds(points: Array, fps: float) -> Array:
    """Speed ``[T, K]`` (m/s) of points ``[T, K, 3]`` by central differences; one-sided at the ends, 0 for one frame.

    Raises:
        ValueError: as :func:`contact_labels`.
    """
    points = _checked(points)
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be positive, got {fps}")
    if len(points) < 2:
        return np.zeros(points.shape[:2])
    return np.linalg.norm(np.gradient(points, axis=0) * fps, axis=-1)


def _checked(points: Array) -> Array:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(f"points must be [T, K, 3], got {list(points.shape)}")
    if not np.isfinite(points).all():
        raise ValueError(f"points are not finite at frame {int(np.argwhere(~np.isfinite(points))[0, 0])}")
    return points


def without_short_runs(labels: NDArray[np.bool_], min_frames: int) -> NDArray[np.bool_]:
    """Runs of True shorter than ``min_frames`` become False, save those the clip's ends may have cut."""
    out = labels.copy()
    for k in range(labels.shape[1]):
        for start, stop in runs_of(labels[:, k]):
            if stop - start < min_frames and start > 0 and stop < len(labels):
                out[start:stop, k] = False
    return out


def runs_of(mask: np.ndarray) -> tuple[tuple[int, int], ...]:
    """``[start, stop)`` of every run of True in a boolean array ``[T]``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]])))
    return tuple((int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True))
