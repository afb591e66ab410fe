"""Open ground: grass, gravel or pavement to a horizon, a sky, and a few things far apart; or the edge of a cliff."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.motion.rotations import Array
from egopose.vision.places import things
from egopose.vision.places.pictures import GROUNDS, add_sky, front_picture, ground_picture
from egopose.vision.places.place import Builder, Way, paint, pattern_materials
from egopose.vision.surfaces import ROOM_BASE, add_lights

# Half the side of the ground, m: its edge lies half a degree under the horizon of one who stands.
_HORIZON = 160.0
# Half the side, m, of the finely drawn ground beyond the way; pixels of it and of all the rest.
_NEAR, _PIXELS = 9.0, 1536
# How far under the near ground the rest lies, m: enough for the depth buffer, too little to be seen.
_LOWER = 0.03
_KINDS = ("pole", "bush", "tree", "building")
_LEAVES = (35.0, 95.0)


@dataclass(frozen=True, eq=False)
class OpenGround:
    """A kind of ground about a way, and the things on it: kind, x, y and turn of each.

    Args:
        ground: a kind of :data:`~egopose.vision.places.pictures.GROUNDS`.
        low, high: corners of the finely drawn ground, m.
        things: kind, x, y (m) and turn (rad) of each.
        drop: m that the ground falls beyond ``y = edge``; 0 for none.
        edge: m.
        seed: of its look.
    """

    ground: str
    low: tuple[float, float]
    high: tuple[float, float]
    things: tuple[tuple[str, float, float, float], ...]
    drop: float
    edge: float
    seed: int
    far: float = 1.5 * _HORIZON

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Ground, sky, things and the sun."""
        rng = np.random.default_rng([self.seed, 1])
        add_sky(spec, rng)
        low, high = np.array(self.low), np.array(self.high)
        middle, half = (low + high) / 2, float((high - low).max() / 2)
        b = Builder(spec, "ground")
        near = paint(spec, "ground_near", ground_picture(rng, self.ground, _PIXELS, 2 * half))
        if self.drop == 0.0:
            b.floor(middle[0], middle[1], 0.0, (half, half), near)
        rest = ground_picture(rng, str(rng.choice(GROUNDS)), _PIXELS, _HORIZON)
        far = paint(spec, "ground_far", rest, (2.0, 2.0))
        if self.drop == 0.0:
            b.floor(middle[0], middle[1], -_LOWER, (_HORIZON, _HORIZON), far)
        else:
            self._cliff(b, near, far, middle)
        leaves = pattern_materials(spec, "ground_leaf", rng, 3, (25.0, 45.0), _LEAVES)
        wood = pattern_materials(spec, "ground_wood", rng, 3, (20.0, 50.0), ROOM_BASE)
        fronts = [paint(spec, f"ground_front{i}", front_picture(rng, 14.0, 10.0)) for i in range(2)]
        for kind, x, y, turn in self.things:
            at = b.at(x, y, turn)
            if kind == "pole":
                things.pole(at, rng, wood)
            elif kind == "bush":
                things.bush(at, rng, leaves)
            elif kind == "tree":
                things.tree(at, rng, leaves, wood)
            else:
                size = rng.uniform([4.0, 4.0, 4.0], [12.0, 12.0, 14.0])
                things.building(at, str(rng.choice(fronts)), far, (size[0], size[1]), size[2])
        add_lights(spec, rng)

    def _cliff(self, b: Builder, near: str, far: str, middle: Array) -> None:
        """A plateau that ends at ``y = edge``, its face, and the ground beneath."""
        half = 0.5 * _HORIZON
        b.floor(middle[0], self.edge - half, 0.0, (_HORIZON, half), far)
        b.wall(middle[0], self.edge, -self.drop, 0.5 * np.pi, (_HORIZON, 0.5 * self.drop), near)
        b.floor(middle[0], self.edge + _HORIZON, -self.drop, (_HORIZON, _HORIZON), far)


def draw_open_ground(seed: int, way: Way, drop: float = 0.0) -> OpenGround:
    """Open ground about a way; with a ``drop`` (m), a plateau that ends beside it.

    Args:
        seed: of the place.
        way: that stays free.
        drop: m.
    """
    rng = np.random.default_rng([seed, 0])
    ground = str(rng.choice(["grass", "gravel", "paving", "asphalt", "soil"], p=[0.35, 0.2, 0.2, 0.15, 0.1]))
    low, high = way.path.min(0) - _NEAR, way.path.max(0) + _NEAR
    edge = float(way.path[:, 1].max() + rng.uniform(2.0, 6.0))
    found: list[tuple[str, float, float, float]] = []
    for _ in range(int(rng.integers(14, 36))):
        kind = str(rng.choice(_KINDS, p=[0.2, 0.4, 0.25, 0.15]))
        least = {"pole": 2.5, "bush": 3.0, "tree": 5.0, "building": 30.0}[kind]
        away, bearing = rng.uniform(least, 60.0 + least), rng.uniform(0, 2 * np.pi)
        place = way.path[int(rng.integers(len(way.path)))] + away * np.array([np.cos(bearing), np.sin(bearing)])
        turn = rng.uniform(0, 2 * np.pi)
        # A building reaches 17 m from its middle.
        clear = 25.0 if kind == "building" else least
        if way.distance(place) >= clear and (drop == 0.0 or place[1] < edge - 4.0):
            found.append((kind, float(place[0]), float(place[1]), float(turn)))
    corners = ((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
    return OpenGround(ground, *corners, tuple(found), drop, edge, seed)
