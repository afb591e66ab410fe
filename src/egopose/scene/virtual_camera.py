"""Cameras of a third person, drawn at random, and what they would see of a body and of what is behind it.

Yu, Park & Lee 2021, section 4: a fixed camera, one that turns with the person at a fixed place, and one that moves
along. A zooming one is added. World: z up, m. Camera axes: x right, y down, z ahead. Picture: 1 is its height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

KINDS = ("fixed", "pan", "zoom", "track")
_FIELD_OF_VIEW = np.deg2rad(50.0)  # of the picture's height: between a telephone's and a film camera's
_WIDE = 16 / 9


@dataclass(frozen=True)
class CameraPath:
    """A camera in time.

    Args:
        positions: ``[T, 3]`` m.
        axes: ``[T, 3, 3]``; the rows are the camera's x, y and z in the world.
        focal: ``[T]`` focal length in picture heights.
    """

    positions: Array
    axes: Array
    focal: Array


def slow_noise(rng: np.random.Generator, shape: tuple[int, ...], seconds: float, fps: float) -> Array:
    """Noise of standard deviation 1 whose memory along the first axis fades with ``seconds``."""
    keep = float(np.exp(-1.0 / (seconds * fps)))
    white = rng.normal(size=shape) * np.sqrt(1 - keep**2)
    white[:1] /= np.sqrt(1 - keep**2)
    out: Array = lfilter([1.0], [1.0, -keep], white, axis=0)
    return out


def draw_camera(kind: str, target: Array, fps: float, rng: np.random.Generator) -> CameraPath:
    """A camera that looks at a body.

    Args:
        kind: one of :data:`KINDS`.
        target: ``[T, 3]`` m, the pelvis.
        fps: frames per second.
        rng: draws place, height, distance, lens and the hand that holds it.

    Raises:
        ValueError: ``kind`` is none of them.
    """
    if kind not in KINDS:
        raise ValueError(f"a camera is one of {', '.join(KINDS)}, not {kind!r}")
    frames = len(target)
    middle = target.mean(axis=0)
    spread = float(np.linalg.norm(target[:, :2] - middle[:2], axis=1).max())
    azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(3.0, 8.0)
    if kind != "track":
        distance += spread  # the body never walks through the camera
    offset = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-0.4, 1.0)])
    focal = np.full(frames, 0.5 / np.tan(_FIELD_OF_VIEW / 2))
    # A person with a camera follows half a second late, and never evenly.
    followed = gaussian_filter1d(target, 0.25 * fps, axis=0, mode="nearest")
    if kind == "fixed":
        positions, aim = np.tile(middle + offset, (frames, 1)), np.tile(middle, (frames, 1))
    elif kind == "track":
        walked = gaussian_filter1d(target, 0.5 * fps, axis=0, mode="nearest")
        walked[:, 2] = middle[2]
        positions = walked + offset + 0.015 * slow_noise(rng, (frames, 3), 0.3, fps)
        aim = followed
    else:
        positions, aim = np.tile(middle + offset, (frames, 1)), followed
    if kind == "zoom":
        phase, period = rng.uniform(0, 2 * np.pi), rng.uniform(1.5, 5.0)
        swing = rng.uniform(0.1, 0.4) * np.sin(phase + 2 * np.pi * np.arange(frames) / fps / period)
        focal = focal * np.exp(swing)
    roll = np.deg2rad(rng.normal(scale=2.0))
    shake = np.zeros((frames, 3)) if kind == "fixed" else np.deg2rad(0.3) * slow_noise(rng, (frames, 3), 0.3, fps)
    shake[:, 2] += roll
    return CameraPath(positions, _looking(aim - positions, shake), focal)


def _looking(ahead: Array, turn: Array) -> Array:
    """``[T, 3, 3]`` axes that look along ``ahead [T, 3]``, then turned by rotation vectors in camera axes."""
    z = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    return np.asarray(rot.to_matrix(rot.from_rotvec(turn)) @ axes)


def project(camera: CameraPath, points: Array) -> tuple[Array, Array]:
    """Pictures ``[T, K, 2]`` (heights, from the picture's middle) and depths ``[T, K]`` (m) of points ``[T, K, 3]``."""
    seen = np.einsum("tij,tkj->tki", camera.axes, points - camera.positions[:, None])
    depth = seen[..., 2]
    safe = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
    return camera.focal[:, None, None] * seen[..., :2] / safe[..., None], depth


def background_motion(
    camera: CameraPath, centre: Array, rng: np.random.Generator, count: int = 400, noise: float = 0.001
) -> Array:
    """What tracking the background tells of a camera's motion: a similarity for each pair of frames, chained.

    Points on the floor and on walls 6 to 15 m away are seen in both frames; a similarity is fitted to them. A camera
    that moves along sees near and far points shift differently, so the fit is then no more than a mean.

    Args:
        camera: see :class:`CameraPath`.
        centre: ``[3]`` of the place, m.
        rng: draws the points and their errors.
        count: of the points.
        noise: of a point's place in the second picture, in picture heights: 1 pixel of 1,000.

    Returns:
        ``[T, 3, 3]``: takes a picture's homogeneous points into the first picture's.
    """
    around, away = rng.uniform(0, 2 * np.pi, count), rng.uniform(6.0, 15.0, count)
    height = np.where(rng.random(count) < 0.4, 0.0, rng.uniform(0.0, 5.0, count))
    away = np.where(height == 0.0, rng.uniform(0.5, 15.0, count), away)
    place = np.stack([centre[0] + away * np.cos(around), centre[1] + away * np.sin(around), height], axis=1)
    pictures, depth = project(camera, np.broadcast_to(place, (len(camera.positions), count, 3)))
    inside = (depth > 0.5) & (np.abs(pictures[..., 0]) < _WIDE / 2) & (np.abs(pictures[..., 1]) < 0.5)
    now = np.where(inside, pictures[..., 0] + 1j * pictures[..., 1], 0.0)
    error = noise * (rng.normal(size=now[1:].shape) + 1j * rng.normal(size=now[1:].shape))
    both = inside[1:] & inside[:-1]
    return _chained(_similarities(now[1:] + error, now[:-1], both))


def _similarities(source: np.ndarray, target: np.ndarray, both: np.ndarray) -> np.ndarray:
    """``[T, 2]`` complex (a, b): target = a source + b by least squares over the points in ``both [T, K]``."""
    seen = np.maximum(both.sum(axis=1), 1)
    source_mean = (source * both).sum(axis=1) / seen
    target_mean = (target * both).sum(axis=1) / seen
    x, y = (source - source_mean[:, None]) * both, (target - target_mean[:, None]) * both
    power = (np.abs(x) ** 2).sum(axis=1)
    enough = (both.sum(axis=1) >= 8) & (power > 1e-9)
    a = np.where(enough, (x.conj() * y).sum(axis=1) / np.where(enough, power, 1.0), 1.0)
    return np.stack([a, np.where(enough, target_mean - a * source_mean, 0.0)], axis=1)


def _chained(pairs: np.ndarray) -> Array:
    """``[T + 1, 3, 3]`` from the similarities between neighbours: each picture into the first."""
    out = np.tile(np.eye(3), (len(pairs) + 1, 1, 1))
    a, b = 1.0 + 0.0j, 0.0 + 0.0j
    for t, (turn, shift) in enumerate(pairs, start=1):
        a, b = a * turn, a * shift + b
        out[t, :2, :2] = [[a.real, -a.imag], [a.imag, a.real]]
        out[t, :2, 2] = [b.real, b.imag]
    return out
