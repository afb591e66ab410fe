"""Retargeting: parts found on every rig, errors bounded, symmetries kept; then feet on the floor."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers.mocap import RIGS, default_humanoid, rig_motion
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.data.prepare_motion import low_pass, reference_motion, without_lead_in
from egopose.humanoid.foot_geometry import sole_names, sole_positions
from egopose.motion import rotations as rot
from egopose.motion.foot_contact_ik import plant_feet
from egopose.motion.ground_alignment import GroundAlignmentSettings, align_to_ground
from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.io import read_motion
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import identify, side_of
from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget
from egopose.motion.skeleton import Joint, Skeleton, hinges

HUMANOID = default_humanoid()
CLIPS = Path(str(files("egopose") / "assets" / "clips"))


def own_motion(frames: int = 40, seed: int = 0) -> Motion:
    """A smooth motion of the model itself: random but well inside the limits, knees and elbows bending."""
    random = np.random.default_rng(seed)
    low, high = HUMANOID.joint_range.T
    centre, half = np.clip(0.0, low + 0.25, high - 0.25), 0.25
    phase = random.uniform(0, 2 * np.pi, len(low)) + np.linspace(0, 4 * np.pi, frames)[:, None]
    qpos = np.tile(HUMANOID.skeleton.rest_qpos(), (frames, 1))
    qpos[:, :3] = [0.3, -0.2, 1.0]
    qpos[:, 3:7] = rot.from_rotvec(0.2 * np.sin(phase[:, :3]))
    qpos[:, 7:] = centre + half * np.sin(phase)
    return Motion(HUMANOID.skeleton, qpos, 30.0)


def chain(text: str) -> Skeleton:
    """A skeleton from ``name>child>...`` chains; the first name of a chain after the first stands already."""
    joints: list[Joint] = []
    for line in text.split():
        parent = -1
        for name in line.split(">"):
            names = [j.name for j in joints]
            if name not in names:
                joints.append(Joint(name, parent, (0.0, 0.0, 0.1), hinges("zyx") if joints else ()))
                names.append(name)
            parent = names.index(name)
    return Skeleton(tuple(joints), "rig")


# --- whose joint is what ---------------------------------------------------------------------------------------------

#: For every rig: hips, neck (None: none), head, right thigh .. foot, left arm .. hand, right toe (None: none), spine.
EXPECTED = {
    "cc_base": (
        "CC_Base_Pelvis CC_Base_NeckTwist01 CC_Base_Head CC_Base_R_Thigh CC_Base_R_Calf CC_Base_R_Foot "
        "CC_Base_L_Upperarm CC_Base_L_Forearm CC_Base_L_Hand CC_Base_R_ToeBase",
        3,
    ),
    "cmu31": ("Hips Neck Head RightUpLeg RightLeg RightFoot LeftArm LeftForeArm LeftHand RightToeBase", 3),
    "acclaim": ("root lowerneck head rfemur rtibia rfoot lhumerus lradius lwrist rtoes", 3),
    "deepmimic": ("root - neck right_hip right_knee right_ankle left_shoulder left_elbow left_wrist -", 1),
    "bandai": ("Hips Neck Head UpperLeg_R LowerLeg_R Foot_R UpperArm_L LowerArm_L Hand_L Toes_R", 2),
}
PARTS = "hips neck head right_thigh right_shin right_foot left_arm left_forearm left_hand right_toe"


@pytest.mark.parametrize("rig", RIGS)
def test_finds_the_parts_of_every_rig(rig: str, shared: Path, tmp_path: Path) -> None:
    skeleton = rig_motion(rig, shared, tmp_path, seconds=0.2).skeleton
    found = identify(skeleton)
    names, spine = EXPECTED[rig]
    for part, name in zip(PARTS.split(), names.split(), strict=True):
        if name == "-":
            assert part not in found.parts
        else:
            assert skeleton.names[found.parts[part]] == name, part
    assert len(found.spine) == spine
    mapped = {skeleton.names[i] for i in (*found.parts.values(), *found.spine)}
    assert mapped.isdisjoint(found.unmapped)
    assert mapped | set(found.unmapped) == set(skeleton.names)


LIMBS = {
    "smpl": (
        "Pelvis>L_Hip>L_Knee>L_Ankle>L_Foot Pelvis>R_Hip>R_Knee>R_Ankle>R_Foot Pelvis>Spine1>Spine2>Spine3>Neck>Head "
        "Spine3>L_Collar>L_Shoulder>L_Elbow>L_Wrist>L_Hand Spine3>R_Collar>R_Shoulder>R_Elbow>R_Wrist>R_Hand",
        {"left_foot": "L_Ankle", "left_toe": "L_Foot", "right_hand": "R_Wrist", "right_clavicle": "R_Collar"},
    ),
    "mixamo": (
        "mixamorig:Hips>mixamorig:LeftUpLeg>mixamorig:LeftLeg>mixamorig:LeftFoot>mixamorig:LeftToeBase "
        "mixamorig:Hips>mixamorig:RightUpLeg>mixamorig:RightLeg>mixamorig:RightFoot "
        "mixamorig:Hips>mixamorig:Spine>mixamorig:Spine1>mixamorig:Neck>mixamorig:Head "
        "mixamorig:Spine1>mixamorig:LeftShoulder>mixamorig:LeftArm>mixamorig:LeftForeArm>mixamorig:LeftHand"
        ">mixamorig:LeftHandThumb1 "
        "mixamorig:Spine1>mixamorig:RightShoulder>mixamorig:RightArm>mixamorig:RightForeArm>mixamorig:RightHand",
        {"left_hand": "mixamorig:LeftHand", "left_thigh": "mixamorig:LeftUpLeg", "hips": "mixamorig:Hips"},
    ),
    "unreal": (
        "root>ik_foot_root>ik_foot_l root>ik_foot_root>ik_foot_r root>ik_hand_root>ik_hand_gun>ik_hand_l "
        "ik_hand_gun>ik_hand_r root>pelvis>thigh_l>calf_l>foot_l>ball_l pelvis>thigh_r>calf_r>foot_r>ball_r "
        "pelvis>spine_01>spine_02>spine_03>neck_01>head spine_03>clavicle_l>upperarm_l>lowerarm_l>hand_l "
        "spine_03>clavicle_r>upperarm_r>lowerarm_r>hand_r lowerarm_r>lowerarm_twist_01_r",
        {"left_foot": "foot_l", "right_hand": "hand_r", "right_toe": "ball_r", "hips": "pelvis", "neck": "neck_01"},
    ),
    "biped": (
        "Bip01>Bip01_Pelvis>Bip01_L_Thigh>Bip01_L_Calf>Bip01_L_Foot>Bip01_L_Toe0 "
        "Bip01_Pelvis>Bip01_R_Thigh>Bip01_R_Calf>Bip01_R_Foot Bip01_Pelvis>Bip01_Spine>Bip01_Neck>Bip01_Head "
        "Bip01_Neck>Bip01_L_Clavicle>Bip01_L_UpperArm>Bip01_L_Forearm>Bip01_L_Hand "
        "Bip01_Neck>Bip01_R_Clavicle>Bip01_R_UpperArm>Bip01_R_Forearm>Bip01_R_Hand",
        {"left_toe": "Bip01_L_Toe0", "right_arm": "Bip01_R_UpperArm", "right_clavicle": "Bip01_R_Clavicle"},
    ),
}


@pytest.mark.parametrize("convention", LIMBS)
def test_knows_common_naming_conventions(convention: str) -> None:
    text, expected = LIMBS[convention]
    skeleton = chain(text)
    found = identify(skeleton)
    for part, name in expected.items():
        assert skeleton.names[found.parts[part]] == name, part


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("LeftFoot", "left"),
        ("lfoot", "left"),
        ("Foot_R", "right"),
        ("CC_Base_R_Calf", "right"),
        ("right_ankle", "right"),
        ("foot.l", "left"),
        ("Head", None),
        ("LowerBack", None),
        ("root", None),
        ("RHipJoint", "right"),
    ],
)
def test_side_of_a_name(name: str, side: str | None) -> None:
    assert side_of(name) == side


def test_a_skeleton_that_is_no_person_gets_one_clear_error() -> None:
    fish = chain("root>spine>tail>fin")
    with pytest.raises(
        InputError, match=r"rig: mapping\.right_foot: no joint is called ankle or foot.*spine, tail, fin"
    ):
        identify(fish)
    motion = Motion(fish, np.tile(fish.rest_qpos(), (3, 1)), 30.0)
    with pytest.raises(InputError, match=r"mapping\.right_foot"):
        reference_motion(motion, HUMANOID)


def test_feet_without_legs_get_one_clear_error() -> None:
    with pytest.raises(InputError, match="the right limb has too few joints"):
        identify(chain("root>RightFoot root>LeftFoot root>Head root>LeftHand root>RightHand"))


def test_overrides_name_what_names_do_not_say() -> None:
    text = LIMBS["smpl"][0].replace("R_Ankle", "Bone17")
    skeleton = chain(text)
    wrong = identify(skeleton)  # R_Foot, the toes, is all that is left of the right foot's name
    assert skeleton.names[wrong.parts["right_foot"]] == "R_Foot"
    found = identify(skeleton, {"right_foot": "Bone17"})
    assert skeleton.names[found.parts["right_shin"]] == "R_Knee"
    assert skeleton.names[found.parts["right_toe"]] == "R_Foot"
    with pytest.raises(InputError, match=r"mapping\.right_foot: there is no joint 'Bone18'"):
        identify(skeleton, {"right_foot": "Bone18"})
    with pytest.raises(InputError, match=r"mapping\.tail"):
        identify(skeleton, {"tail": "Bone17"})


# --- retargeting -----------------------------------------------------------------------------------------------------

#: Mean over parts and the worst part's mean distance to the scaled source, mm: measured 0.2/0.8, 2.2/7.5, 1.4/5.4,
#: 0.3/1.8, 0.1/0.5 on the first six seconds.
BOUNDS = {
    "cc_base": (0.5, 2.0),
    "cmu31": (3.5, 10.0),
    "acclaim": (2.5, 8.0),
    "deepmimic": (1.0, 3.0),
    "bandai": (0.5, 2),
}


@pytest.mark.parametrize("rig", RIGS)
def test_error_bounds_of_every_rig(rig: str, shared: Path, tmp_path: Path) -> None:
    motion = rig_motion(rig, shared, tmp_path)
    clip, report = retarget(motion, HUMANOID.skeleton, HUMANOID.joint_range)
    means = [mean for mean, _ in report.position_mm.values()]
    assert np.mean(means) < BOUNDS[rig][0]
    assert max(means) < BOUNDS[rig][1]
    assert len(clip) == len(motion)
    assert clip.fps == motion.fps
    low, high = HUMANOID.joint_range.T
    assert (clip.qpos[:, 7:] >= low - 1e-9).all()
    assert (clip.qpos[:, 7:] <= high + 1e-9).all()
    assert 0.9 < report.scale < 1.3
    assert set(report.unmapped) == set(identify(motion.skeleton).unmapped)
    text = report.table()
    assert "left_foot" in text
    assert all(name in text for name in report.unmapped)


@pytest.mark.parametrize("rig", RIGS)
def test_a_walker_looks_ahead_upright_and_puts_feet_down(rig: str, shared: Path, tmp_path: Path) -> None:
    """Outside truth: people walk forward, head over hips over feet, knees bending the one way, each foot in turn."""
    clip, _ = reference_motion(rig_motion(rig, shared, tmp_path), HUMANOID)
    positions, quats = clip.forward_kinematics()
    at = {n: positions[:, i] for i, n in enumerate(HUMANOID.skeleton.names)}
    assert (at["Head"][:, 2] - at["Hips"][:, 2] > 0.4).mean() > 0.9
    forward = rot.rotate(quats[:, 0], np.array([[1.0, 0.0, 0.0]]))
    velocity = np.gradient(at["Hips"], axis=0) * clip.fps
    if rig in ("cc_base", "deepmimic", "bandai"):  # the others climb
        assert np.mean(np.sum(velocity * forward, axis=1)) > 0.3
        assert clip.contacts[:, :2].any()
        assert clip.contacts[:, 2:].any()
    left = np.cross([0, 0, 1.0], forward)
    assert (np.sum((at["LeftArm"] - at["RightArm"]) * left, axis=1) > 0.15).mean() > 0.95
    for side in ("Left", "Right"):
        toes = rot.rotate(quats[:, HUMANOID.skeleton.index(f"{side}Foot")], np.array([[1.0, 0.0, 0.0]]))
        assert np.sum(toes * forward, axis=1).mean() > 0.5
    assert tuple(clip.contact_names) == sole_names(HUMANOID)


def test_its_own_motion_comes_back() -> None:
    motion, _ = reference_motion(read_motion(CLIPS / "cmu07_02.motion.npz"), HUMANOID)
    clip, report = retarget(motion, HUMANOID.skeleton, HUMANOID.joint_range)
    assert report.scale == pytest.approx(1.0, abs=1e-6)
    for part, (mean, _) in report.position_mm.items():
        assert mean < 1.0, part
    ours, theirs = clip.forward_kinematics()[0], motion.forward_kinematics()[0]
    assert np.linalg.norm(ours - theirs, axis=2).mean() < 0.002


WALK = read_motion(CLIPS / "deepmimic_walk.motion.npz").resample(30.0).slice(0, 20)
STRAIGHT = retarget(WALK, HUMANOID.skeleton, HUMANOID.joint_range)


@settings(max_examples=15, deadline=None)
@given(
    turn=st.floats(-np.pi, np.pi),
    east=st.floats(-50.0, 50.0),
    north=st.floats(-50.0, 50.0),
)
def test_where_and_which_way_the_actor_walked_does_not_matter(turn: float, east: float, north: float) -> None:
    heading = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(turn))
    qpos = WALK.qpos.copy()
    qpos[:, :3] = rot.rotate(heading[None], qpos[:, :3]) + np.array([east, north, 0.0])
    qpos[:, 3:7] = rot.multiply(heading[None], qpos[:, 3:7])
    clip, report = retarget(replace(WALK, qpos=qpos), HUMANOID.skeleton, HUMANOID.joint_range)
    straight, straight_report = STRAIGHT
    assert np.abs(clip.qpos[:, 7:] - straight.qpos[:, 7:]).max() < 1e-5
    moved = rot.rotate(heading[None], straight.qpos[:, :3]) + report.scale * np.array([east, north, 0.0])
    assert np.abs(clip.qpos[:, :3] - moved).max() < 1e-5
    turned = rot.multiply(heading[None], straight.qpos[:, 3:7])
    assert np.abs(np.abs(np.sum(clip.qpos[:, 3:7] * turned, axis=1)) - 1).max() < 1e-8
    assert report.scale == pytest.approx(straight_report.scale)


@settings(max_examples=10, deadline=None)
@given(factor=st.floats(0.3, 3.0))
def test_how_tall_the_actor_is_does_not_matter(factor: float) -> None:
    """A giant's walk makes the model walk the same, at the model's own size."""
    joints = tuple(
        replace(j, offset=tuple(factor * np.array(j.offset)), tips=tuple(tuple(factor * np.array(t)) for t in j.tips))
        for j in WALK.skeleton.joints
    )
    qpos = WALK.qpos.copy()
    qpos[:, :3] *= factor
    clip, report = retarget(
        replace(WALK, skeleton=Skeleton(joints), qpos=qpos), HUMANOID.skeleton, HUMANOID.joint_range
    )
    assert report.scale == pytest.approx(STRAIGHT[1].scale / factor, rel=1e-6)
    # Feet are told flat by height and speed in metres, so sizes differ by a little at the ankles.
    positions, wanted = clip.forward_kinematics()[0], STRAIGHT[0].forward_kinematics()[0]
    assert np.linalg.norm(positions - wanted, axis=2).mean() < 0.01


# --- inverse kinematics ----------------------------------------------------------------------------------------------


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_inverse_kinematics_reaches_what_can_be_reached(seed: int) -> None:
    random = np.random.default_rng(seed)
    goal = own_motion(8, seed)
    start = goal.qpos.copy()
    start[:, 7:] = np.clip(start[:, 7:] + random.normal(0, 0.15, start[:, 7:].shape), *HUMANOID.joint_range.T)
    start[:, :3] += random.normal(0, 0.05, (8, 3))
    positions, quats = goal.forward_kinematics()
    names = HUMANOID.skeleton.names
    points = np.array([names.index(n) for n in ("Hips", "Head", "LeftHand", "RightHand", "LeftFoot", "RightFoot")])
    targets = Targets(
        points,
        np.zeros((len(points), 3)),
        positions[:, points],
        np.ones(len(points)),
        np.array([0]),
        quats[:, :1],
        np.ones(1),
    )
    found = solve(HUMANOID.skeleton, start, targets, HUMANOID.joint_range, iterations=20)
    reached = forward_kinematics(HUMANOID.skeleton, found)[0][:, points]
    error = np.linalg.norm(reached - positions[:, points], axis=2).max(axis=1)
    assert np.median(error) < 1e-3
    assert error.max() < 0.05  # a hinge at its limit may keep a frame from the very last
    low, high = HUMANOID.joint_range.T
    assert (found[:, 7:] >= low).all()
    assert (found[:, 7:] <= high).all()


def test_what_cannot_be_reached_is_approached_within_limits() -> None:
    goal = own_motion(4)
    targets = Targets(
        np.array([0, HUMANOID.skeleton.index("LeftHand")]),
        np.zeros((2, 3)),
        np.stack([goal.qpos[:, :3], goal.qpos[:, :3] + [0.0, 5.0, 0.5]], axis=1),
        np.array([10.0, 1.0]),
        np.array([0]),
        goal.qpos[:, None, 3:7],
        np.array([10.0]),
    )
    found = solve(HUMANOID.skeleton, goal.qpos, targets, HUMANOID.joint_range, iterations=30)
    assert np.isfinite(found).all()
    hand = forward_kinematics(HUMANOID.skeleton, found)[0][:, HUMANOID.skeleton.index("LeftHand")]
    assert (hand[:, 1] - found[:, 1] > 0.5).all()  # stretched towards it


# --- the floor -------------------------------------------------------------------------------------------------------


def standing(frames: int, height: float = 0.0) -> Motion:
    """The model upright on flat soles ``height`` metres over the floor."""
    qpos = np.tile(HUMANOID.skeleton.rest_qpos(), (frames, 1))
    motion = Motion(HUMANOID.skeleton, qpos, 30.0)
    qpos[:, 2] = -sole_positions(HUMANOID, motion)[0, :, 2].min() + height
    return replace(motion, qpos=qpos)


def jump(frames: int = 90, apex: float = 0.5) -> Motion:
    """Stands, flies a parabola of ``apex`` metres in the middle third, stands."""
    motion = standing(frames)
    third = frames // 3
    phase = np.linspace(-1, 1, third)
    qpos = motion.qpos.copy()
    qpos[third : 2 * third, 2] += apex * (1 - phase**2)
    return replace(motion, qpos=qpos)


@settings(max_examples=20, deadline=None)
@given(height=st.floats(-3.0, 3.0))
def test_a_standing_body_is_put_on_the_floor_from_anywhere(height: float) -> None:
    motion = standing(30, height)
    settled, shift = align_to_ground(motion, sole_positions(HUMANOID, motion), GroundAlignmentSettings(depth=0.004))
    assert sole_positions(HUMANOID, settled)[..., 2] == pytest.approx(-0.004, abs=1e-6)
    assert shift == pytest.approx(-height - 0.004, abs=1e-6)
    assert settled.contacts is not None
    assert settled.contacts.all()
    assert np.array_equal(np.delete(settled.qpos, 2, axis=1), np.delete(motion.qpos, 2, axis=1))


def test_a_flight_keeps_its_height_and_its_pose() -> None:
    motion = jump()
    settled, _ = align_to_ground(motion, sole_positions(HUMANOID, motion))
    assert settled.contacts is not None
    assert not settled.contacts[35:55].any()
    flight = settled.qpos[30:60, 2] - settled.qpos[10, 2]
    assert flight.max() == pytest.approx(0.5, abs=0.02)
    planted = plant(settled)
    assert np.abs(planted.qpos[38:52, 7:] - settled.qpos[38:52, 7:]).max() < 1e-3
    assert np.abs(planted.qpos[:, :3] - settled.qpos[:, :3]).max() < 2e-3


def test_a_flight_falls_as_gravity_has_it() -> None:
    """A jump two thirds as high as its time in the air asks for comes nearer to the height of g's own."""
    frames, third = 90, 30
    fall = 0.125 * 9.81 * ((third + 1) / 30.0) ** 2
    flat = jump(frames, apex=0.67 * fall)
    body = flat.qpos[:, :3]
    plain, _ = align_to_ground(flat, sole_positions(HUMANOID, flat), GroundAlignmentSettings(largest=1.0))
    held, _ = align_to_ground(
        flat, sole_positions(HUMANOID, flat), GroundAlignmentSettings(largest=1.0), center_of_mass=body
    )
    rise = [float((m.qpos[30:60, 2] - m.qpos[10, 2]).max()) for m in (plain, held)]
    assert rise[0] == pytest.approx(0.67 * fall, rel=0.05)
    assert fall - rise[1] < 0.8 * (fall - rise[0])


