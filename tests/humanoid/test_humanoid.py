"""The humanoid against its table, MuJoCo's own kinematics, and the skeletons it is fitted to."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_config, default_humanoid, rig_motion

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.prepare_motion import reference_motion
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.humanoid.from_motion import config_from_motion, humanoid_from_motion
from egopose.humanoid.model import build_humanoid, sole_points
from egopose.motion import rotations as rot
from egopose.motion.io import read_motion
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.retarget import retarget
from egopose.motion.skeleton import Joint, Skeleton

NAMES = [
    *("Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot"),
]


def random_qpos(frames: int, seed: int = 0) -> np.ndarray:
    """Poses inside the joint limits, anywhere, turned anyhow."""
    random, humanoid = np.random.default_rng(seed), default_humanoid()
    qpos = random.normal(size=(frames, humanoid.skeleton.nq))
    qpos[:, 3:7] = rot.normalize(qpos[:, 3:7])
    low, high = humanoid.joint_range.T
    qpos[:, 7:] = random.uniform(low, high, size=(frames, len(low)))
    return qpos


# --- the table -----------------------------------------------------------------------------------------------------


def test_58_degrees_of_freedom_and_21_bodies_under_their_names() -> None:
    humanoid = default_humanoid()
    model = humanoid.mj_model
    assert (model.nq, model.nv, model.nu) == (59, 58, 52)
    assert [model.body(int(i)).name for i in humanoid.body_ids] == NAMES == list(humanoid.skeleton.names)
    assert model.nbody == 22  # and the world
    hinges = [f"{j.name}_{k}" for j in humanoid.skeleton.joints for k in range(len(j.dofs))]
    assert [model.joint(i).name for i in range(1, model.njnt)] == hinges
    assert [model.actuator(i).name for i in range(model.nu)] == hinges
    assert all(
        len(humanoid.skeleton.joints[humanoid.skeleton.index(n)].dofs) == 1 for n in NAMES if n.endswith("ForeArm")
    )
    assert all(len(humanoid.skeleton.joints[humanoid.skeleton.index(n)].dofs) == 1 for n in ("RightLeg", "LeftLeg"))


def test_the_metrics_hands_are_qpos_32_to_35_and_42_to_45() -> None:
    """The layout SPEC's metrics zero: the authors' 7 + 52."""
    humanoid = default_humanoid()
    assert (humanoid.hand_dofs + 7).tolist() == [32, 33, 34, 42, 43, 44]


def test_an_adult_with_the_tables_mass_armature_and_ranges() -> None:
    humanoid, config = default_humanoid(), default_config()
    model = humanoid.mj_model
    assert model.body_mass[humanoid.body_ids].sum() == pytest.approx(70.0, abs=1e-9)
    assert 60.0 <= config.total_mass <= 75.0
    # The joints' own armature and stable PD's share of the damping (egopose.humanoid.model).
    assert np.allclose(model.dof_armature[6:], 0.01 + humanoid.kd * model.opt.timestep)
    assert np.allclose(model.dof_armature[:6], 0.0)
    assert np.allclose(model.jnt_range[1:], humanoid.joint_range)
    assert model.jnt_limited[1:].all()
    right_knee = humanoid.joint_range[model.actuator("RightLeg_0").id]
    assert np.allclose(np.rad2deg(right_knee), [-5.0, 170.0])
    right_arm, left_arm = (model.body_mass[humanoid.body_ids[part]] for part in (slice(7, 11), slice(11, 15)))
    assert right_arm == pytest.approx(left_arm)


@pytest.mark.parametrize("substeps", [5, 15])
def test_actuators_are_stable_pd_at_the_tables_gains(substeps: int) -> None:
    humanoid = default_humanoid(substeps)
    model = humanoid.mj_model
    assert model.opt.timestep == pytest.approx(1 / 30 / substeps)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert np.allclose(humanoid.kd, 0.1 * humanoid.kp)
    assert np.allclose(model.actuator_gainprm[:, 0], humanoid.kp)
    assert np.allclose(model.actuator_biasprm[:, 1], -humanoid.kp)
    assert np.allclose(model.actuator_biasprm[:, 2], -(humanoid.kd + humanoid.kp * model.opt.timestep))
    limits = np.stack([-humanoid.torque_limit, humanoid.torque_limit], axis=1)
    assert np.allclose(model.jnt_actfrcrange[1:], limits)
    assert model.jnt_actfrclimited[1:].all()
    data = mujoco.MjData(model)
    data.qpos[2] = 3.0
    data.ctrl[:] = 10.0
    mujoco.mj_forward(model, data)
    assert np.allclose(data.qfrc_actuator[6:], humanoid.torque_limit)
    # The authors' gains are for 28.5 kg: 50 .. 500 times the mass's ratio.
    ratio = 70.0 / 28.5
    assert humanoid.kp.min() == pytest.approx(50 * ratio)
    assert humanoid.kp.max() == pytest.approx(500 * ratio)


def test_twice_the_mass_with_its_gains_moves_the_same() -> None:
    """Mass, gains and limits scale together, so one table serves every adult: only the armature does not."""
    config = replace(default_config(), armature=0.0)
    moved = []
    for mass in (28.5, 57.0):
        humanoid = build_humanoid(replace(config, total_mass=mass), SimConfig())
        data = mujoco.MjData(humanoid.mj_model)
        data.qpos[2] = 3.0
        data.ctrl[:] = humanoid.rest_action
        mujoco.mj_step(humanoid.mj_model, data, 60)
        moved.append(data.qpos.copy())
    # MuJoCo's solver stops by tolerance, not exactly.
    assert np.abs(moved[0] - moved[1]).max() < 1e-4


def test_rest_action_bends_knees_and_elbows_and_lets_the_arms_hang() -> None:
    humanoid = default_humanoid()
    qpos = humanoid.skeleton.rest_qpos()
    qpos[7:] = humanoid.rest_action
    positions, _ = forward_kinematics(humanoid.skeleton, qpos)
    at = {n: positions[humanoid.skeleton.index(n)] for n in NAMES}
    assert np.sort(np.rad2deg(np.abs(humanoid.rest_action[humanoid.rest_action != 0]))) == pytest.approx(
        [45, 45, 45, 45, 80, 80]
    )
    for side in ("Right", "Left"):
        drop = at[f"{side}Arm"][2] - at[f"{side}ForeArm"][2]
        assert drop == pytest.approx(np.sin(np.deg2rad(80)) * np.linalg.norm(at[f"{side}ForeArm"] - at[f"{side}Arm"]))
        assert at[f"{side}Foot"][0] < at[f"{side}Leg"][0] - 0.1  # the shin goes back
        assert at[f"{side}Hand"][0] > at[f"{side}ForeArm"][0] + 0.1  # the forearm goes ahead
    assert at["LeftHand"][1] > 0 > at["RightHand"][1]


def test_the_sole_under_the_box_is_where_it_says() -> None:
    humanoid = default_humanoid()
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    mujoco.mj_kinematics(model, data)
    for foot, points in zip(humanoid.feet, humanoid.sole_points, strict=True):
        geom = model.geom(NAMES[foot]).id
        corner = data.geom_xpos[geom] - data.xpos[humanoid.body_ids[foot]]
        assert corner[2] - model.geom_size[geom, 2] == pytest.approx(points[0, 2]) == pytest.approx(points[1, 2])
        assert corner[0] - model.geom_size[geom, 0] == pytest.approx(points[0, 0])
        assert corner[0] + model.geom_size[geom, 0] == pytest.approx(points[1, 0])
    assert sole_points(default_config(), "LeftFoot") == pytest.approx(humanoid.sole_points[1])


def test_out_of_the_floor_no_foot_touches_deeper_than_the_surface() -> None:
    """By MuJoCo's own contacts; what stood clear stays where it was, and nothing but the height changes."""
    humanoid = default_humanoid()
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    qpos = random_qpos(40)
    qpos[:, 2] = np.random.default_rng(1).uniform(0.3, 1.5, size=40)
    raised = out_of_floor(humanoid, qpos)
    np.testing.assert_array_equal(np.delete(raised, 2, axis=1), np.delete(qpos, 2, axis=1))
    feet, depths = {int(humanoid.body_ids[foot]) for foot in humanoid.feet}, []
    for before, after in zip(qpos, raised, strict=True):
        deepest = []
        for pose in (before, after):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            touching = [
                c.dist for c in data.contact if {int(model.geom_bodyid[g]) for g in c.geom} & feet and 0 in c.geom
            ]
            deepest.append(min(touching, default=0.0))
        assert deepest[1] > -1e-6
        assert (after[2] > before[2]) == (deepest[0] < -1e-6)
        depths.append(deepest[0])
    assert sum(depth < -0.01 for depth in depths) > 5


