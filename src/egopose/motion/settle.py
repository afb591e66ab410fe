"""Settle a clip on the floor: standing soles touch it, none is under it, and nothing else of the motion changes.

Mocap floats and sinks by centimetres as markers slip and bones are rescaled. A simulated body started from such a frame
drops or is thrown up at once, which costs it the root's reward before it has done anything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from egopose.motion.contacts import contact_labels
from egopose.motion.ground import ground_height
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class SettleSettings:
    """See ``conf/data``.

    Args:
        percentile: of the lowest sole point over the clip that is put at z = 0 first.
        contact_height: a sole point at or below this touches the floor, m.
        contact_speed: ... if it is no faster than this, m/s.
        stride: a sole comes down at least once in so long, s; slower changes of the floor's height are taken out.
        smoothing: standard deviation in time of the correction, s.
        depth: how far soles rest in the floor, m: what the simulation's soft contact gives under a standing body.
        largest: the correction's bound, m; more means that the clip stands on something that is not the floor.
    """

    percentile: float = 5.0
    contact_height: float = 0.03
    contact_speed: float = 0.5
    stride: float = 1.2
    smoothing: float = 0.08
    depth: float = 0.004
    largest: float = 0.08


def settle(motion: Motion, sole_points: Array, settings: SettleSettings | None = None) -> tuple[Motion, Array]:
    """The motion with its root moved up and down so that soles rest on the floor.

    Args:
        motion: any.
        sole_points: ``[T, K, 3]`` world positions of heels and balls of the feet, m.
        settings: see :class:`SettleSettings`.

    Returns:
        The motion, with ``contacts [T, K]`` of its sole points; and the vertical shift of every frame ``[T]``, m.
    """
    settings = settings or SettleSettings()
    base = ground_height(sole_points, percentile=settings.percentile)
    # Capture floors tilt and rigs drift: the floor under a stride is the lowest a sole comes around it.
    window = max(1, round(settings.stride * motion.fps))
    lowest_sole = sole_points[..., 2].min(axis=1) - base
    drift = gaussian_filter1d(minimum_filter1d(lowest_sole, window, mode="nearest"), window / 3, mode="nearest")
    floor = base + np.clip(drift, -settings.largest, settings.largest)
    points = sole_points - np.stack([np.zeros_like(floor), np.zeros_like(floor), floor], axis=1)[:, None]
    touching = contact_labels(points, motion.fps, height=settings.contact_height, speed=settings.contact_speed)
    # While a foot stands, its lowest touching point belongs at z = 0; in between the correction is interpolated.
    standing = touching.any(axis=1)
    lowest = np.where(touching, points[..., 2], np.inf).min(axis=1)
    shift = np.zeros(len(motion))
    if standing.any():
        at = np.flatnonzero(standing)
        shift = np.interp(np.arange(len(motion)), at, -np.clip(lowest[at], -settings.largest, settings.largest))
    sigma = settings.smoothing * motion.fps
    shift = gaussian_filter1d(shift, sigma, mode="nearest")
    # What still sinks is lifted by a smooth envelope that lies above every single lift.
    sunk = np.clip(-(points[..., 2].min(axis=1) + shift), 0.0, settings.largest)
    reach = max(1, round(2 * sigma))
    shift = shift + gaussian_filter1d(maximum_filter1d(sunk, 2 * reach + 1, mode="nearest"), sigma / 2, mode="nearest")
    shift = shift - floor - settings.depth
    qpos = motion.qpos.copy()
    qpos[:, 2] += shift
    names = motion.contact_names or tuple(f"sole_{k}" for k in range(points.shape[1]))
    return replace(motion, qpos=qpos, contacts=touching, contact_names=names), shift
