"""Hands that hold on to a box or the floor, by a scene's contacts, and where they hold.

They move no box: in a vault's poses hands are a decimetre off, further than a guess of the box's height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.scene_file import FLOOR, Scene
from egopose.scene.standing import in_box_axes

#: Of an end effector in a scene file, right and left, and the humanoid's joint.
HANDS = {"right_hand": "RightHand", "left_hand": "LeftHand"}
_INSIDE = 0.03  # m from a box's edge that a hand holds at least


@dataclass(frozen=True)
class Handhold:
    """A hand that holds on: ``hand`` 0 is the right one, frames ``start`` to ``stop``, ``box`` -1 is the floor."""

    hand: int
    start: int
    stop: int
    box: int


def handholds(scene: Scene) -> tuple[Handhold, ...]:
    """Of the scene's contacts of hands."""
    names, order = [box.name for box in scene.boxes], list(HANDS)
    return tuple(
        Handhold(
            order.index(contact.effector),
            contact.first,
            contact.last + 1,
            -1 if contact.touches == FLOOR else names.index(contact.touches),
        )
        for contact in scene.contacts
        if contact.effector in HANDS
    )


@dataclass(frozen=True)
class Hands:
    """The middles of both hands.

    Args:
        joints: ``[2]`` right and left.
        offsets: ``[2, 3]`` m in the joints' frames.
        radius: m, of a hand.
    """

    joints: NDArray[np.intp]
    offsets: Array
    radius: float

    def points(self, motion: Motion) -> Array:
        """``[T, 2, 3]`` m, right and left."""
        positions, quats = motion.forward_kinematics()
        return positions[:, self.joints] + rot.rotate(quats[:, self.joints], self.offsets)


def hands_of(humanoid: HumanoidModel) -> Hands:
    """The hands of a humanoid, whose shapes are capsules."""
    model, names = humanoid.mj_model, humanoid.skeleton.names
    geoms = [int(model.body_geomadr[model.body(name).id]) for name in HANDS.values()]
    joints = np.array([names.index(name) for name in HANDS.values()])
    return Hands(joints, model.geom_pos[geoms].copy(), float(model.geom_size[geoms[0], 0]))


def held_places(
    holds: Sequence[Handhold], points: Array, radius: float, tops: Array, headings: Array, sizes: Array
) -> Array:
    """``[H, 3]`` m: where each hand's middle holds: on the box's upper face, as near as can be to where it was.

    Args:
        holds: H.
        points: ``[T, 2, 3]`` m of the motion's hands.
        radius: m, of a hand.
        tops, headings, sizes: of the boxes, ``[K, 3]`` m, ``[K]`` rad, ``[K, 2]`` m.
    """
    out = np.array([points[hold.start : hold.stop, hold.hand].mean(axis=0) for hold in holds]).reshape(-1, 3)
    for place, hold in zip(out, holds, strict=True):
        if hold.box < 0:
            place[2] = radius
            continue
        place[:2] += _onto(place[:2], hold.box, tops, headings, sizes)
        place[2] = tops[hold.box, 2] + radius
    return out


def _onto(place: Array, box: int, tops: Array, headings: Array, sizes: Array) -> Array:
    """``[2]`` m from ``place [2]`` to the nearest point of the box's upper face, its edge left out."""
    along, across = in_box_axes(place - tops[box, :2], headings[box])
    room = np.maximum(0.5 * sizes[box] - _INSIDE, 0.0)
    back = np.clip(along, -room[0], room[0]) - along
    side = np.clip(across, -room[1], room[1]) - across
    cos, sin = np.cos(headings[box]), np.sin(headings[box])
    return np.array([cos * back - sin * side, sin * back + cos * side])
