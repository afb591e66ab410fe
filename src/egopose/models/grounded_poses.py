"""Forecast poses that a body can stand in: mass over the feet, soles on the floor, a root that the feet carry.

A kinematic forecast is a mean of what may come, number by number, so its root does not fit its legs. On windows of CMU
subject 2 the soles were 3 cm in the floor, the mass was 2 cm too far ahead, and the root went where no foot did. A
simulated body that follows this loses its balance. NumPy, float64, quaternions wxyz.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.foot_geometry import out_of_floor, sole_edges
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.pose_regression import state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: m above the lowest point at which a point carries 1/e as much.
_CARRIES = 0.02
#: s, a standard deviation in time: what the mass sways more quickly is left to it.
_SWAY = 1.0 / 3.0
#: m^2: corners this near together do not tell how the body turns.
_SPREAD = 1e-3


def grounded(poses: Array, humanoid: HumanoidModel, mass_ahead: float) -> Array:
    """Poses ``[W, T, P]`` of W motions with the same joints and another root, float64.

    In this order: the root leans so that the mass is above the soles that carry it, over some tenths of a second. It
    rises until no sole is in the floor. Its velocities become those of its height and lean, and of soles that stay.

    Args:
        poses: z without the joint velocities, see :class:`~egopose.humanoid.state_layout.StateLayout`.
        humanoid: the body.
        mass_ahead: m that the centre of mass is to be ahead of the middle of the soles that carry it.
    """
    layout, fps = StateLayout.of_pose_size(poses.shape[-1]), 1.0 / humanoid.control_dt
    out = np.array(poses, dtype=np.float64)
    out[..., layout.root_rotation] = _upright(out, humanoid, layout, mass_ahead)
    qpos = _placed(out, humanoid, layout)
    out[..., 0] = out_of_floor(humanoid, qpos.reshape(-1, qpos.shape[-1]))[:, 2].reshape(out.shape[:2])
    lean = out[..., layout.root_rotation]
    back = rot.conjugate(lean)
    carried = _carried(_corners(qpos, humanoid), fps)
    rising = np.gradient(out[..., :1], axis=1) * fps
    out[..., layout.root_linear_velocity] = np.concatenate([carried[..., :2], rising], axis=-1)
    leaning = rot.to_rotvec(rot.multiply(back[:, :-1], lean[:, 1:])) * fps
    turning = rot.rotate(back, np.array([0.0, 0.0, 1.0])) * carried[..., 2:]
    out[..., layout.root_angular_velocity] = np.concatenate([leaning, leaning[:, -1:]], axis=1) + turning
    return out


def _placed(poses: Array, humanoid: HumanoidModel, layout: StateLayout) -> Array:
    """``[W, T, nq]`` at the origin, facing along x."""
    still = np.concatenate([poses, np.zeros((*poses.shape[:2], layout.dofs))], axis=-1)
    return state_to_qpos(still, np.zeros(2), np.array([1.0, 0.0, 0.0, 0.0]), humanoid.joint_range)[0]


def _corners(qpos: Array, humanoid: HumanoidModel) -> Array:
    """``[W, T, C, 3]`` m: the corners of all soles."""
    motion = Motion(humanoid.skeleton, qpos.reshape(-1, qpos.shape[-1]), 1.0 / humanoid.control_dt)
    edges = sole_edges(humanoid, motion)
    return edges.reshape(*qpos.shape[:2], *edges.shape[1:])


def _shares(points: Array) -> Array:
    """``[W, T, C]`` how much of the body each of the ``points [W, T, C, 3]`` carries, by its height."""
    height = points[..., 2] - points[..., 2].min(axis=-1, keepdims=True)
    shares = np.exp(-height / _CARRIES)
    return shares / shares.sum(axis=-1, keepdims=True)


def _upright(poses: Array, humanoid: HumanoidModel, layout: StateLayout, mass_ahead: float) -> Array:
    """``[W, T, 4]`` de-headed rotations of the root, turned until the mass is ``mass_ahead`` of what carries it."""
    qpos = _placed(poses, humanoid, layout)
    corners = _corners(qpos, humanoid)
    motion = Motion(humanoid.skeleton, qpos.reshape(-1, qpos.shape[-1]), 1.0 / humanoid.control_dt)
    positions, quats = motion.forward_kinematics()
    model, ids = humanoid.mj_model, humanoid.body_ids
    mass = model.body_mass[ids] / model.body_mass[ids].sum()
    centre = mass @ (positions + rot.rotate(quats, np.broadcast_to(model.body_ipos[ids], positions.shape)))
    centre = centre.reshape(*qpos.shape[:2], 3)
    # Of whole soles: a lean tips a sole, and which corner is lowest says which way, not how far.
    soles = corners.reshape(*corners.shape[:2], len(humanoid.feet), -1, 3).mean(axis=-2)
    middle = (_shares(soles)[..., None] * soles[..., :2]).sum(axis=-2)
    away = centre[..., :2] - middle - np.array([mass_ahead, 0.0])
    away = gaussian_filter1d(away, _SWAY / humanoid.control_dt, axis=1, mode="nearest")
    lean = away / (centre[..., 2] - corners[..., 2].min(axis=-1))[..., None]
    turn = rot.from_rotvec(np.stack([lean[..., 1], -lean[..., 0], np.zeros_like(lean[..., 0])], axis=-1))
    turned = rot.multiply(turn, qpos[..., 3:7])
    return rot.multiply(rot.conjugate(rot.heading(turned)), turned)


def _carried(corners: Array, fps: float) -> Array:
    """``[W, T, 3]`` velocity (m/s, ahead and to the left) and turn (rad/s) of a root whose soles stay in place.

    The least squares over the corners, weighted by what they carry.
    """
    shares, place = _shares(corners)[..., None], corners[..., :2]
    speed = np.gradient(place, axis=1) * fps
    middle, drift = (shares * place).sum(axis=-2), (shares * speed).sum(axis=-2)
    arm, slip = place - middle[..., None, :], speed - drift[..., None, :]
    twist = (shares[..., 0] * (arm[..., 0] * slip[..., 1] - arm[..., 1] * slip[..., 0])).sum(axis=-1)
    turn = -twist / ((shares * arm**2).sum(axis=(-2, -1)) + _SPREAD)
    ahead, left = turn * middle[..., 1] - drift[..., 0], -turn * middle[..., 0] - drift[..., 1]
    return np.stack([ahead, left, turn], axis=-1)
