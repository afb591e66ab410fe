"""Electronic stabilisation as an action camera does it: the picture is turned against the camera's own shake.

The view follows a low pass of the camera's rotation, as far as the rows and columns allow that the camera keeps back.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array, continuous, from_scipy, normalize, to_scipy
from egopose.vision.shooting import Optics

# s, standard deviation of the low pass: steps come at 2 Hz and are to vanish, turns of a second are to stay.
_TIME = 0.4
# Halvings of the share of a correction that still fits the sensor: to a ten thousandth of it.
_HALVINGS = 13


def image_rotations(rotations: Array, fps: float, optics: Optics) -> Array:
    """What takes directions in the steadied picture to the camera's axes, frame by frame.

    Args:
        rotations: ``[T, 3, 3]`` of the camera, to the world.
        fps: frames/s.
        optics: with the crop that bounds the correction.

    Returns:
        ``[T, 3, 3]``; ``rotations @`` this is how the steadied view is turned.
    """
    quaternions = continuous(from_scipy(Rotation.from_matrix(rotations), (len(rotations),)))
    smooth = normalize(gaussian_filter1d(quaternions, _TIME * fps, axis=0, mode="nearest"))
    wanted = (Rotation.from_matrix(rotations).inv() * to_scipy(smooth)).as_rotvec()
    kept = optics.border(kept=True)
    low, high = np.zeros(len(wanted)), np.ones(len(wanted))
    for _ in range(_HALVINGS):
        # The first try is the whole correction.
        middle = 0.5 * (low + high) if low.any() or (high < 1).any() else high
        turned = np.einsum("tij,nj->tni", Rotation.from_rotvec(middle[:, None] * wanted).as_matrix(), kept)
        fits = (np.abs(optics.on_sensor(turned)) <= 1.0).all(axis=(1, 2))
        low, high = np.where(fits, middle, low), np.where(fits, high, middle)
    return np.asarray(Rotation.from_rotvec(low[:, None] * wanted).as_matrix())
