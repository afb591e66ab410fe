"""A street: pavements with kerbs, a road with stripes, fronts of buildings on both sides, parked cars and posts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.vision.places import things
from egopose.vision.places.pictures import add_sky, front_picture, ground_picture
from egopose.vision.places.place import Builder, Way, paint, pattern_materials
from egopose.vision.surfaces import CLOTH_BASE, ROOM_BASE, add_lights

# How far the street goes on each way, m, and metres of it that one picture of the ground covers.
_REACH, _COVERED = 80.0, 16.0
_KERB, _ROAD, _BLOCK = 0.13, 6.5, 12.0


@dataclass(frozen=True, eq=False)
class Street:
    """A street along ``yaw`` through ``origin``; across it, m to the left: the pavement the way is on, then the road.

    Args:
        origin: m. yaw: rad.
        pavement: m to the left where this pavement begins (at the fronts) and ends (at the kerb); ``side`` turns it.
        side: 1 where the road lies on the left, -1 on the right.
        half_length: m of the way along the street, on each side of the origin.
        low, high: corners of where people walk, m.
        seed: of its look.
    """

    origin: tuple[float, float]
    yaw: float
    pavement: tuple[float, float]
    side: int
    half_length: float
    low: tuple[float, float]
    high: tuple[float, float]
    seed: int
    far: float = 200.0

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Ground, fronts, cars, posts, sky and the sun."""
        rng = np.random.default_rng([self.seed, 1])
        add_sky(spec, rng)
        b = Builder(spec, "street", self.origin, self.yaw)
        reach = _REACH + self.half_length
        front, kerb = self.pavement
        repeat = 2 * reach / _COVERED
        slabs = paint(
            spec,
            "street_slabs",
            ground_picture(rng, "paving", 1024, _COVERED),
            (repeat, max(kerb - front, 1.0) / _COVERED),
        )
        tar = paint(spec, "street_tar", ground_picture(rng, "asphalt", 1024, _COVERED), (repeat, _ROAD / _COVERED))
        stone, white, dark, *paints = pattern_materials(spec, "street_paint", rng, 6, (10.0, 25.0), CLOTH_BASE)
        wood = pattern_materials(spec, "street_wood", rng, 2, (20.0, 50.0), ROOM_BASE)
        leaves = pattern_materials(spec, "street_leaf", rng, 2, (25.0, 45.0), (35.0, 95.0))

        def across(y: float) -> float:
            return self.side * y

        half = 0.5 * (kerb - front)
        b.floor(0, across(front + half), 0.0, (reach, half), slabs)
        b.floor(0, across(kerb + 0.5 * _ROAD), -_KERB, (reach, 0.5 * _ROAD), tar)
        b.box(0, across(kerb - 0.06), -0.5 * _KERB + 0.002, (reach, 0.07, 0.5 * _KERB), stone)
        b.box(0, across(kerb + _ROAD + 0.06), -0.5 * _KERB + 0.002, (reach, 0.07, 0.5 * _KERB), stone)
        b.floor(0, across(kerb + _ROAD + 1.5), 0.0, (reach, 1.5), slabs)
        for x in np.arange(-0.6 * reach, 0.6 * reach, 6.0):
            b.box(x, across(kerb + 0.5 * _ROAD), -_KERB + 0.004, (1.5, 0.06, 0.004), white)
        self._fronts(b, rng, spec, across, reach)
        for x in np.arange(-0.8 * reach, 0.8 * reach, 5.8):
            if rng.random() < 0.55:
                at = Builder(spec, "street_car", (*b.at(x, across(kerb + _ROAD - 1.1)).origin[:2], -_KERB), self.yaw)
                things.car(at, rng, paints, dark)
            if rng.random() < 0.4:
                things.pole(b.at(x, across(kerb - 0.35), -self.side * np.pi / 2), rng, wood)
            elif rng.random() < 0.2:
                things.tree(b.at(x, across(kerb + _ROAD + 0.8)), rng, leaves, wood)
        add_lights(spec, rng)

    def _fronts(
        self, b: Builder, rng: np.random.Generator, spec: mujoco.MjSpec, across: Callable[[float], float], reach: float
    ) -> None:
        """Rows of buildings that face the road."""
        shapes = rng.uniform([8.0, 6.0], [_BLOCK, 14.0], (5, 2))
        pictures = [paint(spec, f"street_front{i}", front_picture(rng, *shape)) for i, shape in enumerate(shapes)]
        opposite = self.pavement[1] + _ROAD + 3.0
        for place, facing in ((self.pavement[0], self.side), (opposite, -self.side)):
            x = -reach
            while x < reach:
                i = int(rng.integers(len(shapes)))
                half, high = 0.5 * shapes[i][0], shapes[i][1]
                b.wall(x + half, across(place), 0.0, facing * 0.5 * np.pi, (half, 0.5 * high), pictures[i])
                x += 2 * half + (rng.uniform(1.0, 4.0) if rng.random() < 0.2 else 0.0)


def draw_street(seed: int, way: Way) -> Street:
    """A street along a way: along its longer extent, or where the wearer faces if he hardly moves.

    Args:
        seed: of the place.
        way: that stays on the pavement.
    """
    rng = np.random.default_rng([seed, 0])
    middle = 0.5 * (way.path.min(0) + way.path.max(0))
    spread = np.linalg.svd(way.path - way.path.mean(0), full_matrices=False)[2][0]
    moved = float(np.ptp(way.path @ spread))
    yaw = float(np.arctan2(spread[1], spread[0])) if moved > 2.0 else float(way.heading[0] + rng.normal(scale=0.5))
    along, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    side = 1 if rng.random() < 0.5 else -1
    lateral = side * ((way.path - middle) @ left)
    # Fronts are 3 to 10 m away on the near side at most, the kerb nearer.
    begins, ends = float(lateral.min() - rng.uniform(1.5, 4.0)), float(lateral.max() + rng.uniform(0.8, 3.0))
    half = 0.5 * float(np.ptp((way.path - middle) @ along)) + 1.0
    corners = [middle + a * half * along + side * y * left for a in (-1, 1) for y in (begins + 0.5, ends)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    origin, box = (
        (float(middle[0]), float(middle[1])),
        ((float(low[0]), float(low[1])), (float(high[0]), float(high[1]))),
    )
    return Street(origin, yaw, (begins, ends), side, half, *box, seed)
