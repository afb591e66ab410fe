"""Random rooms for the wearer to be seen in: textured walls, floor, ceiling and furniture, drawn from a seed.

Optical flow needs something to grip, so every surface carries detail from centimetres to metres. Nothing collides.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.motion.rotations import Array, from_axis_angle
from egopose.vision.surfaces import (
    ROOM_BASE,
    ROOM_CONTRAST,
    Range,
    add_cube_material,
    add_geom,
    add_lights,
    add_material,
    add_texture,
    dress,
    random_pattern,
)

_UP = np.array([0.0, 0.0, 1.0])
# More pieces than this cost more to draw than they add to see, also in a hall of 20 m.
_MOST_PIECES = 40
_WOODS = 4


@dataclass(frozen=True)
class RoomConfig:
    """Ranges a room is drawn from; metres, pixels and pieces a square metre (``conf/vision/rendered.yaml``)."""

    margin: Range
    height: Range
    furniture_density: Range
    clearance: float
    texture_size: int
    texture_scale: Range
    train_rooms: int
    test_rooms: int


@dataclass(frozen=True)
class Piece:
    """A piece of furniture on the floor: half sizes ``[3]`` (a cylinder's first is its radius), m; yaw in rad."""

    shape: str
    centre: tuple[float, float]
    half_size: tuple[float, float, float]
    yaw: float
    wood: int


@dataclass(frozen=True)
class Room:
    """A box room: corners ``low``, ``high`` (x, y; m), its height, furniture, and the seed of its look."""

    low: tuple[float, float]
    high: tuple[float, float]
    height: float
    pieces: tuple[Piece, ...]
    seed: int


def room_seed(take: str, split: str, config: RoomConfig) -> int:
    """The room a take is seen in: always the same for its name; test rooms are seen by no training take.

    Raises:
        ValueError: ``split`` is neither ``train`` nor ``test``.
    """
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', got {split!r}")
    at = zlib.crc32(take.encode())
    return at % config.train_rooms if split == "train" else config.train_rooms + at % config.test_rooms


def draw_room(seed: int, path: Array, top: float, config: RoomConfig) -> Room:
    """A room around a motion.

    Args:
        seed: of the room; the same seed looks the same around any motion.
        path: ``[T, 2]`` the root's way over the floor, m.
        top: height that must stay free, m.
        config: ranges.
    """
    rng = np.random.default_rng([seed, 0])
    low = path.min(0) - rng.uniform(*config.margin, 2)
    high = path.max(0) + rng.uniform(*config.margin, 2)
    height = max(rng.uniform(*config.height), top + 0.3)
    wanted = rng.uniform(*config.furniture_density) * np.prod(high - low)
    pieces = []
    # Some draws fall on the path and are dropped: a room that is all path stays empty.
    for _ in range(min(int(np.ceil(wanted)), _MOST_PIECES)):
        half = rng.uniform([0.15, 0.15, 0.2], [0.6, 0.6, 1.0])
        shape = "box" if rng.random() < 0.7 else "cylinder"
        centre = rng.uniform(low, high)
        yaw, wood = rng.uniform(0, np.pi), int(rng.integers(_WOODS))
        if np.linalg.norm(path - centre, axis=1).min() > config.clearance + float(np.linalg.norm(half[:2])):
            at, size = (float(centre[0]), float(centre[1])), (float(half[0]), float(half[1]), float(half[2]))
            pieces.append(Piece(shape, at, size, yaw, wood))
    return Room((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), height, tuple(pieces), seed)


def furnish(spec: mujoco.MjSpec, room: Room, config: RoomConfig) -> None:
    """Put a room's surfaces, furniture, lights and the wearer's clothes into a humanoid's spec, in place.

    The spec's own world geoms and lights make way. Geoms of the room have no contacts and no mass.
    """
    for thing in [*spec.worldbody.geoms, *spec.worldbody.lights]:
        spec.delete(thing)
    rng = np.random.default_rng([room.seed, 1])
    build(spec, room, config, rng)
    dress(spec, rng, config.texture_size // 2)


def build(spec: mujoco.MjSpec, room: Room, config: RoomConfig, rng: np.random.Generator) -> None:
    """Put a room's surfaces, furniture and lights into a spec; ``rng`` draws their looks."""
    scale = rng.uniform(*config.texture_scale)
    _walls(spec, room, rng, config.texture_size, scale)
    for i in range(_WOODS):
        add_cube_material(spec, f"room_wood{i}", rng, config.texture_size // 2, ROOM_CONTRAST, ROOM_BASE)
    for i, piece in enumerate(room.pieces):
        shape = mujoco.mjtGeom.mjGEOM_BOX if piece.shape == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        x, y, z = piece.half_size
        position = [*piece.centre, z]
        size = [x, y, z] if piece.shape == "box" else [x, z, 0]
        turn = from_axis_angle(_UP, np.array(piece.yaw))
        add_geom(spec, f"room_piece{i}", shape, size, position, turn, f"room_wood{piece.wood}")
    add_lights(spec, rng)


def _walls(spec: mujoco.MjSpec, room: Room, rng: np.random.Generator, size: int, scale: float) -> None:
    low, high = np.array(room.low), np.array(room.high)
    (width, depth), (x, y) = (high - low) / 2, (high + low) / 2
    half = room.height / 2
    about = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0])}
    # A plane shows its +z side only; each is turned so that this looks into the room.
    surfaces = [
        ((x, y, 0.0), "x", 0.0, (width, depth)),
        ((x, y, room.height), "x", np.pi, (width, depth)),
        ((low[0], y, half), "y", np.pi / 2, (half, depth)),
        ((high[0], y, half), "y", -np.pi / 2, (half, depth)),
        ((x, low[1], half), "x", -np.pi / 2, (width, half)),
        ((x, high[1], half), "x", np.pi / 2, (width, half)),
    ]
    for i, (position, axis, angle, extent) in enumerate(surfaces):
        turn = from_axis_angle(about[axis], np.array(angle))
        name = f"room_wall{i}"
        add_texture(spec, name, mujoco.mjtTexture.mjTEXTURE_2D, random_pattern(rng, size, ROOM_CONTRAST, ROOM_BASE))
        repeat = [max(2 * e / scale, 1.0) for e in extent]
        add_material(spec, name, repeat)
        add_geom(spec, name, mujoco.mjtGeom.mjGEOM_PLANE, [*extent, 1.0], position, turn, name)
