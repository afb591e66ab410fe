"""The humanoid with motors in place of PD controllers, for methods whose actions are torques."""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco

from egopose.humanoid.model import HumanoidModel


def torque_driven(humanoid: HumanoidModel, joint_damping: float) -> HumanoidModel:
    """The same body whose controls are torques (N m) and not target angles; only ``mj_model`` differs.

    The joints' limits of torque stay. The share of the armature that belongs to the stable PD goes; in the PD's place
    the joints are passively damped, as MuJoCo integrates it: implicitly.

    Args:
        humanoid: with PD actuators, see :mod:`egopose.humanoid.model`.
        joint_damping: of each joint, as a share of its PD's kd.
    """
    model = copy.copy(humanoid.mj_model)
    model.actuator_gainprm[:, 0] = 1.0
    model.actuator_biasprm[:] = 0.0
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_NONE
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    model.dof_armature[dofs] -= humanoid.kd * model.opt.timestep
    model.dof_damping[dofs] = joint_damping * humanoid.kd
    return replace(humanoid, mj_model=model)
