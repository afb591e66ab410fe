"""How a control step changes with the state and the control it starts from: finite differences of the simulation.

A state's small changes have ``2 nv`` numbers: ``nv`` of the position (a turn of the root in its own axes) and ``nv`` of
the velocity. Differences are of a whole control step and one-sided. They are large on purpose: over a step that is
smaller than 1e-3 a contact looks like a wall, and gains that follow from it make a body fall sooner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

Single = NDArray[np.float32]


@dataclass(frozen=True)
class Differences:
    """Sizes of the differences: ``position`` in m and rad, ``velocity`` in m/s and rad/s, ``control`` in rad."""

    position: float = 2e-3
    velocity: float = 2e-2
    control: float = 2e-2


def moved(qpos: Array, change: Array) -> Array:
    """``qpos [..., nq]`` after small ``change [..., nv]``: MuJoCo's ``mj_integratePos`` over one second."""
    turned = rot.multiply(qpos[..., 3:7], rot.from_rotvec(change[..., 3:6]))
    return np.concatenate([qpos[..., :3] + change[..., :3], turned, qpos[..., 7:] + change[..., 6:]], axis=-1)


def difference(to: Array, start: Array) -> Array:
    """The change ``[..., nv]`` that leads from ``start [..., nq]`` to ``to``: MuJoCo's ``mj_differentiatePos``."""
    turn = rot.to_rotvec(rot.multiply(rot.conjugate(start[..., 3:7]), to[..., 3:7]))
    return np.concatenate([to[..., :3] - start[..., :3], turn, to[..., 7:] - start[..., 7:]], axis=-1)


def state_difference(qpos: Array, qvel: Array, from_qpos: Array, from_qvel: Array) -> Array:
    """``[..., 2 nv]`` from one state to another."""
    return np.concatenate([difference(qpos, from_qpos), qvel - from_qvel], axis=-1)


class Simulator:
    """Control steps of any number of states, some of the physics' worlds at a time.

    Args:
        humanoid: the model.
        num_envs: worlds that are stepped together.
        threads: of the physics.

    Attributes:
        steps: control steps simulated so far.
    """

    def __init__(self, humanoid: HumanoidModel, num_envs: int, threads: int) -> None:
        self._physics = BatchedPhysics(
            humanoid.mj_model, num_envs, humanoid.substeps, threads, body_ids=humanoid.body_ids, max_speed=1e4
        )
        self.steps = 0

    def step(self, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
        """States ``[n, nq]``, ``[n, nv]`` a control step after those under ``ctrl [n, nu]``."""
        physics, after_qpos, after_qvel = self._physics, np.empty_like(qpos), np.empty_like(qvel)
        for at in range(0, len(qpos), physics.num_envs):
            rows = slice(at, min(at + physics.num_envs, len(qpos)))
            worlds = slice(0, rows.stop - at)
            physics.set_state(worlds, qpos[rows], qvel[rows])
            physics.begin_step(np.ascontiguousarray(ctrl[rows]), worlds)
            physics.end_step(worlds)
            after_qpos[rows], after_qvel[rows] = physics.qpos[worlds], physics.qvel[worlds]
        self.steps += len(qpos)
        return after_qpos, after_qvel

    def place_boxes(self, top: Array, heading: Array) -> None:
        """Put the humanoid's boxes at ``top [K, 3]`` m and ``heading [K]`` rad in all worlds.

        Raises:
            ValueError: a place where a box cannot be.
        """
        count = self._physics.num_envs
        self._physics.place_boxes(slice(None), np.tile(top, (count, 1, 1)), np.tile(heading, (count, 1)))

    def close(self) -> None:
        """Stop the threads."""
        self._physics.close()


def linearised(
    simulator: Simulator, qpos: Array, qvel: Array, ctrl: Array, sizes: Differences
) -> tuple[Single, Single]:
    """A ``[n, 2 nv, 2 nv]`` and B ``[n, 2 nv, nu]`` of a control step from each state under each control.

    Nothing depends on where on the floor a body stands, so these two columns are known.

    Args:
        simulator: of the steps: ``2 nv + nu - 1`` a state.
        qpos, qvel, ctrl: ``[n, nq]``, ``[n, nv]``, ``[n, nu]``.
        sizes: of the differences.
    """
    count, nv, nu = len(qpos), qvel.shape[1], ctrl.shape[1]
    first_velocity, first_control = 1 + nv - 2, 1 + nv - 2 + nv
    columns = first_control + nu
    change = np.zeros((columns, nv))
    change[np.arange(1, first_velocity), np.arange(2, nv)] = sizes.position
    positions = moved(np.repeat(qpos[:, None], columns, axis=1), np.broadcast_to(change, (count, columns, nv)))
    velocities, controls = np.repeat(qvel[:, None], columns, axis=1), np.repeat(ctrl[:, None], columns, axis=1)
    velocities[:, first_velocity + np.arange(nv), np.arange(nv)] += sizes.velocity
    controls[:, first_control + np.arange(nu), np.arange(nu)] += sizes.control
    flat = (part.reshape(count * columns, -1) for part in (positions, velocities, controls))
    after_qpos, after_qvel = (part.reshape(count, columns, -1) for part in simulator.step(*flat))
    led = state_difference(after_qpos[:, 1:], after_qvel[:, 1:], after_qpos[:, :1], after_qvel[:, :1])
    changes: Single = led.astype(np.float32).swapaxes(1, 2)
    state = np.zeros((count, 2 * nv, 2 * nv), dtype=np.float32)
    state[:, 0, 0] = state[:, 1, 1] = 1.0
    state[:, :, 2:nv] = changes[:, :, : first_velocity - 1] / sizes.position
    state[:, :, nv:] = changes[:, :, first_velocity - 1 : first_control - 1] / sizes.velocity
    return state, np.asarray(changes[:, :, first_control - 1 :] / np.float32(sizes.control))
