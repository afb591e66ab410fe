"""People who pass: figures of capsules that walk to and fro along straight lines beside the wearer's way.

Their parts are MuJoCo's mocap bodies, so that a model with people has the coordinates it had without.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.motion.rotations import Array, from_axis_angle, multiply
from egopose.vision.places.place import Place, Way, pattern_materials
from egopose.vision.surfaces import CLOTH_BASE, CLOTH_CONTRAST

_PARTS = ("trunk", "left_leg", "right_leg", "left_arm", "right_arm")
# Nearest that anyone comes to the wearer, m; metres of a line at most.
_APART, _LONGEST = 0.9, 12.0
# Hips, shoulders and their half breadths, of an adult 1.75 m tall, m; the swing of legs and arms, rad; m a cycle.
_HIP, _SHOULDER, _HIP_Y, _SHOULDER_Y, _SWING, _STRIDE = 0.92, 1.42, 0.09, 0.22, 0.45, 1.4


@dataclass(frozen=True, eq=False)
class Passer:
    """One who walks from ``start`` along ``bearing`` (rad) for ``length`` m and back, at ``speed`` m/s.

    ``phase`` is the m already walked at time 0; ``scale`` the height over an adult's of 1.75 m.
    """

    start: tuple[float, float]
    bearing: float
    length: float
    speed: float
    phase: float
    scale: float

    def at(self, time: float) -> tuple[Array, float, float]:
        """Place ``[2]`` m, heading and the phase of the step (rad) at a time (s)."""
        walked = self.phase + self.speed * time
        lap = walked % (2 * self.length)
        back = lap > self.length
        along = 2 * self.length - lap if back else lap
        place = np.array(self.start) + along * np.array([np.cos(self.bearing), np.sin(self.bearing)])
        return place, self.bearing + (np.pi if back else 0.0), 2 * np.pi * walked / (_STRIDE * self.scale)


def draw_passers(rng: np.random.Generator, way: Way, place: Place, count: int) -> tuple[Passer, ...]:
    """Up to ``count`` people who walk within the place at 1 to 1.5 m/s, and never through the wearer's way."""
    low, high = np.array(place.low) + 0.4, np.array(place.high) - 0.4
    found: list[Passer] = []
    for _ in range(20 * count):
        if len(found) == count:
            break
        ends = rng.uniform(low, high, (2, 2))
        step = ends[1] - ends[0]
        length = min(float(np.linalg.norm(step)), _LONGEST)
        bearing = float(np.arctan2(step[1], step[0]))
        direction = np.array([np.cos(bearing), np.sin(bearing)])
        line = ends[0] + np.linspace(0.0, length, 25)[:, None] * direction
        if length > 2.0 and min(way.distance(point) for point in line) > _APART:
            speed, phase, scale = rng.uniform(1.0, 1.5), rng.uniform(0, 2 * length), rng.uniform(0.88, 1.08)
            found.append(Passer((float(ends[0, 0]), float(ends[0, 1])), bearing, length, speed, phase, scale))
    return tuple(found)


def add_people(spec: mujoco.MjSpec, rng: np.random.Generator, passers: tuple[Passer, ...]) -> None:
    """Put the figures into a spec."""
    if not passers:
        return
    clothes = pattern_materials(spec, "person_cloth", rng, 4, CLOTH_CONTRAST, CLOTH_BASE)
    for i, passer in enumerate(passers):
        shirt, trousers, skin = (str(c) for c in rng.choice(clothes, 3))
        s = passer.scale
        shapes: dict[str, list[tuple[tuple[float, ...], float, str]]] = {
            "trunk": [((0, 0, _HIP, 0, 0, _SHOULDER - 0.1), 0.15, shirt), ((0, 0, 1.58, 0, 0, 1.66), 0.1, skin)],
            "leg": [((0, 0, 0, 0, 0, -0.42), 0.075, trousers), ((0, 0, -0.42, 0.02, 0, -0.85), 0.055, trousers)],
            "arm": [((0, 0, 0, 0, 0, -0.28), 0.05, shirt), ((0, 0, -0.28, 0.06, 0, -0.6), 0.04, skin)],
        }
        for part in _PARTS:
            body = spec.worldbody.add_body(name=f"person{i}_{part}", mocap=True)
            for ends, radius, cloth in shapes[part.split("_")[-1]]:
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                    fromto=[s * value for value in ends],
                    size=[s * radius, 0, 0],
                    material=cloth,
                    contype=0,
                    conaffinity=0,
                )


def place_people(model: mujoco.MjModel, data: mujoco.MjData, passers: tuple[Passer, ...], time: float) -> None:
    """Move the figures of :func:`add_people` to where they are at a time (s)."""
    for i, passer in enumerate(passers):
        place, heading, phase = passer.at(time)
        turn = from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(heading))
        left = np.array([-np.sin(heading), np.cos(heading)])
        swing = _SWING * np.sin(phase)
        s = passer.scale
        joints = {
            "trunk": (0.0, 0.0, 0.0),
            "left_leg": (_HIP, _HIP_Y, swing),
            "right_leg": (_HIP, -_HIP_Y, -swing),
            "left_arm": (_SHOULDER, _SHOULDER_Y, -swing),
            "right_arm": (_SHOULDER, -_SHOULDER_Y, swing),
        }
        for part, (high, aside, angle) in joints.items():
            mocap = int(model.body(f"person{i}_{part}").mocapid[0])
            data.mocap_pos[mocap] = [*(place + s * aside * left), s * high]
            pitch = from_axis_angle(np.array([0.0, 1.0, 0.0]), np.array(angle))
            data.mocap_quat[mocap] = multiply(turn, pitch)
