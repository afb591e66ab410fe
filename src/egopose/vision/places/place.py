"""What a place is: something drawn from a seed around a wearer's way, that then furnishes a MjSpec."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array, from_axis_angle
from egopose.vision.surfaces import add_cube_material, add_geom, add_material, add_texture

_UP = np.array([0.0, 0.0, 1.0])
# The body's reach above its root, m.
_REACH = 1.2


@dataclass(frozen=True, eq=False)
class Way:
    """What a place must leave free.

    Args:
        path: ``[T, 2]`` m, over the floor.
        heading: ``[T]`` rad about the vertical, where the wearer faces.
        top: m, the height that must stay free.
    """

    path: Array
    heading: Array
    top: float

    @staticmethod
    def of(qpos: Array) -> Way:
        """The way of a motion ``[T, nq]`` whose root is a free joint that faces along its own x axis."""
        w, x, y, z = qpos[:, 3:7].T
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return Way(qpos[:, :2], heading, float(qpos[:, 2].max()) + _REACH)

    def distance(self, point: Array) -> float:
        """m from the nearest point of the path."""
        return float(np.linalg.norm(self.path - point, axis=1).min())


class Place(Protocol):
    """A drawn place. ``far`` is how far one sees in it, m; ``low`` and ``high`` (x, y; m) are where people may walk."""

    @property
    def far(self) -> float: ...

    @property
    def low(self) -> tuple[float, float]: ...

    @property
    def high(self) -> tuple[float, float]: ...

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Put the place's surfaces, things and lights into a spec, in place."""
        ...


class Builder:
    """Puts shapes into a spec, in a frame of their own on the floor: ``yaw`` rad about the vertical through ``origin``.

    Args:
        spec: that is furnished.
        name: first part of the names of what is added.
        origin: ``(x, y)`` or ``(x, y, z)``, m.
        yaw: rad.
    """

    def __init__(
        self, spec: mujoco.MjSpec, name: str, origin: tuple[float, ...] = (0.0, 0.0), yaw: float = 0.0
    ) -> None:
        self.spec, self.name, self.yaw = spec, name, yaw
        self.origin = np.array([*origin, 0.0][:3])

    def at(self, x: float, y: float, yaw: float = 0.0) -> Builder:
        """A frame within this one."""
        place = self._place((x, y, 0.0))
        return Builder(self.spec, self.name, (float(place[0]), float(place[1]), float(place[2])), self.yaw + yaw)

    def _place(self, position: tuple[float, float, float]) -> Array:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y, z = position
        return self.origin + np.array([c * x - s * y, s * x + c * y, z])

    def add(
        self,
        shape: mujoco.mjtGeom,
        position: tuple[float, float, float],
        size: tuple[float, ...],
        material: str,
        turn: Array | None = None,
    ) -> None:
        """A shape with MuJoCo's ``size``; ``turn`` is a quaternion within this frame."""
        about = from_axis_angle(_UP, np.array(self.yaw))
        quaternion = np.empty(4)
        mujoco.mju_mulQuat(quaternion, about, np.array([1.0, 0, 0, 0]) if turn is None else turn)
        name = f"{self.name}_{len(self.spec.geoms)}"
        add_geom(self.spec, name, shape, list(size), list(self._place(position)), quaternion, material)

    def box(self, x: float, y: float, z: float, half: tuple[float, float, float], material: str) -> None:
        """A box about a centre."""
        self.add(mujoco.mjtGeom.mjGEOM_BOX, (x, y, z), half, material)

    def column(self, x: float, y: float, low: float, high: float, radius: float, material: str) -> None:
        """An upright cylinder from one height to another."""
        size = (radius, 0.5 * (high - low), 0.0)
        self.add(mujoco.mjtGeom.mjGEOM_CYLINDER, (x, y, 0.5 * (low + high)), size, material)

    def blob(self, x: float, y: float, z: float, half: tuple[float, float, float], material: str) -> None:
        """An ellipsoid about a centre."""
        self.add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, (x, y, z), half, material)

    def floor(self, x: float, y: float, z: float, half: tuple[float, float], material: str) -> None:
        """A level rectangle, seen from above."""
        self.add(mujoco.mjtGeom.mjGEOM_PLANE, (x, y, z), (*half, 1.0), material)

    def wall(self, x: float, y: float, low: float, facing: float, half: tuple[float, float], material: str) -> None:
        """An upright rectangle, half its width and height, seen from where it faces: rad, in this frame."""
        # A plane shows its +z side with the picture's rows along -y: z comes to lie along x, y upward.
        upright = np.array([0.5, 0.5, 0.5, 0.5])
        turn = np.empty(4)
        mujoco.mju_mulQuat(turn, from_axis_angle(_UP, np.array(facing)), upright)
        self.add(mujoco.mjtGeom.mjGEOM_PLANE, (x, y, low + half[1]), (*half, 1.0), material, turn)


def paint(spec: mujoco.MjSpec, name: str, picture: NDArray[np.uint8], repeat: tuple[float, float] = (1.0, 1.0)) -> str:
    """A material of that name for floors and walls, from a picture ``[H, W, 3]``; returns the name."""
    add_texture(spec, name, mujoco.mjtTexture.mjTEXTURE_2D, picture)
    add_material(spec, name, repeat)
    return name


def wrap(spec: mujoco.MjSpec, name: str, picture: NDArray[np.uint8]) -> str:
    """A material of that name for solid shapes, with the picture ``[N, N, 3]`` on each side; returns the name."""
    add_texture(spec, name, mujoco.mjtTexture.mjTEXTURE_CUBE, np.concatenate([picture] * 6))
    add_material(spec, name, (1.0, 1.0))
    return name


def pattern_materials(
    spec: mujoco.MjSpec,
    name: str,
    rng: np.random.Generator,
    count: int,
    contrast: tuple[float, float],
    base: tuple[float, float],
) -> list[str]:
    """Names of ``count`` materials of random patterns for solid shapes."""
    names = [f"{name}{i}" for i in range(count)]
    for each in names:
        add_cube_material(spec, each, rng, 128, contrast, base)
    return names


def clear(spec: mujoco.MjSpec) -> None:
    """Take the spec's own floor and lamps away."""
    for thing in [*spec.worldbody.geoms, *spec.worldbody.lights]:
        spec.delete(thing)