def test_a_body_that_does_not_fall_is_put_on_the_floor() -> None:
    """Feet too quick to count as touching (a run whose root the export flattened), 4 cm up: something carries them."""
    motion = standing(90)
    qpos = motion.qpos.copy()
    qpos[:, 0] += 3.0 * np.arange(90) / 30.0
    qpos[:, 2] += 0.04 * np.sin(np.arange(90) * 0.2) ** 2
    floating = replace(motion, qpos=qpos)
    settled, _ = align_to_ground(floating, sole_positions(HUMANOID, floating), center_of_mass=floating.qpos[:, :3])
    assert np.abs(sole_positions(HUMANOID, settled)[..., 2] + 0.004).max() < 0.01


def test_a_slow_drift_of_the_floor_is_taken_out() -> None:
    motion = standing(300)
    qpos = motion.qpos.copy()
    qpos[:, 2] += np.linspace(-0.04, 0.04, 300)
    drifting = replace(motion, qpos=qpos)
    settled, _ = align_to_ground(drifting, sole_positions(HUMANOID, drifting))
    assert np.abs(sole_positions(HUMANOID, settled)[..., 2] + 0.004).max() < 0.005


def plant(motion: Motion) -> Motion:
    return plant_feet(
        motion,
        np.repeat(HUMANOID.feet, 2),
        HUMANOID.sole_points.reshape(-1, 3),
        sole_positions(HUMANOID, motion),
        HUMANOID.joint_range,
        0.004,
    )