def test_it_stands_still_in_the_rest_pose() -> None:
    """A second of simulation upright with straight legs: soles carry the body, nothing trembles or sinks."""
    humanoid = default_humanoid()
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    data.qpos[2] = 0.0222 + 0.4767 + 0.4982 + 0.075
    ctrl = np.zeros(52)
    data.ctrl[:] = ctrl
    height = []
    for _ in range(30):
        mujoco.mj_step(model, data, humanoid.substeps)
        height.append(data.qpos[2])
    assert np.ptp(height[5:15]) < 0.01
    assert np.isfinite(data.qpos).all()


# --- kinematics ----------------------------------------------------------------------------------------------------


def test_the_projects_kinematics_are_mujocos() -> None:
    humanoid = default_humanoid()
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    poses = random_qpos(200)
    positions, quats = forward_kinematics(humanoid.skeleton, poses)
    for t, qpos in enumerate(poses):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        assert np.abs(positions[t] - data.xpos[humanoid.body_ids]).max() < 1e-9
        off = np.abs(np.sum(quats[t] * data.xquat[humanoid.body_ids], axis=1))
        assert np.abs(off - 1).max() < 1e-9


# --- from any skeleton ---------------------------------------------------------------------------------------------


#: The source's joints in the order thigh, shin, foot, arm, forearm, hand.
SOURCE_LIMBS = {
    "cmu31": "{}UpLeg {}Leg {}Foot {}Arm {}ForeArm {}Hand",
    "deepmimic": "{}_hip {}_knee {}_ankle {}_shoulder {}_elbow {}_wrist",
    "bandai": "UpperLeg_{} LowerLeg_{} Foot_{} UpperArm_{} LowerArm_{} Hand_{}",
}
SIDE_NAMES = {"cmu31": ("Left", "Right"), "deepmimic": ("left", "right"), "bandai": ("L", "R")}


