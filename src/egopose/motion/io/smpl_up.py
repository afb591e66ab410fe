"""Which way is up in a file whose format has a custom that not all tools keep."""

from __future__ import annotations

import numpy as np

from egopose.motion.rotations import Array

#: What tools have for up: AMASS and most of mocap, most of graphics, and cameras (y down).
_CANDIDATES = ("z", "y", "-y")

#: What each piece of evidence weighs against a body that stands straight along the axis all the time (1).
_FLOOR, _NOUGHT, _CUSTOM = 2.0, 0.8, 0.15

#: Shares of the body's height: how near to nought a floor is. Tools that turn a file turn ``trans`` without the
#: pelvis's own place, which is 0.3 m off.
_NEAR = 0.25


def guess_up(positions: Array, head: int, feet: tuple[int, int], moved: bool, custom: str = "z") -> str:
    """The up axis of a body in motion.

    Three things speak for an axis: the head is above the feet along it; the body's lowest point stays level, because
    there is a floor; and that floor is at nought, as recordings have it. The last two tell a body that lies, crawls or
    turns over from one that stands.

    Args:
        positions: ``[T, J, 3]`` of its joints (m), the pelvis first.
        head: index of its head.
        feet: of its ankles.
        moved: whether the clip was moved to begin at the origin; then its floor need not be at nought.
        custom: what the format's own files have.
    """
    toward_head = positions[:, head] - positions[:, list(feet)].mean(axis=1)
    reach = max(float(np.linalg.norm(toward_head, axis=-1).max()), 1e-9)
    heights = {up: _along(positions, up).min(axis=1) for up in _CANDIDATES}
    near = {up: abs(np.median(heights[up])) < _NEAR * reach for up in _CANDIDATES}

    def score(up: str) -> float:
        low, high = np.percentile(heights[up], [5, 75])  # flight and steps take the rest
        stands = float(_along(toward_head, up).mean()) / reach
        return (
            stands - _FLOOR * float(high - low) / reach + _NOUGHT * (near[up] and not moved) + _CUSTOM * (up == custom)
        )

    return max(_CANDIDATES, key=score)


def _along(vectors: Array, up: str) -> Array:
    sign = -1.0 if up.startswith("-") else 1.0
    return sign * vectors[..., "xyz".index(up[-1])]
