"""What carries a body in each frame, by the scene's contacts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FLOOR = -1


def carriers(touches: NDArray[np.bool_]) -> NDArray[np.int64]:
    """``[T]`` the box that carries the body, :data:`FLOOR` for the floor.

    Of several things the one that has carried longest. In the air what carried last; before any contact the floor.

    Args:
        touches: ``[T, E, 1 + K]`` whether each of E bodies touches the floor (first) and each box.
    """
    out = np.full(len(touches), FLOOR)
    now = 0
    since = np.full(touches.shape[2], -1)
    touched: NDArray[np.bool_] = np.asarray(touches.any(axis=1))
    for t, row in enumerate(touched):
        since = np.where(row, np.where(since < 0, t, since), -1)
        if row.any():
            now = int(np.where(row, since, len(touches)).argmin())
        out[t] = now - 1
    return out
