"""2D keypoints of legs that wander."""

from __future__ import annotations

import numpy as np

from egopose.scene.contacts import LOWER_BODY


def legs(frames: int = 20, seed: int = 0) -> np.ndarray:
    """``[T, 7, 2]``."""
    random = np.random.default_rng(seed)
    return random.normal(size=(1, 7, 2)) + 0.05 * random.normal(size=(frames, 7, 2)).cumsum(axis=0)


def mirrored_legs(points: np.ndarray, sure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints and confidences in the mirror image."""
    other = [LOWER_BODY.index(_swapped(name)) for name in LOWER_BODY]
    return (points * [-1, 1])[:, other], sure[:, other]


def _swapped(name: str) -> str:
    return name.replace("right", "x").replace("left", "right").replace("x", "left")
