"""Up axes, units and Euler angles: what differs between files before they become a :class:`Motion`."""

from __future__ import annotations

from decimal import ROUND_DOWN, ROUND_HALF_UP, Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

#: Metres a unit. ``asf`` is Acclaim's: CMU's skeletons state ``length 0.45``, and a value v is v / 0.45 inches.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "asf": 0.0254 / 0.45}

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


#: Rates that cameras, games and motion capture systems run at, per second; those of NTSC television apart.
_CUSTOMARY: tuple[float, ...] = (
    *(10, 12, 12.5, 15, 20, 24, 25, 30, 40, 48, 50, 60, 72, 75, 80, 90, 96, 100, 120, 144, 150, 180, 200, 240),
    *(250, 300, 360, 400, 480, 500, 600, 960, 1000),
)
#: Of a number in text; more are not those of a time, and decimal arithmetic does not take them.
_DIGITS = 25
_NTSC = tuple(1000 * rate / 1001 for rate in (15, 24, 30, 60, 120, 240))


def frame_rate(seconds: float | str) -> float:
    """Frames per second of a frame time written with few digits: 0.0083333 and 0.008 are 120, 0.0333667 is 29.97.

    The rate is the customary one whose frame time gives the written digits when it is rounded (or cut) to as many
    decimals. Of several it is the nearest, but one of NTSC television only where no other fits. Where none fits, a
    whole number within 0.05 % is taken, else what the digits say.

    Args:
        seconds: as written, where that is known; of a float the shortest way to write it counts.
    """
    value = float(seconds)
    written = Decimal(seconds.strip() if isinstance(seconds, str) and len(seconds) < _DIGITS else repr(value))
    for rounding in (ROUND_HALF_UP, ROUND_DOWN):
        for rates in (_CUSTOMARY, _NTSC):
            fitting = [r for r in rates if Decimal(1 / r).quantize(written, rounding) == written]
            if fitting:
                return float(min(fitting, key=lambda rate: abs(1 / rate - value)))
    fps = 1.0 / value
    whole = round(fps)
    return float(whole) if whole and abs(fps - whole) < 5e-4 * whole else fps


def given_rate(path: Path, fps: float) -> float:
    """The option ``fps``. Raises InputError where it is no frame rate."""
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0.0 < fps <= 1e5:
        raise InputError(path, "option fps", f"{fps!r:.40} is not a frame rate")
    return float(fps)


def given_up(path: Path, up: str) -> str:
    """The option ``up``: ``"auto"`` or an axis. Raises InputError where it is none."""
    if up != "auto" and up not in UP_AXES:
        raise InputError(path, "option up", f"{up!r:.40} is none of auto, {', '.join(UP_AXES)}")
    return up


def given_unit(path: Path, unit: str | float) -> tuple[str, float] | None:
    """The option ``unit`` as a name and metres, or None for ``"auto"``. Raises InputError where it is no unit."""
    if unit == "auto":
        return None
    if isinstance(unit, str) and unit in UNITS:
        return unit, UNITS[unit]
    if isinstance(unit, int | float) and not isinstance(unit, bool) and np.isfinite(unit) and unit > 0:
        return f"{float(unit):g} m", float(unit)
    raise InputError(path, "option unit", f"{unit!r:.40} is none of auto, {', '.join(UNITS)} or metres a unit")
