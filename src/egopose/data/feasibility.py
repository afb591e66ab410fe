"""Can the floor have made this motion? What a clip's own inverse dynamics says, before any controller is asked.

A clip of mocap on a humanoid of other mass and proportions need not obey physics: a leap whose centre of mass falls at
16 m/s^2, a spin about a foot that does not touch. No control whatever follows such frames on a bare floor.
"""

from __future__ import annotations

import mujoco
import numpy as np
import scipy

from egopose.humanoid.model import HumanoidModel
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array

#: Points of the body this close to the floor (m) may be pushed by it: settled soles rest 4 mm in it.
_TOUCH = 0.02
#: Moments are weighed against forces by this lever (m), about half the distance between two feet.
_LEVER = 0.3


def contact_residual(humanoid: HumanoidModel, clip: Motion) -> Array:
    """What contact with the floor cannot supply of the force and moment a motion needs, in body weights ``[T]``.

    Newton and Euler ask for a wrench on the body's root in every frame (inverse dynamics of the whole body,
    accelerations by central differences); the floor gives forces within its friction pyramid at the corners of the
    soles and at the ends of limbs that lie within 2 cm of it, and nothing in the air. The residual is the norm of the
    difference under the best such forces (non-negative least squares), moments divided by 0.3 m. 0: the floor can do
    it; 1: a force as large as the weight is missing.

    Args:
        humanoid: whose masses and shapes are used.
        clip: on its skeleton.

    The first and the last frame repeat their neighbours.
    """
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    for flag in ("CONTACT", "LIMIT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    data = mujoco.MjData(model)
    velocity = finite_difference(clip.qpos, clip.fps)
    weight = float(model.body_mass.sum()) * -float(model.opt.gravity[2])
    friction = float(model.geom_friction[1:, 0].max())
    pyramid = np.array([[friction, 0, 1], [-friction, 0, 1], [0, friction, 1], [0, -friction, 1]])
    out = np.zeros(len(clip))
    for t in range(1, len(clip) - 1):
        data.qpos[:] = clip.qpos[t]
        data.qvel[:] = 0.5 * (velocity[t] + velocity[t - 1])
        data.qacc[:] = (velocity[t] - velocity[t - 1]) * clip.fps
        mujoco.mj_inverse(model, data)
        root = data.xmat[humanoid.body_ids[0]].reshape(3, 3)
        force, moment = data.qfrc_inverse[:3], root @ data.qfrc_inverse[3:6]
        needed = np.concatenate([force, moment / _LEVER]) / weight
        points = _touching(model, data)
        if not len(points):
            out[t] = np.linalg.norm(needed)
            continue
        arms = np.repeat(points - data.qpos[:3], len(pyramid), axis=0)
        forces = np.tile(pyramid, (len(points), 1))
        supply = np.concatenate([forces, np.cross(arms, forces) / _LEVER], axis=1)
        out[t] = scipy.optimize.nnls(supply.T, needed)[1]
    if len(out) > 2:
        out[0], out[-1] = out[1], out[-2]
    return out


def _touching(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """``[P, 3]`` m: corners of boxes and lowest points of capsules' ends near the floor."""
    points = []
    for geom in range(model.ngeom):
        centre, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        kind = model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
            points.append(centre + (signs * size) @ turn.T)
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            points.append(centre + np.outer([-1, 1], turn[:, 2]) * size[1] - [0, 0, size[0]])
    stacked = np.concatenate(points)
    return stacked[stacked[:, 2] < _TOUCH]
