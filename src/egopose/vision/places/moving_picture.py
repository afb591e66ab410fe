"""A window before the wearer through which the world goes by, as in a vehicle, or a large screen with a moving film."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.motion.rotations import Array, from_axis_angle, multiply
from egopose.vision.places.pictures import front_picture
from egopose.vision.places.place import Builder, Way, paint, pattern_materials
from egopose.vision.surfaces import ROOM_BASE, add_lights, random_pattern

# m: from the wearer to the window, its half width and its edges' heights, and from it to what goes by.
_AHEAD, _HALF, _SILL, _LINTEL, _BEHIND = 0.9, 1.5, 0.35, 2.4, 1.2
# m of what goes by that one picture of it covers, and its height.
_COVERED, _HEIGHT = 8.0, 7.0
_BODY = "picture"


@dataclass(frozen=True, eq=False)
class MovingPicture:
    """A window at ``place`` (m) that the wearer faces along ``heading`` (rad); the world behind moves left, m/s.

    ``length`` is half that of what goes by, m.
    """

    place: tuple[float, float]
    heading: float
    speed: float
    length: float
    seed: int
    far: float = 60.0

    @property
    def low(self) -> tuple[float, float]:
        """No one walks here."""
        return self.place

    @property
    def high(self) -> tuple[float, float]:
        """No one walks here."""
        return self.place

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """The window, its frame, the floor, and what goes by."""
        rng = np.random.default_rng([self.seed, 1])
        b = Builder(spec, "cabin", self.place, self.heading)
        panels = pattern_materials(spec, "cabin_panel", rng, 2, (8.0, 20.0), ROOM_BASE)
        floor = paint(spec, "cabin_floor", random_pattern(rng, 256, (15.0, 30.0), ROOM_BASE), (4.0, 4.0))
        b.floor(-3.0, 0.0, 0.0, (3.0, 6.0), floor)
        b.box(0.05, 0, 0.5 * _SILL, (0.05, 6.0, 0.5 * _SILL), panels[0])
        b.box(0.05, 0, 0.5 * (_LINTEL + 3.5), (0.05, 6.0, 0.5 * (3.5 - _LINTEL)), panels[0])
        for side in (-1, 1):
            b.box(0.05, side * (_HALF + 3.0), 1.75, (0.05, 3.0, 1.75), panels[1])
        repeat = 2 * self.length / _COVERED
        shown = paint(spec, "cabin_view", front_picture(rng, _COVERED, _HEIGHT, 0.015), (repeat, 1.0))
        body = spec.worldbody.add_body(name=_BODY, mocap=True)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[self.length, 0.5 * _HEIGHT, 1.0],
            material=shown,
            contype=0,
            conaffinity=0,
        )
        add_lights(spec, rng)

    def move(self, model: mujoco.MjModel, data: mujoco.MjData, time: float) -> None:
        """Put what goes by where it is at a time (s)."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        left = np.array([-ahead[1], ahead[0], 0.0])
        at = np.array([*self.place, 0.25 * _HEIGHT]) + _BEHIND * ahead
        # It starts with its left half before the window and ends with the right one.
        at = at + (self.speed * time - 0.9 * self.length + 2 * _HALF) * left
        mocap = int(model.body(_BODY).mocapid[0])
        data.mocap_pos[mocap] = at
        upright = np.array([0.5, 0.5, 0.5, 0.5])
        facing = from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(self.heading + np.pi))
        data.mocap_quat[mocap] = multiply(facing, upright)


def draw_moving_picture(seed: int, way: Way, duration: float) -> MovingPicture:
    """A window before the first pose of a wearer who stands, for so many seconds of film."""
    rng = np.random.default_rng([seed, 0])
    heading = float(way.heading[0])
    place: Array = way.path[0] + _AHEAD * np.array([np.cos(heading), np.sin(heading)])
    speed = float(rng.uniform(1.0, 5.0))
    length = speed * duration + 12.0
    return MovingPicture((float(place[0]), float(place[1])), heading, speed, length, seed)