@pytest.mark.parametrize("rig", ["cmu31", "deepmimic", "bandai"])
def test_a_humanoid_from_any_skeleton_in_one_call(rig: str, shared: Path, tmp_path: Path) -> None:
    motion = rig_motion(rig, shared, tmp_path)
    humanoid = humanoid_from_motion(motion, default_config(), SimConfig())
    model = humanoid.mj_model
    assert (model.nv, model.nu, len(humanoid.body_ids)) == (58, 52, 21)
    assert model.body_mass[humanoid.body_ids].sum() == pytest.approx(70.0)
    assert np.allclose(humanoid.kp, default_humanoid().kp)
    clip, report = retarget(motion, humanoid.skeleton, humanoid.joint_range)
    assert report.scale == pytest.approx(1.0, abs=0.01)
    assert np.mean([mean for mean, _ in report.position_mm.values()]) < 5.0
    # Limbs have the source's own lengths, and its joints are where the source's are, without any scaling.
    source, _ = motion.forward_kinematics()
    reached, _ = clip.forward_kinematics()
    for side_name, side in zip(SIDE_NAMES[rig], ("Left", "Right"), strict=True):
        wanted = [motion.skeleton.index(n) for n in SOURCE_LIMBS[rig].format(*[side_name] * 6).split()]
        own = [humanoid.skeleton.index(side + n) for n in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand")]
        for a, b in ((0, 1), (1, 2), (3, 4), (4, 5)):
            long = np.median(np.linalg.norm(source[:, wanted[a]] - source[:, wanted[b]], axis=1))
            assert np.linalg.norm(humanoid.skeleton.offsets[own[b]]) == pytest.approx(long, rel=0.03)
        legs = np.linalg.norm(reached[:, own[:3]] - source[:, wanted[:3]], axis=2)
        assert legs.mean() < 0.015


def test_its_own_motion_gives_back_the_default_table() -> None:
    humanoid, config = default_humanoid(), default_config()
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (60, 1))
    qpos[:, 7:] = np.sin(np.linspace(0, 6, 60))[:, None] * 0.1
    qpos[:, 7:] = np.clip(qpos[:, 7:], *humanoid.joint_range.T)
    fitted = config_from_motion(Motion(humanoid.skeleton, qpos, 30.0), config)
    for name, offset in config.offsets.items():
        assert np.allclose(fitted.offsets[name], offset, atol=0.004), name
    for key in ("ankle_height", "heel_length", "foot_width", "total_mass"):
        assert getattr(fitted, key) == pytest.approx(getattr(config, key), rel=1e-6)


