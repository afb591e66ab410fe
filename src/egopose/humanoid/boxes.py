"""Boxes a body may stand on: placed in each world by their pose alone, and sensors of what touches them.

A box is a mocap body: it never moves by itself and has no degrees of freedom, so qpos, qvel and the controls mean the
same with boxes as without. It is :data:`DEPTH` high and reaches through the floor, which it does not collide with:
moving it up or down sets the height of its upper face. Sizes belong to the model. They must not be set for each world:
MuJoCo keeps bounding volumes beside a geom's size, and bodies then fall through boxes in silence.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

#: m from a box's lower to its upper face; no upper face can be higher above the floor.
DEPTH = 3.0
#: m below the floor of a parked box's upper face.
PARKED = 10.0
_CONTACT = ("contype", "conaffinity", "condim", "friction", "solref", "solimp", "margin", "gap", "class")


def with_boxes(
    humanoid: HumanoidModel, sizes: Sequence[Sequence[float]] | Array, touching: Sequence[str] | None = None
) -> HumanoidModel:
    """The same body in worlds of K boxes, all parked, and with contact sensors for ``BatchedPhysics(contacts=True)``.

    Boxes have the floor's contact settings: its friction, MuJoCo's default ``solref`` and ``solimp``, no margin. They
    collide with the body's geoms and neither with the floor nor with each other.

    Args:
        humanoid: without boxes or sensors.
        sizes: ``[K, 2]`` m, the upper faces' lengths along each box's own x and y. An empty list adds sensors alone.
        touching: E names of the bodies whose contacts are told; None for the end effectors (feet, hands, head).

    Raises:
        ValueError: a size that is not positive, a body that is not there, or a humanoid that has boxes or sensors.
    """
    faces = np.asarray(sizes, dtype=np.float64).reshape(-1, 2) if len(sizes) else np.zeros((0, 2))
    if not (np.isfinite(faces).all() and (faces > 0).all()):
        raise ValueError(f"boxes must have positive sizes, got {faces.tolist()}")
    names = [humanoid.skeleton.names[i] for i in humanoid.end_effectors] if touching is None else list(touching)
    if unknown := set(names) - set(humanoid.skeleton.names):
        raise ValueError(f"no such bodies: {', '.join(sorted(unknown))}")
    if humanoid.mj_model.nmocap or humanoid.mj_model.nsensor:
        raise ValueError("the humanoid already has boxes or sensors")
    root = ET.fromstring(humanoid.xml)
    world = root.find("worldbody")
    assert world is not None
    # In the floor's own words, so that the body meets a box as it meets the floor.
    floor = next(geom for geom in world.iter("geom") if geom.get("type") == "plane")
    contact = {key: value for key, value in floor.items() if key in _CONTACT}
    for k, (length, width) in enumerate(faces.tolist()):
        place = f"0 0 {-PARKED - DEPTH / 2!r}"
        body = ET.SubElement(world, "body", name=f"box{k}", mocap="true", pos=place, quat="1 0 0 0")
        size = f"{length / 2!r} {width / 2!r} {DEPTH / 2!r}"
        ET.SubElement(body, "geom", contact, name=f"box{k}", type="box", size=size, rgba="0.72 0.58 0.42 1")
    sensors = ET.SubElement(root, "sensor")
    for name in names:
        ET.SubElement(sensors, "contact", body1=name, geom2=floor.get("name", ""), data="found", num="1")
        for k in range(len(faces)):
            ET.SubElement(sensors, "contact", body1=name, body2=f"box{k}", data="found", num="1")
    xml = ET.tostring(root, encoding="unicode")
    return replace(
        humanoid,
        xml=xml,
        mj_model=mujoco.MjModel.from_xml_string(xml),
        box_sizes=faces,
        touching=np.array([humanoid.skeleton.index(name) for name in names]),
    )


class Boxes:
    """The boxes of a compiled model.

    Args:
        model: whose mocap bodies each have one box geom.

    Raises:
        ValueError: a mocap body of another shape.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        bodies = np.argsort(model.body_mocapid, kind="stable")[model.nbody - model.nmocap :]
        geoms = model.body_geomadr[bodies]
        if (model.body_geomnum[bodies] != 1).any() or (model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_BOX).any():
            raise ValueError("a mocap body must have one box geom")
        #: ``[K]`` body ids.
        self.bodies = bodies
        self._half = model.geom_size[geoms, 2]
        self._parked = model.body_pos[bodies]

    def __len__(self) -> int:
        return len(self.bodies)

    def poses(self, top: Array, heading: Array, used: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
        """Mocap positions ``[n, K, 3]`` m and quaternions ``[n, K, 4]``.

        Args:
            top: ``[n, K, 3]`` m, the centres of the upper faces in the world.
            heading: ``[n, K]`` rad about the vertical.
            used: ``[n, K]``; the others are parked, whatever their place. None for all.

        Raises:
            ValueError: another shape, or a used box whose place is not finite, whose upper face is below the floor, or
                so high that the box would leave it.
        """
        top, heading = np.asarray(top, dtype=np.float64), np.asarray(heading, dtype=np.float64)
        used = np.ones(heading.shape, dtype=bool) if used is None else np.asarray(used, dtype=bool)
        shape = (len(top), len(self))
        if (top.shape, heading.shape, used.shape) != ((*shape, 3), shape, shape):
            raise ValueError(f"places of {len(self)} boxes are [n, {len(self)}, 3] and headings [n, {len(self)}]")
        if not (np.isfinite(top[used]).all() and np.isfinite(heading[used]).all()):
            raise ValueError("a box cannot be placed where its place or heading is not finite")
        height = 2.0 * np.broadcast_to(self._half, shape)
        if ((top[..., 2] < 0) | (top[..., 2] > height))[used].any():
            raise ValueError("a box's upper face must be between the floor and the box's own height above it")
        where = np.where(used[..., None], top, 0.0)
        where[..., 2] -= self._half
        turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.where(used, heading, 0.0))
        return np.where(used[..., None], where, self._parked), turn

    def tops(self, position: Array) -> Array:
        """``[n, K, 3]`` m, centres of the upper faces of boxes at mocap positions ``[n, K, 3]``."""
        return position + np.stack([0 * self._half, 0 * self._half, self._half], axis=-1)
