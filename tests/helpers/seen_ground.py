"""What a camera sees move that turns and goes over a level floor, by geometry alone."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array

#: A level camera that looks along the world's x: columns are its axes right, down, ahead.
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def flow_of_motion(turn: Array, velocity: Array, down: Array, rays: Array, inverse_depth: Array) -> Array:
    """Flow ``[2, P]`` in focal lengths a frame (Longuet-Higgins & Prazdny 1980, equation 2.6).

    Args:
        turn: ``[3]`` rad a frame in the camera's axes.
        velocity: ``[3]`` camera heights a frame.
        down: ``[3]`` unit vector in the camera's axes.
        rays: ``[2, P]``.
        inverse_depth: ``[P]`` 1 / heights, of what stands above the horizon.
    """
    (x, y), (a, b, c), (vx, vy, vz) = rays, turn, velocity
    floor = x * down[0] + y * down[1] + down[2]
    near = np.where(floor > 0, floor, inverse_depth)
    right = x * y * a - (1 + x * x) * b + y * c + (x * vz - vx) * near
    below = (1 + y * y) * a - x * y * b - x * c + (y * vz - vy) * near
    return np.stack([right, below])


def flow_of_path(positions: Array, rotations: Array, rays: Array, wall: Array) -> Array:
    """Flow ``[T, 2, P]`` in focal lengths of points that are projected into both frames; the first is zero.

    Args:
        positions: ``[T, 3]`` m above a floor at z = 0.
        rotations: ``[T, 3, 3]`` from the camera's axes to the world's.
        rays: ``[2, P]``.
        wall: ``[P]`` m: how deep stands what is seen above the horizon.
    """
    out = np.zeros((len(positions), 2, rays.shape[1]))
    ahead = np.concatenate([rays, np.ones((1, rays.shape[1]))])
    for t in range(1, len(positions)):
        world = rotations[t - 1] @ ahead
        floor = -positions[t - 1, 2] / np.minimum(world[2], -1e-9)
        depth = np.where((world[2] < 0) & (floor < 50.0), floor, wall)
        point = positions[t - 1][:, None] + depth * world
        seen = rotations[t].T @ (point - positions[t][:, None])
        out[t] = seen[:2] / seen[2] - rays
    return out


def walk(
    seconds: float, fps: float, speed: float, pitch: float, bob: float = 0.02, turn: float = 0.0
) -> tuple[Array, Array]:
    """Positions and rotations of a camera 1.6 m high that walks at ``speed`` m/s and looks ``pitch`` rad down.

    It bobs by ``bob`` m twice a second and turns left by ``turn`` rad/s.
    """
    times = np.arange(round(seconds * fps)) / fps
    heading = turn * times
    step = speed / fps * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    across = np.cumsum(step, axis=0) - step[0]
    positions = np.column_stack([across, 1.6 + bob * np.sin(2 * np.pi * 2.0 * times)])
    rotations = Rotation.from_euler("ZY", np.stack([heading, np.full_like(heading, pitch)], axis=1)).as_matrix()
    return positions, rotations @ LEVEL


def any_path(seed: int, count: int, fps: float, pitch: float) -> tuple[Array, Array]:
    """A smooth random way of a head: it walks, turns, nods and leans."""
    rng = np.random.default_rng(seed)

    def smooth(columns: int, seconds: float) -> Array:
        noise = gaussian_filter1d(rng.normal(size=(count + 120, columns)), seconds * fps, axis=0)[60:-60]
        # The deviation of white noise behind such a filter.
        return np.clip(noise * np.sqrt(2 * np.sqrt(np.pi) * seconds * fps), -2.5, 2.5)

    heading = np.cumsum(0.4 * smooth(1, 0.5)[:, 0]) / fps
    angles = np.column_stack([heading, pitch + 0.04 * smooth(1, 0.2)[:, 0], 0.03 * smooth(1, 0.2)[:, 0]])
    own = np.column_stack([1.2 + 0.2 * smooth(1, 0.3)[:, 0], 0.1 * smooth(1, 0.3)[:, 0]])
    cos, sin = np.cos(heading), np.sin(heading)
    step = np.column_stack([cos * own[:, 0] - sin * own[:, 1], sin * own[:, 0] + cos * own[:, 1]]) / fps
    positions = np.column_stack([np.cumsum(step, axis=0), 1.6 + 0.02 * smooth(1, 0.1)[:, 0]])
    return positions, Rotation.from_euler("ZYX", angles).as_matrix() @ LEVEL
