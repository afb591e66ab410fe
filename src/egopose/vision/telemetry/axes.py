"""From GoPro's axes to the camera's (x right, y down, z ahead), and back.

GoPro names the axes of its inertial sensor X, Y and Z. The picture in its description of GPMF has Z up and Y back; then
X is left, for the three are right-handed. Three things in real files bear this out. In ``hero7.raw`` only a
right-handed reading lets the gyroscope carry the accelerometer's vector along. In ``karma.mp4`` a drone speeds up
forwards (Y falls to -2.4 m/s^2), then turns right as it flies (Z turns at -0.75 rad/s, X falls to -4.2 m/s^2), and
the picture turns right. So camera = (-X, -Z, -Y).

A stream stores the axes in its own order. ORIN tells it, a small letter for a negated axis (``YxZ``). Cameras without
ORIN store Z, X, Y, as HERO5 did and as their stream names say.

CORI and IORI store w and then numbers about X, Z, Y. In ``hero11.raw`` they match the gyroscope if the stored
quaternion, read in camera axes as w, x, y, z, takes the starting axes (of IORI: the camera's) to those of the camera
(of IORI: the picture's). Its conjugate is the orientation. The product of the two conjugates is 20 times steadier than
either, as the view of a steadied picture must be. GRAV is x, y, z in camera axes, and points down.
"""

from __future__ import annotations

import re

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, conjugate

#: The order of cameras that do not name one.
FIRST_ORDER = "ZXY"


def to_camera(stored: Array, order: str, source: object) -> Array:
    """Vectors ``[N, 3]`` of a stream in camera axes.

    Args:
        stored: as in the file, in the order ``order`` (ORIN), a small letter negating its axis.
        order: three letters.
        source: the file, for the error.

    Raises:
        InputError: ``order`` does not name X, Y and Z once each.
    """
    if sorted(order.upper()) != ["X", "Y", "Z"]:
        raise InputError(str(source), "ORIN", f"{order[:8]!r}; expected X, Y and Z once each, small where negated")
    named = {
        letter.upper(): (-1.0 if letter.islower() else 1.0) * stored[:, column] for column, letter in enumerate(order)
    }
    return np.stack([-named["X"], -named["Z"], -named["Y"]], axis=1)


def from_camera(vectors: Array) -> Array:
    """Camera vectors ``[N, 3]`` in GoPro's order Z, X, Y."""
    return np.stack([-vectors[:, 1], -vectors[:, 0], -vectors[:, 2]], axis=1)


def named_order(orin: str | None, model: str) -> str:
    """The order of a stream: its ORIN, else the model's.

    Fusion's is -Y, X, Z by GoPro's table, though its stream names say (z,x,y).
    """
    if orin is not None:
        return re.sub(r"[\0\s]", "", orin)
    return "yXZ" if model.strip().lower() == "fusion" else FIRST_ORDER


def orientation(stored: Array) -> Array:
    """CORI or IORI ``[N, 4]`` as in the file to the orientation that :class:`Telemetry` holds; its own inverse."""
    return conjugate(stored)
