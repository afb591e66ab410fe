"""The body up-hint: how far the way from pelvis to head is from up (Yu, Park & Lee 2021, section 5.1).

The paper reads it off the picture, as the angle of pelvis to neck against the picture's up. Here poses are lifted to
world axes before, so the angle is that of the body's own pelvis and head. It tells of tilt alone, not of a place.
"""

from __future__ import annotations

import numpy as np

from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def up_hint(body: Motion, head: str = "Head") -> Array:
    """``[T]`` rad between the way from the root to ``head`` and the vertical."""
    positions, _ = body.forward_kinematics()
    way = positions[:, body.skeleton.index(head)] - positions[:, 0]
    return np.asarray(np.arctan2(np.linalg.norm(way[:, :2], axis=1), way[:, 2]))
