"""What one thread does for :class:`egopose.humanoid.physics.BatchedPhysics`: step some worlds, and place bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from egopose.humanoid.contact_sensors import ContactSensors, without_sensors

Array = NDArray[np.float64]

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
_BEFORE_BOXES = mujoco.mjtState.mjSTATE_INTEGRATION & (mujoco.mjtState.mjSTATE_MOCAP_POS - 1)
# A thread takes so many worlds in one call. Measured, with two env_groups of 32 worlds on two threads: 8 or 16 at once
# are as quick, 4 cost 1 % and 2 cost 3 %.
WORLDS_AT_ONCE = 8


@dataclass
class Arrival:
    """What a step leaves of every world.

    Args:
        state: ``[N, nstate]``.
        warned: ``[N]`` MuJoCo reset or stopped it.
        contacts: ``[N, E, 1 + K]`` bodies that touched the floor and each box, None where nobody asks.
        torques: ``[N, nu]`` N m, likewise.
    """

    state: Array
    warned: NDArray[np.bool_]
    contacts: NDArray[np.bool_] | None
    torques: Array | None


class Worker:
    """What one thread steps worlds with, some at a time."""

    def __init__(self, model: mujoco.MjModel, substeps: int, sensors: ContactSensors | None) -> None:
        self._substeps, self._sensors = substeps, sensors
        self._batch = batch = Batch(without_sensors(model) if sensors is None else model, WORLDS_AT_ONCE, nthread=1)
        # A row begins with the full physics' state: MuJoCo keeps only plugins' elsewhere.
        self._full = mujoco.mj_stateSize(model, FULL)
        self._state = batch.state[:, : self._full]
        self._ctrl, self._warm_start = batch.bind("ctrl"), batch.bind("qacc_warmstart")
        self._warnings = batch.warning
        # The boxes' positions and quaternions follow each other in a row, as they do in ours.
        first = mujoco.mj_stateSize(model, _BEFORE_BOXES)
        self._boxes = batch.state[:, first : first + 7 * model.nmocap] if model.nmocap else None
        # A batch copies out what is bound: nothing where nobody asks.
        self._found = None if sensors is None else batch.bind("sensordata")
        self._dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]

    def step(self, before: Array, ctrl: Array, parts: Iterator[slice], after: Arrival) -> None:
        """Take ``parts`` of the worlds from ``before [N, nstate]`` to ``after`` under ``ctrl [N, nu]``."""
        full = self._full
        for worlds in parts:
            n = worlds.stop - worlds.start
            self._state[:n], self._ctrl[:n] = before[worlds, :full], ctrl[worlds]
            self._warm_start[:n] = 0.0
            if self._boxes is not None:
                self._boxes[:n] = before[worlds, full:]
                after.state[worlds, full:] = before[worlds, full:]
            self._advance(worlds, n, after)
            after.state[worlds, :full] = self._state[:n]
            if self._sensors is not None and self._found is not None and after.contacts is not None:
                after.contacts[worlds] = self._sensors.read(self._found[:n])
            after.warned[worlds] = self._warnings[:n, :, 1].any(-1)
            if after.warned[worlds].any():
                self._warnings[:n] = 0

    def _advance(self, worlds: slice, n: int, after: Arrival) -> None:
        rows = None if n == WORLDS_AT_ONCE else range(n)
        if after.torques is None:
            self._batch.step(rows, self._substeps)
            return
        recorded = self._batch.rollout(self._substeps, record=("qfrc_actuator",), ids=rows)["qfrc_actuator"]
        after.torques[worlds] = recorded.mean(axis=1)[:, self._dofs]


class Placer:
    """Kinematics, one world after the other: at four microseconds each not worth a thread's while."""

    def __init__(self, model: mujoco.MjModel, body_ids: NDArray[np.integer]) -> None:
        self._model = model
        self.data = data = mujoco.MjData(model)
        # Views into the data: each attribute of MjData is made anew when it is asked for.
        self._qpos, self._poses = data.qpos, (data.xpos, data.xquat, data.xipos)
        first, last = int(body_ids[0]), int(body_ids[-1])
        in_order = np.array_equal(body_ids, np.arange(first, last + 1))
        self._bodies = slice(first, last + 1) if in_order else body_ids
        self._count = len(body_ids)

    def __call__(self, qpos: Array) -> tuple[Array, ...]:
        """``xpos [n, B, 3]`` m, ``xquat [n, B, 4]``, ``xipos [n, B, 3]`` m of bodies at ``qpos [n, nq]``."""
        model, data, bodies = self._model, self.data, self._bodies
        xpos, xquat, xipos = here = self._poses
        all_xpos, all_xquat, all_xipos = there = tuple(np.empty((len(qpos), self._count, p.shape[1])) for p in here)
        for i in range(len(qpos)):
            self._qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            all_xpos[i], all_xquat[i], all_xipos[i] = xpos[bodies], xquat[bodies], xipos[bodies]
        return there
