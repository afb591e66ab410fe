"""Things that stand in places, built of a few shapes each: furniture indoors, poles, bushes, trees and cars outdoors.

Each function takes a :class:`~egopose.vision.places.place.Builder` whose frame is the thing's own: it stands on the
floor about the origin and faces along x. Sizes are those of the shops, m.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from egopose.vision.places.place import Builder


def table(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A table with a few things on it."""
    half, high = rng.uniform([0.35, 0.5], [0.45, 0.9]), rng.uniform(0.70, 0.78)
    top = str(rng.choice(wood))
    b.box(0, 0, high - 0.02, (half[0], half[1], 0.02), top)
    for x in (-1, 1):
        for y in (-1, 1):
            b.box(x * (half[0] - 0.05), y * (half[1] - 0.05), 0.5 * high - 0.02, (0.03, 0.03, 0.5 * high - 0.02), top)
    for _ in range(int(rng.integers(2, 6))):
        x, y = rng.uniform(-0.8, 0.8, 2) * half
        if rng.random() < 0.5:
            b.column(x, y, high, high + rng.uniform(0.08, 0.25), rng.uniform(0.03, 0.06), str(rng.choice(wood)))
        else:
            size = rng.uniform([0.06, 0.08, 0.01], [0.12, 0.16, 0.06])
            turned = b.at(x, y, rng.uniform(0, np.pi))
            turned.box(0, 0, high + size[2], (size[0], size[1], size[2]), str(rng.choice(wood)))


