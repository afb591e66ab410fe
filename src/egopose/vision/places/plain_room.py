"""A plain room (:mod:`egopose.vision.rooms`) as a place among others."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.vision.places.place import Way
from egopose.vision.rooms import Room, RoomConfig, build, draw_room


@dataclass(frozen=True, eq=False)
class PlainRoom:
    """A box room with boxes and cylinders in it, and the ranges that it was drawn from."""

    room: Room
    config: RoomConfig
    far: float = 60.0

    @property
    def low(self) -> tuple[float, float]:
        """A corner, m."""
        return self.room.low

    @property
    def high(self) -> tuple[float, float]:
        """The other corner, m."""
        return self.room.high

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Walls, floor, ceiling, furniture and lamps."""
        build(spec, self.room, self.config, np.random.default_rng([self.room.seed, 1]))


def draw_plain_room(seed: int, way: Way, config: RoomConfig) -> PlainRoom:
    """A room around a way, from the config's ranges."""
    return PlainRoom(draw_room(seed, way.path, way.top, config), config)
