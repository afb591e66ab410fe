"""Joint torques and forces of the ground that a motion needs: inverse dynamics of a simulated humanoid.

Newton and Euler ask for a wrench on the whole body in every frame (accelerations by central differences). The floor
gives it by forces within its friction pyramid at the points of the body that lie near it; of all such forces the
evenest that come nearest to the wrench are taken (non-negative least squares), and the joints' torques follow from
them. What the floor cannot give is reported, not spread: it tells how far the motion is from physics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import scipy
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class ForceSettings:
    """See ``conf/export.yaml``.

    Args:
        cutoff_hz: of the zero-lag low-pass before differentiation; None for none.
        touch: points of the body up to this high (m) may be pushed by the floor.
        lever: m by which moments are weighed against forces.
        evenness: weight of equal shares against the wrench, per body weight.
    """

    cutoff_hz: float | None
    touch: float
    lever: float
    evenness: float


def with_forces(humanoid: HumanoidModel, motion: Motion, settings: ForceSettings) -> Motion:
    """The motion with ``torques``, ``ground_reaction`` and (unless it has some) ``contacts`` of the bodies pushed.

    ``meta["forces"]`` says how they were found and ``residual``: the mean over frames of what the floor could not
    supply, in body weights (moments divided by the lever). The first and the last frame repeat their neighbours.

    Args:
        humanoid: whose masses and shapes are used.
        motion: on its skeleton; at least 3 frames. Its qpos stays as it is.
        settings: of the filter and the search.

    Raises:
        InputError: the motion is on another skeleton or too short.
    """
    if motion.skeleton != humanoid.skeleton:
        raise InputError(
            motion.name or "motion", "skeleton", "forces need the humanoid's own; `prepare` retargets to it"
        )
    if len(motion) < 3:
        raise InputError(motion.name or "motion", "qpos", f"{len(motion)} frames; accelerations need 3")
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    for flag in ("CONTACT", "LIMIT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    # The part of the joints' armature that only makes the PD controller stable is no property of the body.
    model.dof_armature[6:] -= humanoid.kd * model.opt.timestep
    qpos = _smooth(motion, settings.cutoff_hz)
    velocity = finite_difference(qpos, motion.fps)
    frames, bodies = len(qpos), len(humanoid.body_ids)
    force, point, moment = (np.zeros((frames, bodies, 3)) for _ in range(3))
    torques, residual = np.zeros((frames, model.nv - 6)), np.zeros(frames)
    data = mujoco.MjData(model)
    for t in range(1, frames - 1):
        data.qpos[:] = qpos[t]
        data.qvel[:] = 0.5 * (velocity[t] + velocity[t - 1])
        data.qacc[:] = (velocity[t] - velocity[t - 1]) * motion.fps
        mujoco.mj_inverse(model, data)
        points, owners = _near_floor(model, data, humanoid.body_ids, settings.touch)
        forces, residual[t] = _floor_forces(model, data, points, settings)
        torques[t] = data.qfrc_inverse[6:] - _generalized(model, data, humanoid.body_ids, points, owners, forces)[6:]
        point[t] = data.xpos[humanoid.body_ids] * [1.0, 1.0, 0.0]
        for body in np.unique(owners):
            force[t, body], point[t, body], moment[t, body] = _resultant(points[owners == body], forces[owners == body])
    for array in (force, point, moment, torques, residual):
        array[0], array[-1] = array[1], array[-2]
    pushed = np.flatnonzero((force != 0).any(axis=(0, 2)))
    kept = np.union1d(humanoid.feet, pushed)
    names = tuple(motion.skeleton.names[b] for b in kept)
    about = {"method": "inverse dynamics", "cutoff_hz": settings.cutoff_hz, "residual": float(residual.mean())}
    has_contacts = motion.contacts is not None
    return replace(
        motion,
        torques=torques,
        ground_reaction=GroundReaction(names, force[:, kept], point[:, kept], moment[:, kept]),
        contacts=motion.contacts if has_contacts else (force[:, kept] != 0).any(axis=2),
        contact_names=motion.contact_names if has_contacts else names,
        meta={**motion.meta, "forces": about},
    )


def _smooth(motion: Motion, cutoff_hz: float | None) -> Array:
    qpos = motion.qpos.copy()
    qpos[:, 3:7] = rot.continuous(rot.normalize(qpos[:, 3:7]))
    if cutoff_hz is None or cutoff_hz >= motion.fps / 2:
        return qpos
    sections = scipy.signal.butter(2, cutoff_hz, fs=motion.fps, output="sos")
    qpos = scipy.signal.sosfiltfilt(sections, qpos, axis=0, padlen=min(12, len(qpos) - 1))
    qpos[:, 3:7] = rot.normalize(qpos[:, 3:7])
    return np.asarray(qpos)


def _near_floor(
    model: mujoco.MjModel, data: mujoco.MjData, body_ids: NDArray[np.int64], touch: float
) -> tuple[Array, NDArray[np.int64]]:
    """Points ``[P, 3]`` (m) of boxes' corners and capsules' ends at most ``touch`` high, and their bodies ``[P]``."""
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    points, owners = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)]
    for owner, body in enumerate(body_ids):
        for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
            centre, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                result = centre + (signs * size) @ turn.T
            elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
                result = centre + np.outer([-1, 1], turn[:, 2]) * size[1] - [0, 0, size[0]]
            else:
                result = centre[None] - [0, 0, size[-1]]
            result = result[result[:, 2] <= touch]
            points.append(result)
            owners.append(np.full(len(result), owner))
    return np.concatenate(points), np.concatenate(owners)


def _floor_forces(
    model: mujoco.MjModel, data: mujoco.MjData, points: Array, settings: ForceSettings
) -> tuple[Array, float]:
    """Forces ``[P, 3]`` (N) at ``points``, and the norm of what is missing, in body weights."""
    weight = float(model.body_mass.sum()) * -float(model.opt.gravity[2])
    # A free joint's moments are in the root's own frame.
    root_moment = data.xmat[1].reshape(3, 3) @ data.qfrc_inverse[3:6]
    needed = np.concatenate([data.qfrc_inverse[:3], root_moment / settings.lever]) / weight
    if not len(points):
        return points, float(np.linalg.norm(needed))
    friction = float(model.geom_friction[1:, 0].max())
    edges = np.array([[friction, 0, 1], [-friction, 0, 1], [0, friction, 1], [0, -friction, 1]])
    pushes = np.tile(edges, (len(points), 1))
    arms = np.repeat(points - data.qpos[:3], len(edges), axis=0)
    supply = np.concatenate([pushes, np.cross(arms, pushes) / settings.lever], axis=1).T
    even = settings.evenness * np.eye(len(pushes))
    shares = scipy.optimize.nnls(np.concatenate([supply, even]), np.concatenate([needed, np.zeros(len(pushes))]))[0]
    forces = weight * (shares[:, None] * pushes).reshape(len(points), len(edges), 3).sum(axis=1)
    return forces, float(np.linalg.norm(supply @ shares - needed))


def _generalized(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body_ids: NDArray[np.int64],
    points: Array,
    owners: NDArray[np.int64],
    forces: Array,
) -> Array:
    """``[nv]`` what ``forces`` at ``points`` do to the coordinates."""
    out, jacobian = np.zeros(model.nv), np.zeros((3, model.nv))
    for point, owner, force in zip(points, owners, forces, strict=True):
        mujoco.mj_jac(model, data, jacobian, None, point, int(body_ids[owner]))
        out += jacobian.T @ force
    return out


def _resultant(points: Array, forces: Array) -> tuple[Array, Array, Array]:
    """Force, centre of pressure on the floor (z = 0) and free moment of ``forces [P, 3]`` at ``points [P, 3]``.

    The centre of pressure is where the horizontal moment vanishes.
    """
    total, moment = forces.sum(axis=0), np.cross(points, forces).sum(axis=0)
    if total[2] <= 0:
        return np.zeros(3), points.mean(axis=0) * [1.0, 1.0, 0.0], np.zeros(3)
    centre = np.array([-moment[1], moment[0], 0.0]) / total[2]
    return total, centre, moment - np.cross(centre, total)
