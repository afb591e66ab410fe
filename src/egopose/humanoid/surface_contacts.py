"""Which body meets which surface in MuJoCo's list of contacts; surfaces are the floor, then the scene's boxes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from egopose.humanoid.boxes import Boxes
from egopose.humanoid.model import HumanoidModel
from egopose.motion.rotations import Array


class Met(NamedTuple):
    """One contact point.

    Attributes:
        number: in ``data.contact``.
        body: index among the skeleton's bodies.
        surface: 0 for the floor, 1 + k for box k.
        sign: 1 where MuJoCo's force is the one on the body, -1 where it is the one on the surface.
        place: ``[3]`` m, world.
        axes: ``[3, 3]`` rows: the contact's normal and two tangents, as MuJoCo has them.
        depth: m that they reach into each other.
    """

    number: int
    body: int
    surface: int
    sign: float
    place: Array
    axes: Array
    depth: float


class Surfaces:
    """The floor and the boxes of a humanoid's world.

    Args:
        humanoid: with boxes or without.
    """

    def __init__(self, humanoid: HumanoidModel) -> None:
        self._model = model = humanoid.mj_model
        self._boxes = Boxes(model)
        self._body = np.full(model.nbody, -1)
        self._body[humanoid.body_ids] = np.arange(len(humanoid.body_ids))
        self.shape = len(humanoid.body_ids), 1 + len(self._boxes)

    def place(self, data: mujoco.MjData, tops: Array, headings: Array) -> None:
        """Put the boxes: ``tops [K, 3]`` m, centres of the upper faces, and ``headings [K]`` rad.

        Raises:
            ValueError: another number of boxes, or a place where none can be.
        """
        positions, quaternions = self._boxes.poses(tops[None], headings[None])
        rows = self._model.body_mocapid[self._boxes.bodies]
        data.mocap_pos[rows], data.mocap_quat[rows] = positions[0], quaternions[0]

    def met(self, data: mujoco.MjData) -> Iterator[Met]:
        """Contacts between the body and a surface."""
        model = self._model
        for number, contact in enumerate(data.contact[: data.ncon]):
            first, second = (int(model.geom_bodyid[geom]) for geom in contact.geom)
            # MuJoCo's force acts on the second geom's body.
            mine, other, sign = (second, first, 1.0) if self._body[second] >= 0 else (first, second, -1.0)
            surface = 1 + int(model.body_mocapid[other])
            axes = contact.frame.reshape(3, 3)
            yield Met(number, int(self._body[mine]), surface, sign, contact.pos, axes, -float(contact.dist))


def depths(humanoid: HumanoidModel, qpos: Array, tops: Array, headings: Array) -> Array:
    """``[T, B, 1 + K]`` m that each body reaches into each surface in poses ``qpos [T, nq]``; NaN where it does not.

    Args:
        humanoid: in a world with K boxes.
        qpos: of any motion, simulated or not.
        tops: ``[K, 3]`` m, centres of the boxes' upper faces.
        headings: ``[K]`` rad.

    Raises:
        ValueError: see :meth:`Surfaces.place`.
    """
    surfaces, data = Surfaces(humanoid), mujoco.MjData(humanoid.mj_model)
    surfaces.place(data, tops, headings)
    out = np.full((len(qpos), *surfaces.shape), np.nan)
    for t, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(humanoid.mj_model, data)
        mujoco.mj_comPos(humanoid.mj_model, data)
        mujoco.mj_collision(humanoid.mj_model, data)
        for met in surfaces.met(data):
            out[t, met.body, met.surface] = np.fmax(out[t, met.body, met.surface], met.depth)
    return out