@pytest.mark.parametrize("factor", [0.6, 1.3])
def test_a_child_and_a_giant(factor: float) -> None:
    """A skeleton scaled as a whole gives a humanoid scaled as a whole."""
    humanoid = default_humanoid()
    joints = tuple(
        Joint(
            j.name,
            j.parent,
            tuple(factor * x for x in j.offset),  # type: ignore[arg-type]
            j.dofs,
            tuple(tuple(factor * x for x in tip) for tip in j.tips),  # type: ignore[misc]
        )
        for j in humanoid.skeleton.joints
    )
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (4, 1))
    fitted = config_from_motion(Motion(Skeleton(joints), qpos, 30.0), default_config())
    for name, offset in default_config().offsets.items():
        assert np.allclose(fitted.offsets[name], factor * np.array(offset), atol=1e-6), name
    assert fitted.ankle_height == pytest.approx(factor * 0.075)
    assert fitted.tips["Head"][2] == pytest.approx(factor * 0.20)
    build_humanoid(fitted)


# --- bad tables ----------------------------------------------------------------------------------------------------


def table() -> dict:
    return compose_config("prepare")["humanoid"]


def test_a_missing_value_is_named() -> None:
    values = table()
    del values["ankle_height"]
    with pytest.raises(InputError, match="ankle_height: is missing"):
        HumanoidConfig.from_mapping(values)


def test_a_joint_with_too_few_ranges_is_named() -> None:
    values = table()
    values["joints"][1]["range_deg"] = [[-45, 60]]
    with pytest.raises(InputError, match=r"joints\.Spine\.range_deg: needs 3 ranges"):
        HumanoidConfig.from_mapping(values)


def test_an_unknown_foot_is_named() -> None:
    values = table() | {"feet": ["RightFoot", "LeftHoof"]}
    with pytest.raises(InputError, match="feet: no such joints: LeftHoof"):
        HumanoidConfig.from_mapping(values)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("rest_action_deg", {"RightKnee_0": 45.0}),
        ("offsets", {"Tail": [0, 0, 1]}),
        ("tips", {"Tail": [0, 0, 1]}),
        ("head", "Haed"),
    ],
)
def test_a_name_that_is_no_joint_is_an_input_error(field: str, change: object) -> None:
    values = table()
    values[field] = {**values[field], **change} if isinstance(change, dict) else change
    with pytest.raises(InputError, match=field):
        HumanoidConfig.from_mapping(values)


def test_a_parent_that_comes_later_is_an_input_error() -> None:
    values = table()
    values["joints"][1]["parent"] = "Head"
    with pytest.raises(InputError, match=r"joints\.Spine\.parent"):
        HumanoidConfig.from_mapping(values)


def test_an_axis_that_is_no_direction_is_an_input_error() -> None:
    values = table()
    values["joints"][1]["axes"][0] = [0, 0, 0]
    with pytest.raises(InputError, match=r"joints\.Spine\.axes"):
        HumanoidConfig.from_mapping(values)


def test_the_quicker_solver_moves_the_body_alike() -> None:
    """A control step from frames of a real walk, soles on the floor: PGS and Newton within 1e-6 rad and m."""
    clip = Path(str(files("egopose") / "assets" / "clips" / "cmu07_02.motion.npz"))
    walk, _ = reference_motion(read_motion(clip), default_humanoid())
    qvel = finite_difference(walk.qpos, walk.fps)
    after = []
    for solver in ("Newton", "PGS"):
        humanoid = build_humanoid(default_config(), SimConfig(substeps=4, solver=solver))
        data = mujoco.MjData(humanoid.mj_model)
        moved = []
        for frame in range(0, len(walk) - 1, 5):
            mujoco.mj_resetData(humanoid.mj_model, data)
            data.qpos[:], data.qvel[:], data.ctrl[:] = walk.qpos[frame], qvel[frame], walk.qpos[frame + 1, 7:]
            mujoco.mj_step(humanoid.mj_model, data, humanoid.substeps)
            moved.append(data.qpos.copy())
        after.append(np.array(moved))
    assert np.abs(after[0] - after[1]).max() < 1e-6
    with pytest.raises(ValueError, match="Newton or PGS"):
        SimConfig(solver="CG")
