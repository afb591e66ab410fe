"""Rotations in NumPy: quaternions ``wxyz``, batch axes lead, the last axis holds the components.

Only what kinematics needs a million times stands here; everything rare goes through ``scipy.spatial.transform``.
The torch twin for the environment is :mod:`egopose.envs.mdp.rotations`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product ``p * q`` of ``[..., 4]`` quaternions (first q, then p)."""
    # Written out by component: `moveaxis`, `stack` and `cross` cost more than the products on arrays of this size.
    pw, px, py, pz = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    qw, qx, qy, qz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    w = pw * qw - px * qx - py * qy - pz * qz
    out = np.empty((*w.shape, 4))
    out[..., 0] = w
    out[..., 1] = pw * qx + px * qw + py * qz - pz * qy
    out[..., 2] = pw * qy - px * qz + py * qw + pz * qx
    out[..., 3] = pw * qz + px * qy - py * qx + pz * qw
    return out


def conjugate(q: Array) -> Array:
    """Inverse of unit quaternions ``[..., 4]``."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Array, v: Array) -> Array:
    """Vectors ``[..., 3]`` turned by unit quaternions ``[..., 4]``."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    a, b, c = v[..., 0], v[..., 1], v[..., 2]
    # v + w t + u x t with t = 2 u x v, by component.
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    first = a + w * tx + (y * tz - z * ty)
    out = np.empty((*first.shape, 3))
    out[..., 0] = first
    out[..., 1] = b + w * ty + (z * tx - x * tz)
    out[..., 2] = c + w * tz + (x * ty - y * tx)
    return out


def from_axis_angle(axis: Array, angle: Array) -> Array:
    """Quaternions ``[..., 4]`` of a turn by ``angle [...]`` (rad) about unit ``axis [..., 3]``."""
    half = 0.5 * np.asarray(angle)[..., None]
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def normalize(q: Array) -> Array:
    """Unit quaternions; a zero quaternion becomes NaN."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def to_rotvec(q: Array) -> Array:
    """Rotation vectors ``[..., 3]`` (rad), the short way round (|angle| <= pi)."""
    q = np.where(q[..., :1] < 0, -q, q)
    sin_half = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sin_half, q[..., :1])
    return np.where(sin_half > 1e-12, q[..., 1:] / np.maximum(sin_half, 1e-12) * angle, 2.0 * q[..., 1:])


def from_rotvec(v: Array) -> Array:
    """Quaternions ``[..., 4]`` of rotation vectors ``[..., 3]`` (rad)."""
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    scale = np.where(angle > 1e-12, np.sin(0.5 * angle) / np.maximum(angle, 1e-12), 0.5)
    return np.concatenate([np.cos(0.5 * angle), scale * v], axis=-1)


def to_matrix(q: Array) -> Array:
    """Rotation matrices ``[..., 3, 3]``."""
    return to_scipy(q).as_matrix().reshape(*q.shape[:-1], 3, 3)


def to_scipy(q: Array) -> Rotation:
    """The flattened batch as a :class:`scipy.spatial.transform.Rotation` (which is ``xyzw`` inside)."""
    return Rotation.from_quat(np.asarray(q).reshape(-1, 4)[:, [1, 2, 3, 0]])


def from_scipy(rotation: Rotation, shape: tuple[int, ...]) -> Array:
    """Quaternions ``[*shape, 4]`` of a flattened SciPy batch, scalar part made non-negative."""
    q = np.atleast_2d(rotation.as_quat(canonical=True))[:, [3, 0, 1, 2]]
    return q.reshape(*shape, 4)


def between(a: Array, b: Array) -> Array:
    """The smallest rotation ``[..., 4]`` that takes direction ``a [..., 3]`` to direction ``b [..., 3]``."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    w = 1.0 + np.sum(a * b, axis=-1, keepdims=True)
    xyz = np.cross(a, b)
    # Opposite directions: any axis at right angles to `a` will do.
    helper = np.where(np.abs(a[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    opposite = np.concatenate([np.zeros_like(w), np.cross(a, helper)], axis=-1)
    return normalize(np.where(w > 1e-9, np.concatenate([w, xyz], axis=-1), opposite))


def heading(q: Array) -> Array:
    """Heading quaternion: keep (w, z), zero (x, y), renormalise."""
    h = q * np.array([1.0, 0.0, 0.0, 1.0])
    return normalize(h)


def yaw(q: Array) -> Array:
    """Angle ``[...]`` of the :func:`heading` of quaternions ``[..., 4]``, rad within [-pi, pi]; zero faces along x."""
    return wrapped(2.0 * np.arctan2(q[..., 3], q[..., 0]))


def wrapped(angle: Array) -> Array:
    """Angles ``[...]`` in rad, the same directions within [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def continuous(q: Array) -> Array:
    """Signs chosen along the first (time) axis so that neighbours lie on one half-sphere. ``[T, ..., 4]``."""
    flips = np.sum(q[1:] * q[:-1], axis=-1) < 0
    sign = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    out = q.copy()
    out[1:] *= sign[..., None]
    return out
