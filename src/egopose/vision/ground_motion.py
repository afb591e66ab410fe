"""How a camera turns and moves over the ground between two frames, fitted to optical flow.

A ray X = (x, y, 1) of the camera meets a level floor at 1/Z = (X . d) / h, d being the unit vector down in the
camera's axes and h the camera's height. A turn w and a velocity V move the picture of a point by
u = x y wx - (1 + x^2) wy + y wz + (-Vx + x Vz) / Z and v = (1 + y^2) wx - x y wy - x wz + (-Vy + y Vz) / Z
(Longuet-Higgins & Prazdny 1980, equation 2.6). So w and V / h are linear in the flow under the horizon. Above it the
depth is unknown: there only the flow across the direction in which V moves a point counts. All six numbers are fitted
at once by reweighted least squares: a turn fitted alone takes up a third of the walking speed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

#: rad below the horizon at which a point counts as floor: nearer to it, 1/Z is mostly error.
_BELOW = float(np.deg2rad(8.0))
#: Heights a second: the prior of velocities ahead, left and up, which decides where no ground is seen.
_USUAL = np.array([1.5, 0.4, 0.4])
_WALK = 0.8  # heights a second ahead: where the fit begins
#: Inverse depth of points off the ground, in camera heights: a wall stands one height to infinitely far away.
_INVERSE_DEPTH = 1.0
#: Neighbouring flow vectors share their errors; so many count as one.
_SHARED = 16.0
#: Smallest deviation of flow, in focal lengths a frame: what DIS rounds to.
_LEAST = 2e-4
#: The rounds begin with a wide scale along the motion, and narrow it by this factor.
_ANNEAL = 0.6
_ROUNDS = 8
#: A point is explained by the camera's motion up to this share of its own, or so many focal lengths.
_EXPLAINED, _PIXEL = 0.2, 2e-3
_BATCH = 32  # frames at a time: what is worked out of them stays in a core's cache; 256 take 1.7 times as long
_THREADS = 2


@dataclass(frozen=True)
class GroundMotion:
    """What :func:`fit_ground_motion` finds in each frame.

    Args:
        turn: ``[T, 3]`` rad a frame in the camera's axes (x right, y down, z ahead).
        velocity: ``[T, 3]`` camera heights a frame, in the same axes.
        deviation: ``[T]`` standard deviation of the velocity, heights a frame.
        turn_deviation: ``[T]`` standard deviation of the turn, rad a frame.
        share: ``[T]`` in 0..1: the weight of the points below the horizon that move as the floor does.
        ground: ``[T]`` in 0..1: the share of the picture that lies below the horizon.
        rigid: ``[T]`` in 0..1: the share of the points that one camera's motion explains, at whatever depth.
    """

    turn: Array
    velocity: Array
    deviation: Array
    turn_deviation: Array
    share: Array
    ground: Array
    rigid: Array


def pixel_rays(height: int, width: int, field_of_view: float) -> tuple[Array, float]:
    """Rays ``[2, height * width]`` (x, y at unit depth) of a pinhole picture, and its focal length in widths.

    ``field_of_view`` is in degrees across the width; pixels are square.
    """
    focal = 0.5 / float(np.tan(np.deg2rad(0.5 * field_of_view)))
    x = ((np.arange(width) + 0.5) / width - 0.5) / focal
    y = ((np.arange(height) + 0.5) / height - 0.5) * height / width / focal
    across, down = np.meshgrid(x, y)
    return np.stack([across.ravel(), down.ravel()]), focal


def gravity_axes(down: Array) -> Array:
    """``[T, 3, 3]``: rows are the axes ahead, left, up in the camera's axes, from unit vectors down ``[T, 3]``.

    Ahead is the optical axis without its vertical part. Where that vanishes, the picture's upper edge is ahead.
    """
    steep = np.abs(down[:, 2:]) > 0.999
    view = np.where(steep, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    ahead = view - (view * down).sum(1, keepdims=True) * down
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.stack([ahead, np.cross(-down, ahead), -down], axis=1)


def fit_ground_motion(moved: Array, rays: Array, down: Array, fps: float, turn: Array | None = None) -> GroundMotion:
    """Turn and velocity of every frame.

    Args:
        moved: ``[T, 2, P]`` flow in focal lengths from the frame before to this one, right and down, of what was at
            ``rays`` in the frame before. NaN counts for nothing.
        rays: ``[2, P]``, see :func:`pixel_rays`.
        down: ``[T, 3]`` unit vectors down in the camera's axes.
        fps: frames/s, for the prior of velocities.
        turn: ``[T, 3]`` rad a frame where a gyroscope knows it; None fits it too.
    """

    def fit(at: int) -> tuple[Array, ...]:
        rows = slice(at, at + _BATCH)
        return _fit(moved[rows], rays, down[rows], fps, None if turn is None else turn[rows])

    with ThreadPoolExecutor(_THREADS) as pool:
        parts = list(pool.map(fit, range(0, len(moved), _BATCH)))
    if not parts:
        none = np.zeros(0)
        return GroundMotion(np.zeros((0, 3)), np.zeros((0, 3)), none, none, none, none, none)
    return GroundMotion(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit(moved: Array, rays: Array, down: Array, fps: float, known: Array | None) -> tuple[Array, ...]:
    shown = np.asarray(np.isfinite(moved).all(1))
    moved = np.where(shown[:, None], moved, 0.0)
    # The equations are of a moment: halfway between both frames they hold to second order. At the first frame a turn
    # of 2.4 rad/s adds 0.18 heights/s to the speed.
    rays = rays + 0.5 * moved
    x, y = rays[:, 0], rays[:, 1]
    depth = x * down[:, :1] + y * down[:, 1:2] + down[:, 2:]
    floor = np.asarray(shown & (depth > np.sin(_BELOW) * np.sqrt(1 + x * x + y * y)))
    depth = np.where(floor, depth, 0.0)
    count, pixels = depth.shape
    axes = gravity_axes(down)
    prior = np.zeros((count, 6, 6))
    prior[:, 3:, 3:] = np.einsum("tij,i,tik->tjk", axes, (fps / _USUAL) ** 2, axes)
    right, below = np.empty((count, 6, pixels)), np.empty((count, 6, pixels))
    right[:, :3] = np.stack([x * y, -(1 + x * x), y], axis=1)
    below[:, :3] = np.stack([1 + y * y, -x * y, -x], axis=1)
    right[:, 3], right[:, 4], right[:, 5] = -depth, 0.0, depth * x
    below[:, 3], below[:, 4], below[:, 5] = 0.0, -depth, depth * y
    wanted, first = moved, 0
    # Beginning with a walk, points off the ground do not pull the turn in the first rounds.
    fitted = np.zeros((count, 6))
    fitted[:, 3:] = _WALK / fps * axes[:, 0]
    if known is not None:
        fitted[:, :3] = known
        wanted = moved - np.stack([np.einsum("ti,tip->tp", known, j[:, :3]) for j in (right, below)], 1)
        right, below, prior, first = right[:, 3:], below[:, 3:], prior[:, 3:, 3:], 3
    normal, weight, square, rigid = _reweighted(wanted, right, below, shown, floor, prior, rays, fitted, first)
    spread = np.linalg.inv(normal) * (square * _SHARED)[:, None, None]
    variances = np.diagonal(spread, axis1=1, axis2=2)
    share = (weight * floor).sum(1) / np.maximum(floor.sum(1), 1)
    turned = np.sqrt(variances[:, :3].max(1)) if known is None else np.zeros(count)
    moves = np.sqrt(variances[:, -3:].max(1))
    return fitted[:, :3], fitted[:, 3:], moves, turned, share, floor.mean(1), rigid


def _reweighted(
    moved: Array,
    right: Array,
    below: Array,
    shown: NDArray[np.bool_],
    floor: NDArray[np.bool_],
    prior: Array,
    rays: Array,
    fitted: Array,
    first: int,
) -> tuple[Array, Array, Array, Array]:
    """Fill ``fitted [T, 6]`` at ``rays [T, 2, P]`` from column ``first`` on.

    Returns the normal matrix, weights ``[T, P]``, variances and the share of the points that are explained ``[T]``.

    Each point's error is split into the direction in which the velocity moves it and the one across. Along the former
    a point of unknown depth may be anywhere (:data:`_INVERSE_DEPTH`). Weights are Cauchy's.
    """
    x, y = rays[:, 0], rays[:, 1]
    tiny = 1e-12 * np.eye(right.shape[1])
    normal, weight = prior, np.ones_like(floor, dtype=np.float64)
    square = np.full(len(moved), (10 * _LEAST) ** 2)
    for number in range(_ROUNDS):
        velocity, own = fitted[:, 3:], fitted[:, first:]
        error_right = moved[:, 0] - np.einsum("ti,tip->tp", own, right)
        error_below = moved[:, 1] - np.einsum("ti,tip->tp", own, below)
        along_right = 1e-9 - velocity[:, :1] + x * velocity[:, 2:]
        along_below = -velocity[:, 1:2] + y * velocity[:, 2:]
        speed = np.maximum(np.hypot(along_right, along_below), 1e-12)
        cos, sin = along_right / speed, along_below / speed
        along, across = error_right * cos + error_below * sin, error_below * cos - error_right * sin
        # Across, no depth disturbs the flow: what is left there is its noise.
        square = (1.48 * _median(np.abs(across), shown) + _LEAST) ** 2
        one = square[:, None]
        off = np.where(floor, np.abs(along), np.abs(across))
        coarse = 1.48 * _ANNEAL**number * _median(off, shown)
        wide = np.maximum(one, coarse[:, None] ** 2)
        spread = np.where(floor, wide, one + (_INVERSE_DEPTH * speed) ** 2)
        weight = shown / (1.0 + along**2 / spread + across**2 / one)
        wide = np.where(floor, one, spread)
        first_rows, second_rows = (
            right * cos[:, None] + below * sin[:, None],
            below * cos[:, None] - right * sin[:, None],
        )
        first_weight, second_weight = weight * one / wide, weight
        first_moved, second_moved = moved[:, 0] * cos + moved[:, 1] * sin, moved[:, 1] * cos - moved[:, 0] * sin
        first_weighted, second_weighted = first_rows * first_weight[:, None], second_rows * second_weight[:, None]
        normal = first_weighted @ first_rows.transpose(0, 2, 1) + second_weighted @ second_rows.transpose(0, 2, 1)
        normal = normal + prior * one[..., None] * _SHARED + tiny
        target = first_weighted @ first_moved[..., None] + second_weighted @ second_moved[..., None]
        fitted[:, first:] = np.linalg.solve(normal, target)[..., 0]
    # Explained: across the motion by less than _PIXEL, or by a fifth of how far the point moved.
    far = np.hypot(moved[:, 0], moved[:, 1])
    explained = shown & (np.abs(across) < np.maximum(_EXPLAINED * far, _PIXEL))
    rigid = explained.sum(1) / np.maximum(shown.sum(1), 1)
    return normal, weight, square, rigid


def _median(values: Array, shown: NDArray[np.bool_]) -> Array:
    """``[T]`` medians of ``values [T, P]`` where ``shown``; 0 where nothing is."""
    ordered = np.sort(np.where(shown, values, np.inf), axis=1)
    count = shown.sum(1)
    middle = ordered[np.arange(len(values)), np.maximum(count - 1, 0) // 2]
    return np.where(count > 0, middle, 0.0)
