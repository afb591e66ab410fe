"""Random rooms for the wearer to be seen in: textured walls, floor, ceiling and furniture, drawn from a seed.

Optical flow needs something to grip, so every surface carries detail from centimetres to metres. Nothing collides.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array, from_axis_angle

Range = tuple[float, float]
_UP = np.array([0.0, 0.0, 1.0])
# More pieces than this cost more to draw than they add to see, also in a hall of 20 m.
_MOST_PIECES = 40
_CLOTHES, _WOODS = 3, 4
# Standard deviation and mean of patterns, in grey levels. Clothes are plainer and of stronger colours than rooms, so
# that a hand before a wall can be told from it.
_ROOM_CONTRAST, _ROOM_BASE = (40.0, 60.0), (90.0, 165.0)
_CLOTH_CONTRAST, _CLOTH_BASE = (18.0, 30.0), (40.0, 220.0)


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


def random_pattern(rng: np.random.Generator, size: int, contrast: Range, base: Range) -> NDArray[np.uint8]:
    """A picture ``[size, size, 3]`` with detail at every scale: octaves of colour noise, rectangles, sometimes stripes.

    Args:
        rng: what it is drawn with.
        size: side, pixels.
        contrast: range of the standard deviation, grey levels.
        base: range of each colour's mean, grey levels.
    """
    picture = np.zeros((size, size, 3), np.float32)
    cells = 4
    while cells <= size // 2:
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        # Colours of neighbouring surfaces differ less than their brightness does.
        noise = 0.3 * noise + 0.7 * noise.mean(axis=2, keepdims=True) * np.sqrt(3)
        method = cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_NEAREST
        picture += cells**-0.3 * cv2.resize(noise, (size, size), interpolation=method)
        cells *= 2
    for _ in range(int(rng.integers(4, 14))):
        corner, extent = rng.integers(0, size, 2), rng.integers(size // 16, size // 3, 2)
        area = (slice(corner[0], corner[0] + extent[0]), slice(corner[1], corner[1] + extent[1]))
        picture[area] += rng.normal(scale=0.8, size=3)
    if rng.random() < 0.4:
        period, phase = rng.uniform(size / 24, size / 6), rng.uniform(0, 2 * np.pi)
        wave = np.sign(np.sin(2 * np.pi * np.arange(size) / period + phase))[:, None]
        stripes = wave if rng.random() < 0.5 else wave.T
        picture += 0.5 * np.broadcast_to(stripes, (size, size))[..., None]
    picture = (picture - picture.mean()) / picture.std()
    return np.clip(rng.uniform(*base, 3) + rng.uniform(*contrast) * picture, 0, 255).astype(np.uint8)


def furnish(spec: mujoco.MjSpec, room: Room, config: RoomConfig) -> None:
    """Put a room's surfaces, furniture, lights and the wearer's clothes into a humanoid's spec, in place.

    The spec's own world geoms and lights make way. Geoms of the room have no contacts and no mass.
    """
    for thing in [*spec.worldbody.geoms, *spec.worldbody.lights]:
        spec.delete(thing)
    rng = np.random.default_rng([room.seed, 1])
    scale = rng.uniform(*config.texture_scale)
    _walls(spec, room, rng, config.texture_size, scale)
    for i in range(_WOODS):
        _cube_material(spec, f"room_wood{i}", rng, config.texture_size // 2, _ROOM_CONTRAST, _ROOM_BASE)
    for i, piece in enumerate(room.pieces):
        shape = mujoco.mjtGeom.mjGEOM_BOX if piece.shape == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        x, y, z = piece.half_size
        position = [*piece.centre, z]
        size = [x, y, z] if piece.shape == "box" else [x, z, 0]
        turn = from_axis_angle(_UP, np.array(piece.yaw))
        _geom(spec, f"room_piece{i}", shape, size, position, turn, f"room_wood{piece.wood}")
    _lights(spec, rng)
    _dress(spec, rng, config.texture_size // 2)


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
        _texture(spec, name, mujoco.mjtTexture.mjTEXTURE_2D, random_pattern(rng, size, _ROOM_CONTRAST, _ROOM_BASE))
        repeat = [max(2 * e / scale, 1.0) for e in extent]
        _material(spec, name, repeat)
        _geom(spec, name, mujoco.mjtGeom.mjGEOM_PLANE, [*extent, 1.0], position, turn, name)


def _lights(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """Two distant lamps and even light: one that moves with the wearer would make false flow."""
    ambient = rng.uniform(0.35, 0.55)
    spec.visual.headlight.ambient = [ambient] * 3
    spec.visual.headlight.diffuse = [0.0] * 3
    spec.visual.headlight.specular = [0.0] * 3
    for i in range(2):
        direction = [*rng.uniform(-1, 1, 2), rng.uniform(-1.0, -0.4)]
        light = spec.worldbody.add_light(name=f"room_light{i}", dir=direction, castshadow=False)
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.diffuse = rng.uniform(0.25, 0.5) * rng.uniform(0.85, 1.0, 3)
        light.specular = [0.0] * 3


def _dress(spec: mujoco.MjSpec, rng: np.random.Generator, size: int) -> None:
    """Clothes with patterns, so that an arm's or a leg's motion is flow too."""
    for i in range(_CLOTHES):
        _cube_material(spec, f"room_cloth{i}", rng, size, _CLOTH_CONTRAST, _CLOTH_BASE)
    for geom in spec.geoms:
        if geom.parent.name != "world":
            geom.material = f"room_cloth{rng.integers(_CLOTHES)}"
            geom.rgba = [1, 1, 1, 1]


def _texture(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTexture, pixels: NDArray[np.uint8]) -> None:
    height, width, channels = pixels.shape
    texture = spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=channels)
    texture.data = pixels.tobytes()


def _material(spec: mujoco.MjSpec, name: str, repeat: Sequence[float]) -> None:
    material = spec.add_material(name=name, texrepeat=list(repeat), specular=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _cube_material(
    spec: mujoco.MjSpec, name: str, rng: np.random.Generator, size: int, contrast: Range, base: Range
) -> None:
    """One pattern on each of six faces: a flat texture would streak along a box's sides."""
    faces = np.concatenate([random_pattern(rng, size, contrast, base)] * 6)
    _texture(spec, name, mujoco.mjtTexture.mjTEXTURE_CUBE, faces)
    _material(spec, name, (1.0, 1.0))


def _geom(
    spec: mujoco.MjSpec,
    name: str,
    shape: mujoco.mjtGeom,
    size: Sequence[float],
    position: Sequence[float],
    turn: Array,
    material: str,
) -> None:
    spec.worldbody.add_geom(
        name=name,
        type=shape,
        size=list(size),
        pos=list(position),
        quat=list(turn),
        material=material,
        contype=0,
        conaffinity=0,
    )
