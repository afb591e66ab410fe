"""How fast a camera turned, from optical flow alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

# Rounds of reweighting; the weights hardly change after the third.
_ROUNDS = 5


def camera_rotation(flow: NDArray[np.floating], field_of_view: float) -> Array:
    """The camera's turn in each frame, in its own axes: x right, y down, z ahead.

    A turn w of a pinhole moves the point (x, y) at unit distance by u = x y wx - (1 + x^2) wy + y wz and
    v = (1 + y^2) wx - x y wy - x wz, whatever its depth (Longuet-Higgins & Prazdny 1980, equation 2.6). The three
    numbers are fitted to all of the flow by reweighted least squares (Cauchy's weights): the wearer's limbs and what is
    near move otherwise, and count for little. What walking moves the whole picture by remains in them as an error.

    Args:
        flow: ``[T, 2, S, S]``, picture widths per frame, channel 0 right, 1 down.
        field_of_view: degrees across the picture.

    Returns:
        ``[T, 3]`` rad per frame.
    """
    side = flow.shape[-1]
    focal = 0.5 / np.tan(np.deg2rad(0.5 * field_of_view))
    middle = ((np.arange(side) + 0.5) / side - 0.5) / focal
    x, y = (grid.ravel() for grid in np.meshgrid(middle, middle))
    across = np.stack([x * y, -(1 + x * x), y], axis=1)
    down = np.stack([1 + y * y, -x * y, -x], axis=1)
    design = focal * np.concatenate([across, down])
    turns = np.zeros((len(flow), 3))
    for turn, moved in zip(turns, np.asarray(flow, dtype=np.float64).reshape(len(flow), -1), strict=True):
        if not moved.any():
            continue
        weights = np.ones(side * side)
        for _ in range(_ROUNDS):
            weighted = design * np.tile(weights, 2)[:, None]
            turn[:] = np.linalg.solve(weighted.T @ design, weighted.T @ moved)
            error = np.hypot(*(moved - design @ turn).reshape(2, -1))
            # 1.48 medians are a standard deviation of normal errors.
            weights = 1.0 / (1.0 + (error / (1.48 * np.median(error) + 1e-9)) ** 2)
    return turns
