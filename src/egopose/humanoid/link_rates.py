"""Velocities of a body's links and of its mass, by MuJoCo's own kinematics."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array


class Rates(NamedTuple):
    """Of n bodies, in the world.

    Attributes:
        linear: ``[n, B, 3]`` m/s of the links' origins.
        angular: ``[n, B, 3]`` rad/s.
        centre_of_mass: ``[n, 3]`` m/s.
    """

    linear: Array
    angular: Array
    centre_of_mass: Array


class LinkRates:
    """Rates of bodies, one after the other.

    Args:
        model: compiled; it may hold boxes.
        body_ids: ``[B]`` of the links, the root first.
    """

    def __init__(self, model: mujoco.MjModel, body_ids: NDArray[np.integer]) -> None:
        self._model, self._ids = model, body_ids
        data = self._data = mujoco.MjData(model)
        self._parts = (data.cvel, data.xpos, data.xipos, data.subtree_com)
        self._mass = model.body_mass[body_ids] / model.body_mass[body_ids].sum()

    def __call__(self, qpos: Array, qvel: Array) -> Rates:
        """Rates at ``qpos [n, nq]`` and ``qvel [n, nv]``."""
        model, data, ids, count = self._model, self._data, self._ids, len(self._ids)
        cvel, xpos, xipos, subtree = self._parts
        twist, origin = np.empty((len(qpos), count, 6)), np.empty((len(qpos), count, 3))
        inertial, about = np.empty_like(origin), np.empty((len(qpos), 1, 3))
        for i in range(len(qpos)):
            data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            twist[i], origin[i], inertial[i], about[i] = cvel[ids], xpos[ids], xipos[ids], subtree[ids[:1]]
        angular = twist[..., :3]
        # MuJoCo gives the linear part where the whole body's centre of mass is.
        linear = twist[..., 3:] + np.cross(angular, origin - about)
        centre = self._mass @ (twist[..., 3:] + np.cross(angular, inertial - about))
        return Rates(linear, angular, centre)
