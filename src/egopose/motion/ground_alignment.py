"""Settle a clip on the floor: standing soles touch it, no part is under it, and nothing else of the motion changes.

Mocap floats and sinks by centimetres as markers slip and bones are rescaled. A simulated body started from such a frame
drops or is thrown up at once, which costs it the root's reward before it has done anything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from egopose.motion.contacts import contact_labels
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

GRAVITY = 9.81


@dataclass(frozen=True)
class GroundAlignmentSettings:
    """See ``conf/data``.

    Args:
        percentile: of the lowest sole point over the clip that is put at z = 0 first.
        contact_height: a sole point at or below this touches the floor, m.
        contact_speed: ... if it is no faster than this, m/s.
        stride: a sole comes down at least once in so long, s; slower changes of the floor's height are taken out.
        tolerance: scale of a standing sole's distance from the floor, m.
        shift_acceleration: scale of the shift's own acceleration, m/s^2.
        flight_acceleration: scale of what the centre of mass's acceleration in flight differs from gravity by, m/s^2.
        depth: how far soles rest in the floor, m: what the simulation's soft contact gives under a standing body.
        largest: the correction's bound, m; more means that the clip stands on something that is not the floor.
    """

    percentile: float = 5.0
    contact_height: float = 0.03
    contact_speed: float = 0.5
    stride: float = 1.2
    tolerance: float = 0.003
    shift_acceleration: float = 4.0
    flight_acceleration: float = 1.5
    depth: float = 0.004
    largest: float = 0.08


def align_to_ground(
    motion: Motion,
    sole_points: Array,
    settings: GroundAlignmentSettings | None = None,
    *,
    sole_edges: Array | None = None,
    center_of_mass: Array | None = None,
    lowest: Array | None = None,
) -> tuple[Motion, Array]:
    """The motion with its root moved up and down so that soles rest on the floor.

    Args:
        motion: any.
        sole_points: ``[T, K, 3]`` world positions of heels and balls of the feet, m.
        settings: see :class:`GroundAlignmentSettings`.
        sole_edges: ``[T, E, 3]`` the soles' corners, m; default the sole points. A foot on its edge stands on these.
        center_of_mass: ``[T, 3]`` m. With it, a body near the floor that does not fall stands on the floor even where
            no sole point is slow enough to touch, and a body in the air falls as gravity has it.
        lowest: ``[T]`` m height of the body's lowest point but the soles'. With it, a body that lies or stands on its
            hands is put on the floor with what it rests on.

    Returns:
        The motion, with ``contacts [T, K]`` of its sole points; and the vertical shift of every frame ``[T]``, m.
    """
    settings = settings or GroundAlignmentSettings()
    lowest_sole = sole_points[..., 2].min(axis=1)
    lowest = lowest_sole if lowest is None else np.minimum(lowest_sole, lowest)
    base = float(np.percentile(lowest, settings.percentile))
    # Capture floors tilt and rigs drift: the floor under a stride is the lowest a sole comes around it.
    window = max(1, round(settings.stride * motion.fps))
    drift = gaussian_filter1d(minimum_filter1d(lowest - base, window, mode="nearest"), window / 3, mode="nearest")
    floor = base + np.clip(drift, -settings.largest, settings.largest)
    points = sole_points - np.stack([np.zeros_like(floor), np.zeros_like(floor), floor], axis=1)[:, None]
    touching = contact_labels(points, motion.fps, height=settings.contact_height, speed=settings.contact_speed)
    edges = (points if sole_edges is None else sole_edges - (sole_points - points)[:, :1])[..., 2].min(axis=1)
    edges = np.where(lowest < lowest_sole, np.minimum(edges, lowest - floor), edges)
    com_height = None if center_of_mass is None else center_of_mass[:, 2] - floor
    shift = _contact_shift(edges, np.asarray(touching.any(axis=1)), com_height, motion.fps, settings)
    shift = shift - floor - settings.depth
    qpos = motion.qpos.copy()
    qpos[:, 2] += shift
    names = motion.contact_names or tuple(f"sole_{k}" for k in range(points.shape[1]))
    return replace(motion, qpos=qpos, contacts=touching, contact_names=names), shift


def _contact_shift(
    edges: Array, touching: NDArray[np.bool_], com_height: Array | None, fps: float, settings: GroundAlignmentSettings
) -> Array:
    """``[T]`` m: the upward shift s that puts soles on the floor, by least squares over the whole clip.

    The residuals, each over its own scale: a standing sole's height above the floor; any sole's depth under it; s's
    acceleration; in flight, the centre of mass's acceleration less gravity's.
    """
    frames = len(edges)
    if frames < 3:
        return -edges if touching.any() else np.maximum(-edges, 0.0)
    one = np.full(frames - 2, fps**2)
    second = sparse.diags_array([one, -2 * one, one], offsets=[0, 1, 2], shape=(frames - 2, frames)).tocsr()
    standing, flying = touching, np.zeros(frames, dtype=bool)
    free = np.zeros(frames - 2)
    if com_height is not None:
        free = second @ com_height + GRAVITY
        falling = np.concatenate([free[:1], free, free[-1:]]) < 0.5 * GRAVITY
        standing = touching | (~falling & (edges < settings.largest))
        flying = falling & ~standing
    rows = [second / settings.shift_acceleration]
    values = [np.zeros(frames - 2)]
    inner = flying[1:-1]
    rows.append(second[inner] / settings.flight_acceleration)
    values.append(-free[inner] / settings.flight_acceleration)
    stand = sparse.eye_array(frames, format="csr")[standing] / settings.tolerance
    rows.append(stand)
    values.append(-edges[standing] / settings.tolerance)
    base, target = sparse.vstack(rows), np.concatenate(values)
    normal, right = base.T @ base, base.T @ target
    normal = normal + sparse.eye_array(frames) * 1e-6
    # What is under the floor pushes up, what is not does not: the set of such frames settles in a few rounds.
    shift = np.zeros(frames)
    under = edges < 0
    for _ in range(20):
        weight = under / settings.tolerance**2
        shift = sparse.linalg.spsolve((normal + sparse.diags_array(weight)).tocsc(), right - weight * edges)
        now = edges + shift < 0
        if (now == under).all():
            break
        under = now
    return np.clip(shift, -settings.largest, settings.largest)
