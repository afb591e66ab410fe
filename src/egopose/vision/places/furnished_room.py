"""A furnished room: plain walls with pictures, a door and a window, and furniture that one recognises."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.motion.rotations import Array
from egopose.vision.places import things
from egopose.vision.places.pictures import ground_picture, wall_picture
from egopose.vision.places.place import Builder, Way, paint, pattern_materials
from egopose.vision.surfaces import CLOTH_BASE, CLOTH_CONTRAST, ROOM_BASE, ROOM_CONTRAST, add_lights, random_pattern

# The way's clearance to furniture, m, and each kind's reach from its middle.
_CLEARANCE = 0.45
_REACHES = {"table": 0.9, "chair": 0.32, "sofa": 1.1, "shelf": 0.6, "cabinet": 0.6, "lamp": 0.25}
# Of a room's walls, those with furniture at their foot; metres from a wall to the middle of what stands before it.
_AGAINST = {"sofa": 0.5, "shelf": 0.18, "cabinet": 0.28}
_PIXELS = 512


@dataclass(frozen=True, eq=False)
class FurnishedRoom:
    """A box room: corners (m), height (m), and furniture: kind, x, y (m) and turn (rad) of each."""

    low: tuple[float, float]
    high: tuple[float, float]
    height: float
    furniture: tuple[tuple[str, float, float, float], ...]
    seed: int
    far: float = 60.0

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Walls, floor, ceiling, furniture and lamps."""
        rng = np.random.default_rng([self.seed, 1])
        b = Builder(spec, "furnished")
        low, high = np.array(self.low), np.array(self.high)
        (x, y), half = (low + high) / 2, (high - low) / 2
        side = float(half.max())
        floor = random_pattern(rng, _PIXELS, (15.0, 40.0), ROOM_BASE)
        if rng.random() < 0.5:
            floor = ground_picture(rng, "paving", _PIXELS, 5.0)
        repeat = (max(2 * half[0] / 5.0, 1.0), max(2 * half[1] / 5.0, 1.0))
        b.floor(x, y, 0.0, (half[0], half[1]), paint(spec, "furnished_floor", floor, repeat))
        ceiling = paint(spec, "furnished_ceiling", wall_picture(rng, _PIXELS), (side / 2, side / 2))
        down = np.array([0.0, 1.0, 0.0, 0.0])
        b.add(mujoco.mjtGeom.mjGEOM_PLANE, (x, y, self.height), (half[0], half[1], 1.0), ceiling, down)
        frames = [
            paint(spec, f"furnished_frame{i}", random_pattern(rng, 128, ROOM_CONTRAST, ROOM_BASE)) for i in range(4)
        ]
        door = paint(spec, "furnished_door", random_pattern(rng, 128, (8.0, 15.0), (60.0, 190.0)))
        for i, facing in enumerate((0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)):
            wide, deep = (half[1], half[0]) if i % 2 == 0 else (half[0], half[1])
            paper = paint(spec, f"furnished_wall{i}", wall_picture(rng, _PIXELS), (wide, self.height / 2))
            # The wall's frame: x points into the room, y along the wall.
            wall = b.at(x - deep * np.cos(facing), y - deep * np.sin(facing), facing)
            wall.wall(0, 0, 0, 0.0, (wide, 0.5 * self.height), paper)
            wall.box(0.01, 0, 0.04, (0.01, wide, 0.04), "furnished_wood0")
            if i == int(self.seed) % 4:
                wall.wall(0.01, rng.uniform(-0.5, 0.5) * wide, 0.0, 0.0, (0.45, 1.0), door)
            for _ in range(int(rng.integers(1, 2 + int(wide)))):
                size = rng.uniform([0.15, 0.15], [0.6, 0.5])
                at, bottom = rng.uniform(-0.85, 0.85) * wide, rng.uniform(0.9, 1.5)
                wall.wall(0.012, at, bottom, 0.0, (size[0], size[1]), str(rng.choice(frames)))
        wood = pattern_materials(spec, "furnished_wood", rng, 5, (15.0, 40.0), (50.0, 200.0))
        cloth = pattern_materials(spec, "furnished_cloth", rng, 3, CLOTH_CONTRAST, CLOTH_BASE)
        makers = {"table": things.table, "chair": things.chair, "shelf": things.shelf, "cabinet": things.cabinet}
        for kind, at_x, at_y, turn in self.furniture:
            at = b.at(at_x, at_y, turn)
            if kind == "sofa":
                things.sofa(at, rng, cloth)
            else:
                makers.get(kind, things.lamp)(at, rng, wood)
        add_lights(spec, rng)


def draw_furnished_room(seed: int, way: Way) -> FurnishedRoom:
    """A room about a way, from a study's size to a hall's, with what fits into it beside the way.

    Args:
        seed: of the place.
        way: that stays free.
    """
    rng = np.random.default_rng([seed, 0])
    # Rooms of all sizes, large ones too: the margin's logarithm is even.
    margin = np.exp(rng.uniform(np.log(1.2), np.log(6.0), (2, 2)))
    low, high = way.path.min(0) - margin[0], way.path.max(0) + margin[1]
    height = max(rng.uniform(2.4, 4.0), way.top + 0.3)
    found: list[tuple[str, float, float, float]] = []

    def stand(kind: str, place: Array, turn: float) -> bool:
        reach = _REACHES[kind]
        free = way.distance(place) > reach + _CLEARANCE
        apart = all(np.hypot(place[0] - x, place[1] - y) > 0.8 * (reach + _REACHES[k]) for k, x, y, _ in found)
        if free and apart:
            found.append((kind, float(place[0]), float(place[1]), float(turn)))
        return free and apart

    for _ in range(int(rng.integers(8, 24))):
        if rng.random() < 0.65:
            kind = str(rng.choice(list(_AGAINST)))
            facing = int(rng.integers(4)) * 0.5 * np.pi
            inward = np.array([np.cos(facing), np.sin(facing)]).round()
            place = rng.uniform(low + 0.7, high - 0.7)
            edge = np.where(inward > 0, low, high) + _AGAINST[kind] * inward
            stand(kind, np.where(inward != 0, edge, place), facing)
        elif stand("table", place := rng.uniform(low + 1.0, high - 1.0), turn := rng.uniform(0, 2 * np.pi)):
            for bearing in (0.0, np.pi):
                beside = place + 0.75 * np.array([np.cos(turn + bearing), np.sin(turn + bearing)])
                if way.distance(beside) > _REACHES["chair"] + _CLEARANCE:
                    found.append(("chair", float(beside[0]), float(beside[1]), float(turn + bearing + np.pi)))
        else:
            stand("lamp", rng.uniform(low + 0.3, high - 0.3), 0.0)
    return FurnishedRoom((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), height, tuple(found), seed)