def test_a_tilted_foot_is_planted_flat() -> None:
    motion = standing(40)
    qpos = motion.qpos.copy()
    for name, degrees in (("UpLeg_0", -20.0), ("Leg_0", 40.0), ("Foot_0", -20.0)):
        for side in ("Left", "Right"):
            qpos[:, 7 + HUMANOID.mj_model.actuator(side + name).id] = np.deg2rad(degrees)
    qpos[:, 7 + HUMANOID.mj_model.actuator("LeftFoot_0").id] += np.deg2rad(6.0)
    crouched = replace(motion, qpos=qpos)
    tilted, _ = align_to_ground(crouched, sole_positions(HUMANOID, crouched))
    before, after = (sole_positions(HUMANOID, m)[..., 2] for m in (tilted, plant(tilted)))
    assert np.abs(before + 0.004).max() > 0.01
    assert np.abs(after + 0.004).max() < 0.003


def test_a_straight_leg_is_not_thrown_about() -> None:
    """A straight leg's knee hardly moves its foot up or down: full Gauss-Newton steps once kicked it 1.1 m high."""
    motion = standing(40)
    qpos = motion.qpos.copy()
    qpos[:, 7 + HUMANOID.mj_model.actuator("LeftFoot_0").id] = np.deg2rad(6.0)
    tilted, _ = align_to_ground(replace(motion, qpos=qpos), sole_positions(HUMANOID, replace(motion, qpos=qpos)))
    planted = plant(tilted)
    assert np.abs(planted.qpos[:, 7:] - tilted.qpos[:, 7:]).max() < np.deg2rad(20.0)
    before, after = (np.abs(sole_positions(HUMANOID, m)[..., 2] + 0.004).max() for m in (tilted, planted))
    assert after < before + 1e-3


