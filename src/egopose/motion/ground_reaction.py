"""What the ground does to a body: a force, its point and a moment for every body that may stand on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array


@dataclass(frozen=True, eq=False)
class GroundReaction:
    """Forces of the ground on a body, in the world (z up).

    Args:
        bodies: names of the joints whose bodies the forces act on, ``B`` of them.
        force: ``[T, B, 3]`` N.
        point: ``[T, B, 3]`` m, the centre of pressure; the body's own place on the ground where there is no force.
        moment: ``[T, B, 3]`` N m about ``point``.

    Raises:
        ValueError: shapes that do not agree, or values that are not finite.
    """

    bodies: tuple[str, ...]
    force: Array
    point: Array
    moment: Array

    def __post_init__(self) -> None:
        for label in ("force", "point", "moment"):
            array = np.asarray(getattr(self, label), dtype=np.float64)
            object.__setattr__(self, label, array)
            if array.ndim != 3 or array.shape != (len(self.force), len(self.bodies), 3):
                raise ValueError(f"ground {label} must be [T, {len(self.bodies)}, 3], got {list(array.shape)}")
            if not np.isfinite(array).all():
                raise ValueError(f"ground {label} is not finite")

    def __len__(self) -> int:
        return len(self.force)

    def at(self, frames: slice | NDArray[np.integer]) -> GroundReaction:
        """The same at some frames only."""
        return GroundReaction(self.bodies, self.force[frames], self.point[frames], self.moment[frames])

    def about(self, origin: Array) -> Array:
        """Moments ``[T, B, 3]`` (N m) about ``origin`` (``[3]`` or ``[T, B, 3]``, m) in place of :attr:`point`."""
        return np.asarray(self.moment + np.cross(self.point - origin, self.force))

    def turned(self, quat: Array) -> GroundReaction:
        """In a world turned by the quaternion ``[4]``."""
        return GroundReaction(self.bodies, *(rot.rotate(quat, v) for v in (self.force, self.point, self.moment)))