def chair(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A chair with a back."""
    seat, half, material = rng.uniform(0.43, 0.48), rng.uniform(0.19, 0.23), str(rng.choice(wood))
    b.box(0, 0, seat - 0.02, (half, half, 0.02), material)
    b.box(-half + 0.02, 0, seat + 0.3, (0.015, half, 0.14), str(rng.choice(wood)))
    for x in (-1, 1):
        for y in (-1, 1):
            high = seat + 0.42 if x < 0 else seat - 0.02
            b.box(x * (half - 0.02), y * (half - 0.02), 0.5 * high, (0.018, 0.018, 0.5 * high), material)


def shelf(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A bookshelf, its back to -x, with books."""
    depth, half, high = 0.15, rng.uniform(0.35, 0.6), rng.uniform(1.2, 2.1)
    material = str(rng.choice(wood))
    for side in (-1, 1):
        b.box(0, side * half, 0.5 * high, (depth, 0.015, 0.5 * high), material)
    b.box(-depth, 0, 0.5 * high, (0.01, half, 0.5 * high), str(rng.choice(wood)))
    boards = np.linspace(0.08, high, int(rng.integers(4, 7)))
    for low in boards:
        b.box(0, 0, low, (depth, half, 0.015), material)
    for low in boards[:-1]:
        left = -half + 0.03
        while left < half - 0.15:
            wide, tall = rng.uniform(0.05, 0.2), rng.uniform(0.15, 0.27)
            if rng.random() < 0.8:
                b.box(0, left + wide / 2, low + tall / 2 + 0.015, (0.1, wide / 2, tall / 2), str(rng.choice(wood)))
            left += wide + 0.01


def sofa(b: Builder, rng: np.random.Generator, cloth: Sequence[str]) -> None:
    """A sofa with arms, back and cushions."""
    half, material = rng.uniform(0.75, 1.1), str(rng.choice(cloth))
    b.box(0, 0, 0.21, (0.42, half, 0.21), material)
    b.box(-0.36, 0, 0.55, (0.1, half, 0.3), material)
    for side in (-1, 1):
        b.box(0, side * (half - 0.09), 0.42, (0.42, 0.09, 0.21), material)
        b.blob(-0.18, side * (half - 0.4), 0.58, (0.1, 0.22, 0.2), str(rng.choice(cloth)))


def cabinet(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A chest of drawers or a wardrobe, its back to -x."""
    half, high = rng.uniform(0.3, 0.6), float(rng.choice([0.8, 1.1, 2.0]))
    b.box(0, 0, 0.5 * high, (0.24, half, 0.5 * high), str(rng.choice(wood)))
    for low in np.arange(0.1, high - 0.2, 0.3):
        b.box(0.245, 0, low + 0.13, (0.01, half - 0.04, 0.12), str(rng.choice(wood)))
        b.box(0.26, 0, low + 0.13, (0.015, 0.08, 0.012), str(rng.choice(wood)))


def lamp(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A standard lamp, or a plant in a pot."""
    b.column(0, 0, 0, 0.04, 0.15, str(rng.choice(wood)))
    high = rng.uniform(1.3, 1.7)
    b.column(0, 0, 0, high, 0.015, str(rng.choice(wood)))
    b.blob(0, 0, high, (0.2, 0.2, 0.15), str(rng.choice(wood)))


def pole(b: Builder, rng: np.random.Generator, wood: Sequence[str]) -> None:
    """A lamp post or a mast."""
    high = rng.uniform(4.0, 9.0)
    b.column(0, 0, 0, high, rng.uniform(0.05, 0.14), str(rng.choice(wood)))
    if rng.random() < 0.7:
        b.box(0.4, 0, high, (0.5, 0.08, 0.05), str(rng.choice(wood)))


def bush(b: Builder, rng: np.random.Generator, leaves: Sequence[str]) -> None:
    """A few ellipsoids of leaves."""
    size = rng.uniform(0.4, 1.2)
    for _ in range(int(rng.integers(2, 5))):
        x, y = rng.normal(scale=0.5 * size, size=2)
        half = size * rng.uniform(0.5, 1.0, 3)
        b.blob(x, y, 0.7 * half[2], (half[0], half[1], half[2]), str(rng.choice(leaves)))


def tree(b: Builder, rng: np.random.Generator, leaves: Sequence[str], wood: Sequence[str]) -> None:
    """A trunk and a crown."""
    trunk, crown = rng.uniform(1.5, 3.5), rng.uniform(1.2, 3.0)
    b.column(0, 0, 0, trunk + crown, rng.uniform(0.1, 0.25), str(rng.choice(wood)))
    for _ in range(4):
        x, y, z = rng.normal(scale=0.35 * crown, size=3)
        half = crown * rng.uniform(0.5, 0.9, 3)
        b.blob(x, y, trunk + crown + z, (half[0], half[1], half[2]), str(rng.choice(leaves)))


def car(b: Builder, rng: np.random.Generator, paints: Sequence[str], dark: str) -> None:
    """A parked car, its nose along x."""
    length, wide, body = rng.uniform(1.9, 2.4), rng.uniform(0.82, 0.92), str(rng.choice(paints))
    low, waist, roof = 0.25, rng.uniform(0.85, 0.95), rng.uniform(1.4, 1.75)
    b.box(0, 0, 0.5 * (low + waist), (length, wide, 0.5 * (waist - low)), body)
    b.box(-0.2, 0, 0.5 * (waist + roof) - 0.04, (0.55 * length, 0.9 * wide, 0.5 * (roof - waist) - 0.04), dark)
    b.box(-0.2, 0, roof - 0.03, (0.5 * length, 0.88 * wide, 0.04), body)
    turn = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    for x in (-0.62, 0.62):
        for y in (-1, 1):
            b.add(mujoco.mjtGeom.mjGEOM_CYLINDER, (x * length, y * wide, 0.32), (0.32, 0.1, 0.0), dark, turn)


def building(b: Builder, front: str, roof: str, half: tuple[float, float], high: float) -> None:
    """A block with its front on all four sides, and a flat roof."""
    b.floor(0, 0, high, half, roof)
    for facing, depth, wide in ((0.0, half[0], half[1]), (np.pi, half[0], half[1])):
        b.wall(depth * np.cos(facing), 0, 0, facing, (wide, 0.5 * high), front)
    for facing in (0.5 * np.pi, -0.5 * np.pi):
        b.wall(0, half[1] * np.sin(facing), 0, facing, (half[0], 0.5 * high), front)