def test_planting_needs_contacts() -> None:
    with pytest.raises(ValueError, match="settle it first"):
        plant(standing(5))


@pytest.mark.parametrize("name", ["cmu07_02", "deepmimic_turn_left0", "deepmimic_cartwheel"])
def test_soles_of_real_clips_stand_on_the_floor(name: str) -> None:
    clip, report = reference_motion(read_motion(CLIPS / f"{name}.motion.npz"), HUMANOID)
    heights = sole_positions(HUMANOID, clip)[..., 2]
    assert clip.contacts is not None
    assert clip.contacts.any(axis=1).mean() > 0.5
    assert heights.min() > -0.012  # none sinks deeper
    touching = heights[clip.contacts]
    assert touching.mean() == pytest.approx(-0.004, abs=0.005)
    assert np.quantile(np.abs(touching + 0.004), 0.9) < 0.012
    assert abs(report.ground_shift_m[0]) < 2.0
    assert clip.qpos[0, :2] == pytest.approx([0.0, 0.0])


# --- before and after ------------------------------------------------------------------------------------------------


def test_low_pass_keeps_slow_and_drops_fast() -> None:
    time = np.arange(240) / 60.0
    motion = replace(own_motion(240), fps=60.0)
    slow, fast = 0.3 * np.sin(2 * np.pi * 1.0 * time), 0.1 * np.sin(2 * np.pi * 20.0 * time)
    qpos = motion.qpos.copy()
    qpos[:, 7], qpos[:, 8] = slow, fast
    out = low_pass(replace(motion, qpos=qpos), 8.0).qpos
    inner = slice(20, -20)
    assert np.abs(out[inner, 7] - slow[inner]).max() < 0.005  # no lag either
    assert np.abs(out[inner, 8]).max() < 0.01
    assert np.linalg.norm(out[:, 3:7], axis=1) == pytest.approx(1.0)


