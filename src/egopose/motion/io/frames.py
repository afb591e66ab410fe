"""Up axes, units and Euler angles: what differs between files before they become a :class:`Motion`."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

#: Metres a unit. ``asf`` is Acclaim's: CMU's skeletons state ``length 0.45``, and a value v is v / 0.45 inches.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "asf": 0.0254 / 0.45}

#: Rotation vectors that take each up axis to +z; y up becomes z up by a quarter turn about x, so x stays.
_UP_TO_Z = {
    "x": (0.0, -np.pi / 2, 0.0),
    "-x": (0.0, np.pi / 2, 0.0),
    "y": (np.pi / 2, 0.0, 0.0),
    "-y": (-np.pi / 2, 0.0, 0.0),
    "z": (0.0, 0.0, 0.0),
    "-z": (np.pi, 0.0, 0.0),
}
UP_AXES = tuple(_UP_TO_Z)


def up_rotation(up: str) -> Array:
    """Quaternion ``[4]`` that takes a world whose ``up`` axis points up (``"y"``, ``"-z"`` ...) to z up.

    Raises:
        KeyError: ``up`` is none of :data:`UP_AXES`.
    """
    return rot.from_rotvec(np.array(_UP_TO_Z[up]))


def euler_angles(quats: Array, sequence: str) -> Array:
    """Intrinsic Euler angles ``[T, 3]`` (rad) of a rotation in time, made continuous.

    Args:
        quats: ``[T, 4]``.
        sequence: three different axes, the outermost first: ``"zyx"`` is the order of :func:`skeleton.hinges`.
    """
    angles = rot.to_scipy(quats).as_euler(sequence.upper(), suppress_warnings=True).reshape(-1, 3)
    return continuous_euler(angles)


def continuous_euler(angles: Array) -> Array:
    """The same rotations without jumps: of each frame's Euler triples ``[T, 3]`` (rad) the one nearest to the last.

    Holds for three hinges about axes at right angles to each other, whatever the axes.
    """
    first = angles
    second = np.stack([first[:, 0] + np.pi, np.pi - first[:, 1], first[:, 2] + np.pi], axis=-1)
    # A rotation has two triples, and their turns by 2 pi. Changing costs the same from either: each step decides alone.
    stay, change = _turn(first[1:] - first[:-1]), _turn(second[1:] - first[:-1])
    flips = np.concatenate([[0], np.cumsum(change.sum(-1) < stay.sum(-1))]) % 2 == 1
    return np.unwrap(np.where(flips[:, None], second, first), axis=0)


def from_euler(angles: Array, sequence: str) -> Array:
    """Quaternions ``[T, 4]`` of intrinsic Euler angles ``[T, 3]`` (rad)."""
    return rot.from_scipy(Rotation.from_euler(sequence.upper(), angles), angles.shape[:-1])


def _turn(difference: Array) -> Array:
    """Angle differences as distances on the circle."""
    return np.abs((difference + np.pi) % (2 * np.pi) - np.pi)


def frame_rate(seconds: float) -> float:
    """Frames per second of a frame time written with few digits: 0.0083333 is 120, 0.0333667 stays 29.97."""
    fps = 1.0 / seconds
    whole = round(fps)
    return float(whole) if whole and abs(fps - whole) < 5e-4 * whole else fps
