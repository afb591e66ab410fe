"""What the physics' time step changes: tracking of real motion, energy of a free body, speed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.data.gate import LEAD, STEPS, root_reward
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.motion.rotations import Array

#: Seconds of free flight.
FLIGHT = 1.0


class Starts(NamedTuple):
    """States to start from and the reference of the control steps after them.

    ``qpos [S, nq]``, ``qvel [S, nv]``, ``future_qpos [S, STEPS, nq]``, ``future_qvel [S, STEPS, nv]``.
    """

    qpos: Array
    qvel: Array
    future_qpos: Array
    future_qvel: Array

    @classmethod
    def of(cls, qpos: Array, qvel: Array, frames: NDArray[np.integer]) -> Starts:
        """From a clip ``qpos [T, nq]``, ``qvel [T, nv]`` and the frames ``[S]`` to start on."""
        ahead = frames[:, None] + np.arange(1, STEPS + 1)
        return cls(qpos[frames], qvel[frames], qpos[ahead], qvel[ahead])


def compare_rates(humanoids: Sequence[HumanoidModel], starts: Starts, rounds: int) -> list[dict[str, float]]:
    """One row a humanoid, the same body at different physics rates; distances are to the first.

    Args:
        humanoids: alike but for ``substeps``.
        starts: see :class:`Starts`.
        rounds: timed repetitions of the tracking; the median counts.

    Returns:
        Rows with ``substeps``, ``hz``; means over starts and steps of open-loop PD: ``height_error_cm``,
        ``root_reward`` (r_p), ``joint_error_rad`` (mean over joints); ``from_first_rad`` (mean distance of the joint
        angles after the last step from the first humanoid's); ``energy_drift``: change of the kinetic energy of a
        weightless body without actuators and limits in a second, as a share of it, mean over starts;
        ``control_steps_per_s`` on one thread.
    """
    rows: list[dict[str, float]] = []
    first: Array | None = None
    for humanoid in humanoids:
        figures, joints = _track(humanoid, starts)
        first = joints if first is None else first
        began = []
        for _ in range(rounds):
            start = time.perf_counter()
            _track(humanoid, starts)
            began.append(time.perf_counter() - start)
        rows.append(
            {
                "substeps": humanoid.substeps,
                "hz": humanoid.substeps / humanoid.control_dt,
                **figures,
                "from_first_rad": float(np.abs(joints - first).mean()),
                "energy_drift": _energy_drift(humanoid, starts),
                "control_steps_per_s": STEPS * len(starts.qpos) / float(np.median(began)),
            }
        )
    return rows


def _track(humanoid: HumanoidModel, starts: Starts) -> tuple[dict[str, float], Array]:
    physics = BatchedPhysics(humanoid.mj_model, len(starts.qpos), humanoid.substeps, body_ids=humanoid.body_ids)
    physics.set_state(slice(None), starts.qpos, starts.qvel)
    height, reward, joint = [], [], []
    for step in range(STEPS):
        wanted, velocity = starts.future_qpos[:, step], starts.future_qvel[:, step]
        physics.step(np.ascontiguousarray(wanted[:, 7:] + LEAD * velocity[:, 6:]))
        height.append(np.abs(physics.qpos[:, 2] - wanted[:, 2]).mean())
        reward.append(root_reward(physics.qpos, wanted).mean())
        joint.append(np.abs(physics.qpos[:, 7:] - wanted[:, 7:]).mean())
    joints = physics.qpos[:, 7:].copy()
    physics.close()
    figures = {
        "height_error_cm": 100 * float(np.mean(height)),
        "root_reward": float(np.mean(reward)),
        "joint_error_rad": float(np.mean(joint)),
    }
    return figures, joints


def _energy_drift(humanoid: HumanoidModel, starts: Starts, count: int = 32) -> float:
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    model.dof_armature[6:] -= humanoid.kd * model.opt.timestep  # stable PD's share: there is no PD here
    for flag in ("CONTACT", "LIMIT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    model.opt.gravity[:] = 0.0  # a fall's energy would hide the joints'
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    drifts = []
    for index in np.linspace(0, len(starts.qpos) - 1, min(count, len(starts.qpos))).astype(int):
        data.qpos[:], data.qvel[:] = starts.qpos[index], starts.qvel[index]
        mujoco.mj_forward(model, data)
        before = data.energy[1]
        mujoco.mj_step(model, data, round(FLIGHT / model.opt.timestep))
        mujoco.mj_forward(model, data)
        if before > 1.0:  # J: a body standing still has no scale to measure by
            drifts.append(abs(data.energy[1] - before) / before)
    return float(np.mean(drifts)) if drifts else float("nan")
