"""A small body with the model's doors, for tests of the environment that need no mocap and compile at once."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from egopose.envs.problem import TakeTable
from egopose.motion import rotations as rot
from egopose.motion.motion import finite_difference
from egopose.motion.skeleton import Dof, Joint, Skeleton

_JOINTS = {
    # name: (parent, offset, axes)
    "Hips": (None, (0, 0, 1.0), ""),
    "Spine": ("Hips", (0, 0, 0.2), "zyx"),
    "Head": ("Spine", (0, 0, 0.35), "zyx"),
    "RightHand": ("Spine", (0, -0.45, 0.2), "zyx"),
    "LeftHand": ("Spine", (0, 0.45, 0.2), "zyx"),
    "RightLeg": ("Hips", (0, -0.1, -0.45), "y"),
    "RightFoot": ("RightLeg", (0, 0, -0.45), "zyx"),
    "LeftLeg": ("Hips", (0, 0.1, -0.45), "y"),
    "LeftFoot": ("LeftLeg", (0, 0, -0.45), "zyx"),
}
_AXIS = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


@dataclass(frozen=True)
class StandIn:
    """The attributes of ``HumanoidModel`` that environment and networks read."""

    xml: str
    mj_model: mujoco.MjModel
    skeleton: Skeleton
    body_ids: np.ndarray
    joint_parent: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    joint_range: np.ndarray
    rest_action: np.ndarray
    end_effectors: np.ndarray
    head: int
    feet: np.ndarray
    substeps: int
    control_dt: float


def _body(name: str) -> str:
    parent, offset, axes = _JOINTS[name]
    joints = "".join(f'<joint name="{name}_{a}" axis="{_AXIS[a]}" range="-1.5 1.5" armature="0.01"/>' for a in axes)
    children = "".join(_body(c) for c, (p, _, _) in _JOINTS.items() if p == name)
    root = "<freejoint/>" if parent is None else ""
    geom = (
        '<geom type="box" size="0.12 0.05 0.05" mass="2"/>'
        if name.endswith("Foot")
        else '<geom type="sphere" size="0.08" mass="6" contype="0" conaffinity="0"/>'
    )
    pos = " ".join(map(str, offset))
    return f'<body name="{name}" pos="{pos}">{root}{joints}{geom}{children}</body>'


def _skeleton() -> Skeleton:
    names = list(_JOINTS)
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    return Skeleton(
        tuple(
            Joint(
                name, -1 if parent is None else names.index(parent), offset, tuple(Dof("hinge", axes[a]) for a in dofs)
            )
            for name, (parent, offset, dofs) in _JOINTS.items()
        )
    )


def stand_in(substeps: int = 5) -> StandIn:
    names = [f"{n}_{a}" for n, (_, _, axes) in _JOINTS.items() for a in axes]
    kp, kd = 200.0, 20.0
    actuators = "".join(
        f'<general joint="{n}" gainprm="{kp}" biastype="affine" biasprm="0 -{kp} -{kd}" forcerange="-100 100"/>'
        for n in names
    )
    dt = 1 / 30 / substeps
    xml = (
        f'<mujoco><option timestep="{dt!r}" integrator="implicitfast"/><compiler angle="radian" autolimits="true"/>'
        f'<worldbody><geom type="plane" size="0 0 1"/>{_body("Hips")}</worldbody>'
        f"<actuator>{actuators}</actuator></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(xml)
    order = [model.body(i).name for i in range(1, model.nbody)]
    ids = np.arange(1, model.nbody)
    return StandIn(
        xml=xml,
        mj_model=model,
        skeleton=_skeleton(),
        body_ids=ids,
        joint_parent=model.body_parentid[ids[1:]] - 1,
        kp=np.full(model.nu, kp),
        kd=np.full(model.nu, kd),
        joint_range=model.jnt_range[1:].copy(),
        rest_action=np.zeros(model.nu),
        end_effectors=np.array([order.index(n) for n in ("RightHand", "LeftHand", "RightFoot", "LeftFoot", "Head")]),
        head=order.index("Head"),
        feet=np.array([order.index(n) for n in ("RightFoot", "LeftFoot")]),
        substeps=substeps,
        control_dt=1 / 30,
    )


def reference_motion(humanoid: StandIn, lengths: tuple[int, ...] = (40, 25)) -> tuple[TensorDict, TakeTable]:
    """Gentle swaying on the spot, each take with its own phase and heading, and the table of takes."""
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    parts, heads = [], []
    for k, length in enumerate(lengths):
        t = np.arange(length)[:, None] / 30
        qpos = np.zeros((length, model.nq))
        qpos[:, 0:2] = 0.1 * t
        qpos[:, 2] = 0.97 + 0.005 * np.sin(3 * t[:, 0])
        angle = 0.5 * (k + 0.3 * t[:, 0])
        yaw = np.stack([np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)], axis=-1)
        lean = 0.05 * np.concatenate([np.sin(2 * t), np.cos(3 * t), 0 * t], axis=-1)
        qpos[:, 3:7] = rot.multiply(yaw, rot.from_rotvec(lean))
        qpos[:, 7:] = 0.1 * np.sin(2 * t + k + np.arange(model.nq - 7))
        state = {"qpos": qpos, "qvel": finite_difference(qpos, 30.0)}
        bodies = {name: [] for name in ("xpos", "xquat", "com")}
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            bodies["xpos"].append(data.xpos[humanoid.body_ids].copy())
            bodies["xquat"].append(data.xquat[humanoid.body_ids].copy())
            bodies["com"].append(data.subtree_com[1].copy())
        state |= {name: np.stack(rows) for name, rows in bodies.items()}
        heads.append(state["xpos"][:, humanoid.head, 2].min())
        parts.append(TensorDict({k: torch.from_numpy(v) for k, v in state.items()}, batch_size=[length]))
    offsets = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    table = TakeTable(torch.tensor(offsets), torch.tensor(lengths), torch.tensor(np.array(heads)))
    return torch.cat(parts), table
