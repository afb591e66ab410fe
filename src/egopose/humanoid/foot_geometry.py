"""Where a humanoid's soles and lowest points are, and a body placed so that they are not in the floor."""

from __future__ import annotations

from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def sole_positions(humanoid: HumanoidModel, motion: Motion) -> Array:
    """``[T, feet * 2, 3]`` world positions (m) of every foot's heel and ball, in this order."""
    positions, quats = motion.forward_kinematics()
    points = [
        positions[:, foot] + rot.rotate(quats[:, foot], point[None])
        for foot, sole in zip(humanoid.feet, humanoid.sole_points, strict=True)
        for point in sole
    ]
    return np.stack(points, axis=1)


def sole_edges(humanoid: HumanoidModel, motion: Motion) -> Array:
    """``[T, feet * 4, 3]`` world positions (m) of the corners of every foot's sole."""
    return _foot_corners(humanoid, motion, (-1,))


def _foot_corners(humanoid: HumanoidModel, motion: Motion, sides: tuple[int, ...]) -> Array:
    """``[T, feet * 4 * sides, 3]`` m: corners of every foot's box, of its underside (-1) and upper side (1)."""
    positions, quats = motion.forward_kinematics()
    joints, offsets = _corners_in_feet(humanoid, sides)
    turned = [rot.rotate(quats[:, foot], offset[None]) for foot, offset in zip(joints, offsets, strict=True)]
    return positions[:, joints] + np.stack(turned, axis=1)


def sole_corners(humanoid: HumanoidModel) -> tuple[NDArray[np.intp], Array]:
    """Feet ``[feet * 4]`` of the points of :func:`sole_edges`, and their places ``[feet * 4, 3]`` m in its frame.

    Of each foot the heel's two corners come first.
    """
    return _corners_in_feet(humanoid, (-1,))


def _corners_in_feet(humanoid: HumanoidModel, sides: tuple[int, ...]) -> tuple[NDArray[np.intp], Array]:
    joints, points = [], []
    for foot in humanoid.feet:
        geom = int(humanoid.mj_model.body_geomadr[humanoid.body_ids[foot]])
        centre, half = humanoid.mj_model.geom_pos[geom], humanoid.mj_model.geom_size[geom]
        for x, y, z in product((-1, 1), (-1, 1), sides):
            joints.append(foot)
            points.append(centre + half * [x, y, z])
    return np.array(joints), np.array(points)


def lowest_points(humanoid: HumanoidModel, motion: Motion) -> Array:
    """``[T]`` m: height of the body's lowest point but the feet's: hands, knees, back or head may carry it."""
    model = humanoid.mj_model
    positions, quats = motion.forward_kinematics()
    out = np.full(len(motion), np.inf)
    for joint, body in enumerate(humanoid.body_ids):
        if joint in humanoid.feet:
            continue
        for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
            centre = positions[:, joint] + rot.rotate(quats[:, joint], model.geom_pos[geom][None])
            turn = rot.multiply(quats[:, joint], model.geom_quat[geom][None])
            # What of each of the shape's own axes points up, [T, 3].
            vertical = rot.to_matrix(turn)[:, 2]
            size, kind = model.geom_size[geom], model.geom_type[geom]
            if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
                reach = size[0] + size[1] * np.abs(vertical[:, 2])
            elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                reach = np.linalg.norm(size * vertical, axis=1)
            elif kind == mujoco.mjtGeom.mjGEOM_BOX:
                reach = np.abs(vertical) @ size
            else:  # a sphere
                reach = np.full(len(motion), size[0])
            out = np.minimum(out, centre[:, 2] - reach)
    return out


def sole_names(humanoid: HumanoidModel) -> tuple[str, ...]:
    """Names of the points of :func:`sole_positions`."""
    return tuple(f"{humanoid.skeleton.names[f]}_{end}" for f in humanoid.feet for end in ("heel", "ball"))


def out_of_floor(humanoid: HumanoidModel, qpos: Array) -> Array:
    """``qpos [N, nq]`` raised, where it has to be, until no corner of a foot is under the floor (z = 0).

    A state that was regressed has its root's height and its joints from different numbers, and stands up to 5 cm deep:
    physics would throw the body out.
    """
    corners = _foot_corners(humanoid, Motion(humanoid.skeleton, qpos, 1.0 / humanoid.control_dt), (-1, 1))
    out = qpos.copy()
    out[:, 2] += np.maximum(0.0, -corners[..., 2].min(axis=1))
    return out
