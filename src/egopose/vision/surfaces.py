"""What scenes are made of: random patterns, textures, materials, shapes, lights and clothes, put into a MjSpec.

Optical flow needs something to grip, so every surface carries detail from centimetres to metres. Nothing collides.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

Range = tuple[float, float]
_CLOTHES = 3
# Standard deviation and mean of patterns, in grey levels. Clothes are plainer and of stronger colours than rooms, so
# that a hand before a wall can be told from it.
ROOM_CONTRAST, ROOM_BASE = (40.0, 60.0), (90.0, 165.0)
CLOTH_CONTRAST, CLOTH_BASE = (18.0, 30.0), (40.0, 220.0)


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


def add_lights(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
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


def dress(spec: mujoco.MjSpec, rng: np.random.Generator, size: int) -> None:
    """Clothes with patterns, so that an arm's or a leg's motion is flow too."""
    for i in range(_CLOTHES):
        add_cube_material(spec, f"room_cloth{i}", rng, size, CLOTH_CONTRAST, CLOTH_BASE)
    for geom in spec.geoms:
        if geom.parent.name != "world":
            geom.material = f"room_cloth{rng.integers(_CLOTHES)}"
            geom.rgba = [1, 1, 1, 1]


def add_texture(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTexture, pixels: NDArray[np.uint8]) -> None:
    """A texture of a picture ``[H, W, 3]``; the six faces of a cube are stacked over each other."""
    height, width, channels = pixels.shape
    texture = spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=channels)
    texture.data = pixels.tobytes()


def add_material(spec: mujoco.MjSpec, name: str, repeat: Sequence[float]) -> None:
    """A dull material that shows the texture of its own name, repeated so often along each side."""
    material = spec.add_material(name=name, texrepeat=list(repeat), specular=0.0, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def add_cube_material(
    spec: mujoco.MjSpec, name: str, rng: np.random.Generator, size: int, contrast: Range, base: Range
) -> None:
    """One pattern on each of six faces: a flat texture would streak along a box's sides."""
    faces = np.concatenate([random_pattern(rng, size, contrast, base)] * 6)
    add_texture(spec, name, mujoco.mjtTexture.mjTEXTURE_CUBE, faces)
    add_material(spec, name, (1.0, 1.0))


def add_geom(
    spec: mujoco.MjSpec,
    name: str,
    shape: mujoco.mjtGeom,
    size: Sequence[float],
    position: Sequence[float],
    turn: Array,
    material: str,
) -> None:
    """A shape of the world at ``position`` (m), turned by a quaternion: without contacts."""
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