def test_low_pass_is_not_fooled_by_a_quaternions_sign() -> None:
    motion = replace(own_motion(60), fps=60.0)
    flipped = motion.qpos.copy()
    flipped[20:40, 3:7] *= -1
    one, other = low_pass(motion, 8.0).qpos, low_pass(replace(motion, qpos=flipped), 8.0).qpos
    assert np.abs(np.abs(np.sum(one[:, 3:7] * other[:, 3:7], axis=1)) - 1).max() < 1e-9


def test_low_pass_leaves_what_it_cannot_filter() -> None:
    short = own_motion(5)
    assert low_pass(short, 8.0) is short
    slow = replace(own_motion(40), fps=12.0)
    assert low_pass(slow, 8.0) is slow


def test_a_t_pose_before_the_clip_is_dropped_and_nothing_else() -> None:
    rest = np.tile(WALK.skeleton.rest_qpos(), (1, 1))
    with_pose = replace(WALK, qpos=np.concatenate([rest, WALK.qpos]), contacts=None, torques=None)
    assert np.array_equal(without_lead_in(with_pose).qpos, WALK.qpos)
    assert np.array_equal(without_lead_in(without_lead_in(with_pose)).qpos, WALK.qpos)
    assert len(without_lead_in(WALK)) == len(WALK)
    assert len(without_lead_in(WALK.slice(0, 2))) == 2


def test_a_clip_of_one_frame_is_prepared() -> None:
    clip, _ = reference_motion(WALK.slice(0, 1), HUMANOID)
    assert len(clip) == 1
    assert np.isfinite(clip.qpos).all()
