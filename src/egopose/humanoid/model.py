"""From a skeleton to a simulated humanoid: MJCF by ``dm_control.mjcf``, stable PD by MuJoCo's own actuators.

Frames: z up, x forward, y left; at zero joint angles the body stands upright with its arms held out sideways.
The actuators are affine, ``torque = kp (target - angle) - (kd + kp h) velocity``, and the joints' armature carries
``kd h`` more than their own (h: the physics step). With the semi-implicit Euler integrator this is stable PD as
published (Tan et al. 2011, eqs. 9-11), and MuJoCo's contact solver sees it: with the implicit integrators the damping
is added after the contact forces are found, and a standing body sinks (docs/physics-gate.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np
from dm_control import mjcf
from numpy.typing import NDArray

from egopose.humanoid.config import HumanoidConfig, JointRow, SimConfig
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: Geoms collide with the floor only: retargeted mocap interpenetrates (hands on thighs, thigh on thigh), and contacts
#: between limbs would push the reference state away from itself.
_FLOOR_BIT, _BODY_BIT = 2, 1


@dataclass(frozen=True, eq=False)
class HumanoidModel:
    """A compiled humanoid and the tables the environment needs.

    Attributes:
        xml: the MJCF document.
        mj_model: compiled at the simulation's rate; 58 degrees of freedom, 52 actuators with the default table.
        skeleton: the same tree for :mod:`egopose.motion`; qpos means the same in both.
        body_ids: ``[21]`` MuJoCo body ids in the skeleton's order.
        joint_parent: ``[20]`` for bodies 1..20, the index of the parent among the 21.
        kp, kd: ``[52]`` N m/rad and N m s/rad.
        torque_limit: ``[52]`` N m.
        joint_range: ``[52, 2]`` rad.
        rest_action: ``[52]`` rad, the rest pose actions are measured from (knees and elbows 45, upper arms 80 degrees
            down; the authors' program).
        end_effectors: indices among the 21 bodies: feet, hands, head.
        head, feet: body indices. sole_points: ``[feet, 2, 3]`` heel and ball of each sole in the foot's frame, m.
        hand_dofs: columns among the 52 that belong to the hands.
        substeps: physics steps a control step. control_dt: seconds.
        box_sizes: ``[K, 2]`` m, lengths and widths of a scene's boxes, see :func:`egopose.humanoid.boxes.with_boxes`.
        touching: ``[E]`` indices among the 21 of the bodies whose contacts :class:`BatchedPhysics` can tell.
    """

    xml: str
    mj_model: mujoco.MjModel
    skeleton: Skeleton
    body_ids: NDArray[np.int64]
    joint_parent: NDArray[np.int64]
    kp: Array
    kd: Array
    torque_limit: Array
    joint_range: Array
    rest_action: Array
    end_effectors: NDArray[np.int64]
    head: int
    feet: NDArray[np.int64]
    sole_points: Array
    hand_dofs: NDArray[np.int64]
    substeps: int
    control_dt: float
    box_sizes: Array = field(default_factory=lambda: np.zeros((0, 2)))
    touching: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def build_humanoid(config: HumanoidConfig, sim: SimConfig | None = None) -> HumanoidModel:
    """The humanoid of a config table at a simulation rate.

    Raises:
        ValueError: MuJoCo refuses the document (the message is MuJoCo's).
    """
    sim = sim or SimConfig()
    skeleton = config.skeleton()
    gain_scale = config.total_mass / config.reference_mass
    rows = config.joints
    per_dof = [(row, k) for row in rows for k in range(len(row.axes))]
    kp = np.array([row.kp for row, _ in per_dof]) * gain_scale
    kd = config.kd_ratio * kp
    torque_limit = np.array([row.torque_limit for row, _ in per_dof]) * gain_scale
    joint_range = np.deg2rad(np.array([row.range_deg[k] for row, k in per_dof]))
    dof_names = [f"{row.name}_{k}" for row, k in per_dof]
    rest = np.zeros(len(per_dof))
    for name, degrees in config.rest_action_deg.items():
        rest[dof_names.index(name)] = np.deg2rad(degrees)

    root = _document(config, sim)
    _bodies(root, config)
    for name, p, d, limit in zip(dof_names, kp, kd, torque_limit, strict=True):
        root.actuator.add(
            "general",
            name=name,
            joint=name,
            gaintype="fixed",
            biastype="affine",
            gainprm=[p],
            biasprm=[0.0, -p, -(d + p * sim.timestep)],
        )
        # The limit sits on the joint, where it clips the torque and leaves the armature's share of the damping alone.
        hinge = root.find("joint", name)
        hinge.actuatorfrclimited, hinge.actuatorfrcrange = True, [-limit, limit]
        hinge.armature = config.armature + d * sim.timestep
    xml = root.to_xml_string()
    model = mujoco.MjModel.from_xml_string(xml)
    index = {row.name: i for i, row in enumerate(rows)}
    feet = np.array([index[f] for f in config.feet])
    return HumanoidModel(
        xml=xml,
        mj_model=model,
        skeleton=skeleton,
        body_ids=np.array([model.body(row.name).id for row in rows]),
        joint_parent=skeleton.parents[1:],
        kp=kp,
        kd=kd,
        torque_limit=torque_limit,
        joint_range=joint_range,
        rest_action=rest,
        end_effectors=np.array([index[e] for e in config.end_effectors]),
        head=index[config.head],
        feet=feet,
        sole_points=np.stack([sole_points(config, name) for name in config.feet]),
        hand_dofs=np.array([i for i, (row, _) in enumerate(per_dof) if row.name in config.hands]),
        substeps=sim.substeps,
        control_dt=1.0 / sim.control_hz,
    )


def sole_points(config: HumanoidConfig, foot: str) -> Array:
    """``[2, 3]``: heel and ball of the sole in the foot's frame, metres; the foot stands flat at zero ankle angles."""
    toe = config.tips[foot]
    return np.array(
        [
            [-config.heel_length, 0.0, -config.ankle_height],
            [toe[0] + config.toe_overhang, toe[1], -config.ankle_height],
        ]
    )


def _document(config: HumanoidConfig, sim: SimConfig) -> mjcf.RootElement:
    root = mjcf.RootElement(model="egopose_humanoid")
    root.compiler.angle = "radian"
    root.compiler.autolimits = True
    root.option.timestep = sim.timestep
    root.option.integrator = "Euler"
    root.option.iterations = sim.solver_iterations
    root.option.tolerance = sim.tolerance
    root.option.solver = sim.solver
    root.default.geom.contype = _BODY_BIT
    root.default.geom.conaffinity = _FLOOR_BIT
    root.default.geom.friction = config.friction
    root.default.geom.rgba = [0.55, 0.62, 0.75, 1.0]
    root.default.joint.limited = True
    root.asset.add("texture", name="grid", type="2d", builtin="checker", width=256, height=256,
                   rgb1=[0.32, 0.35, 0.38], rgb2=[0.42, 0.45, 0.48])  # fmt: skip
    root.asset.add("material", name="grid", texture="grid", texrepeat=[20, 20], reflectance=0.0)
    root.worldbody.add("light", name="sun", pos=[0, 0, 6], dir=[0.2, 0.2, -1], directional=True, castshadow=False)
    root.worldbody.add(
        "geom", name="floor", type="plane", size=[40, 40, 1], material="grid", contype=_FLOOR_BIT, conaffinity=_BODY_BIT
    )
    return root


def _bodies(root: mjcf.RootElement, config: HumanoidConfig) -> None:
    total = sum(row.mass_fraction for row in config.joints)
    made: dict[str, mjcf.Element] = {}
    for row in config.joints:
        offset = config.offsets.get(row.name, (0.0, 0.0, 0.0))
        if row.parent is None:
            body = root.worldbody.add("body", name=row.name, pos=[0, 0, 1.0])
            body.add("freejoint", name="root")
        else:
            body = made[row.parent].add("body", name=row.name, pos=offset)
        made[row.name] = body
        for k, (axis, limits) in enumerate(zip(row.axes, row.range_deg, strict=True)):
            body.add("joint", name=f"{row.name}_{k}", type="hinge", axis=axis, range=np.deg2rad(limits))
        mass = config.total_mass * row.mass_fraction / total
        _geom(body, row, mass, config)
        if row.name == config.head:
            # At the eyes: 9 cm before and 10 cm above the head joint, looking ahead and 25 degrees down.
            down = np.deg2rad(25.0)
            body.add(
                "camera",
                name="head",
                pos=[0.12, 0.0, 0.10],
                xyaxes=[0, -1, 0, np.sin(down), 0, np.cos(down)],
                fovy=90,
            )


def _geom(body: mjcf.Element, row: JointRow, mass: float, config: HumanoidConfig) -> None:
    """The body's shape: a box under the foot, an ellipsoid for the head, else a capsule to the next joint."""
    name = row.name
    if name in config.feet:
        heel, ball = sole_points(config, name)
        half_height = 0.5 * min(config.ankle_height, 0.06)
        centre = [(heel[0] + ball[0]) / 2, (heel[1] + ball[1]) / 2, -config.ankle_height + half_height]
        size = [(ball[0] - heel[0]) / 2, config.foot_width / 2, half_height]
        body.add("geom", name=name, type="box", pos=centre, size=size, mass=mass)
        return
    if name == config.head:
        tip = np.array(config.tips[name])
        body.add(
            "geom", name=name, type="ellipsoid", pos=tip / 2, size=[row.radius, row.radius * 0.8, tip[2] / 2], mass=mass
        )
        return
    if row.parent is None:
        # The pelvis lies across, between the hip joints.
        hip = np.abs(np.array([config.offsets[r.name] for r in config.joints if r.parent == name and len(r.axes) == 3]))
        half = max(float(hip[:, 1].max()) - 0.02, 0.03)
        body.add("geom", name=name, type="capsule", fromto=[0, -half, 0, 0, half, 0], size=[row.radius], mass=mass)
        return
    end = _next_point(row, config)
    length = float(np.linalg.norm(end))
    # A capsule's caps reach past its ends; shortening keeps neighbours from bulging through each other.
    inset = min(0.4 * length, 0.5 * row.radius) / max(length, 1e-9)
    start, stop = end * inset, end * (1 - inset)
    if np.linalg.norm(stop - start) < 0.01:
        body.add("geom", name=name, type="sphere", pos=end / 2, size=[row.radius], mass=mass)
    else:
        body.add("geom", name=name, type="capsule", fromto=[*start, *stop], size=[row.radius], mass=mass)


def _next_point(row: JointRow, config: HumanoidConfig) -> Array:
    """Where the body's main bone ends: its only child, the middle child, or its tip."""
    if row.name in config.tips:
        return np.array(config.tips[row.name])
    children = [np.array(config.offsets[r.name]) for r in config.joints if r.parent == row.name]
    return min(children, key=lambda c: abs(c[1])) if len(children) > 1 else children[0]
