"""Retargeting from rigs of every kind: flat feet, straight hinges, split limbs, people on their toes, hands and backs.

One person on many rigs (``rigs.py``, and the files of ``shared/cases``): whatever the rig, the motion comes out alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.rigs import PLAIN, STANDING, Rig, write_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.data.prepare_motion import reference_motion, without_lead_in
from egopose.humanoid.foot_geometry import lowest_points, sole_positions
from egopose.motion import rotations as rot
from egopose.motion.calibration import Stance
from egopose.motion.feet import Foot, foot_constants
from egopose.motion.io import read_motion
from egopose.motion.mapping import identify, sample
from egopose.motion.motion import Motion
from egopose.motion.retarget import RetargetReport

HUMANOID = default_humanoid()
Prepared = tuple[Motion, RetargetReport]
HALVES = dict.fromkeys(("thigh", "shin", "arm", "forearm"), (0.5,))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Rig], Prepared]:
    """The reference clip of a rig's person."""
    folder = tmp_path_factory.mktemp("rigs")

    def prepare(rig: Rig) -> Prepared:
        return reference_motion(read_motion(write_rig(rig, folder / "rig.bvh")), HUMANOID)

    kept: dict[str, Prepared] = {}
    return lambda rig: kept[repr(rig)] if repr(rig) in kept else kept.setdefault(repr(rig), prepare(rig))


@lru_cache
def case(path: Path) -> Prepared:
    return reference_motion(read_motion(path), HUMANOID)


def apart(ours: Motion, theirs: Motion) -> float:
    """The largest distance of two clips' joints, m."""
    return float(np.linalg.norm(ours.forward_kinematics()[0] - theirs.forward_kinematics()[0], axis=2).max())


def slopes(clip: Motion) -> np.ndarray:
    """``[T, 2]`` degrees by which the soles' heels are above their balls."""
    soles = sole_positions(HUMANOID, clip).reshape(len(clip), 2, 2, 3)
    line = soles[:, :, 1] - soles[:, :, 0]
    return np.rad2deg(np.arcsin(-line[..., 2] / np.linalg.norm(line, axis=-1)))


# --- feet ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["foot_20", "foot_34", "foot_39", "foot_48"])
def test_soles_are_flat_in_the_cases(name: str, shared: Path) -> None:
    clip, report = case(shared / "cases" / f"{name}.bvh")
    assert apart(clip, case(shared / "cases" / "plain.bvh")[0]) < 0.020
    assert np.abs(slopes(clip)).max() < 3.0
    assert clip.contacts is not None
    assert clip.contacts.mean() > 0.95  # heels too
    assert not report.warnings


@settings(max_examples=12, deadline=None)
@given(
    angle=st.floats(0.0, 66.0),
    toe=st.sampled_from(["joint", "bare", "end"]),
    folded=st.booleans(),
    squats=st.booleans(),
)
def test_soles_are_flat_however_steep_the_rig(
    prepared: Callable[[Rig], Prepared], angle: float, toe: str, folded: bool, squats: bool
) -> None:
    rig = replace(PLAIN if squats else STANDING, foot_angle=angle, toe=toe, folded=folded, seconds=2.0)
    clip, report = prepared(rig)
    assert np.abs(slopes(clip)).max() < 3.0
    assert not report.warnings
    plain, _ = prepared(replace(rig, foot_angle=PLAIN.foot_angle, toe="joint"))
    assert apart(clip, plain) < 0.001


@pytest.mark.parametrize(("angle", "toe"), [(0.0, "joint"), (12.0, "end"), (34.0, "bare"), (60.0, "joint")])
@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_a_person_on_tiptoe_stays_so(prepared: Callable[[Rig], Prepared], share: float, angle: float, toe: str) -> None:
    rig = replace(PLAIN, tiptoe=share, foot_angle=angle, toe=toe)
    clip, report = prepared(rig)
    up = round((1 - share) * len(clip)) + 15 if share < 1 else 0
    assert slopes(clip)[up:] == pytest.approx(rig.rise, abs=3.0)
    if share < 1:
        assert np.abs(slopes(clip)[: round((1 - share) * len(clip)) - 5]).max() < 3.0
    assert bool(report.warnings) == (share == 1.0)  # a rig could be so steep: it is said
    assert all("on its toes" in line for line in report.warnings)


def test_of_two_feet_the_flatter_one_shows_the_rig() -> None:
    """No rest pose that stands, and one foot always on its toes: the other shows how flat the rig's is."""
    still = np.zeros((20, 1))
    line = np.array([0.13, 0.0, -0.05])
    across = np.array([0.0, 1.0, 0.0])
    stance = Stance(np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), {}, is_rest=False)

    def foot(joint: int, rise: float) -> Foot:
        quats = np.tile(rot.from_axis_angle(across, np.array(np.deg2rad(rise))), (20, 1))
        ankle = np.array([0.0, 0.0, 0.3]) + still
        side = across + still
        return Foot(
            joint, quats, ankle, ankle + rot.rotate(quats, line[None]), side, np.array([0.13, 0, -0.03]), across
        )

    feet = {"left": foot(0, 0.0), "right": foot(1, 40.0)}
    constants = foot_constants(feet, stance, np.ones(20), 1.0, 30.0)
    for side, rise in (("left", 0.0), ("right", 40.0)):
        forward = rot.rotate(rot.multiply(feet[side].quats[0], constants[side]), np.array([1.0, 0.0, 0.0]))
        assert np.rad2deg(np.arcsin(-forward[2])) == pytest.approx(rise, abs=0.1)


# --- hinges ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("knee", [-2, -4, -6])
def test_hyperextended_knees_stand_in_the_cases(knee: int, shared: Path) -> None:
    clip, report = case(shared / "cases" / f"stand_knee{knee}.bvh")
    straight, _ = case(shared / "cases" / "stand_knee0.bvh")
    assert np.abs(clip.qpos[:, 2] - straight.qpos[:, 2]).max() < 0.01
    assert apart(clip, straight) < 0.020
    assert np.abs(slopes(clip)).max() < 3.0
    assert not report.warnings


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize(("knee", "elbow"), [(0, 0), (-3, -3), (-8, 10), (5, -8), (0, -15), (-10, 0), (12, 15)])
def test_hinges_that_hardly_bend_keep_their_side(
    prepared: Callable[[Rig], Prepared], knee: float, elbow: float, folded: bool
) -> None:
    straight, _ = prepared(replace(STANDING, folded=folded))
    clip, report = prepared(replace(STANDING, knee=knee, elbow=elbow, folded=folded))
    assert np.abs(clip.qpos[:, 2] - straight.qpos[:, 2]).max() < 0.02
    # Every joint but the hands, which swing by 25 degrees of the forearm, stays near.
    places = [i for i, name in enumerate(HUMANOID.skeleton.names) if not name.endswith("Hand")]
    distance = clip.forward_kinematics()[0] - straight.forward_kinematics()[0]
    assert np.linalg.norm(distance[:, places], axis=2).max() < 0.06
    assert max(largest for _, largest in report.position_mm.values()) < 50.0
    # Hands hang before the body as far as the elbow says, not behind it.
    names = HUMANOID.skeleton.names
    angle = clip.qpos[:, 7 + HUMANOID.mj_model.actuator("LeftForeArm_0").id]
    assert np.rad2deg(angle) == pytest.approx(max(elbow, -10.0), abs=2.0), names


def test_the_other_side_says_how_a_stiff_limb_bends(prepared: Callable[[Rig], Prepared]) -> None:
    """An arm hyperextended in every frame, beside one that bends: both elbows' axes lie alike."""
    clip, _ = prepared(replace(PLAIN, elbow=-6.0))
    straight, _ = prepared(replace(PLAIN, elbow=0.0))
    assert apart(clip, straight) < 0.06


# --- limbs of several bones ------------------------------------------------------------------------------------------


def test_split_limbs_in_the_case(shared: Path) -> None:
    clip, report = case(shared / "cases" / "split_makehuman.bvh")
    plain, plain_report = case(shared / "cases" / "plain.bvh")
    assert apart(clip, plain) < 0.020
    assert report.scale == pytest.approx(plain_report.scale, rel=1e-3)
    assert not report.warnings


@pytest.mark.parametrize(
    ("split", "name"),
    [
        (HALVES, "{name}0{number}"),
        (HALVES, "{name}Twist"),
        ({"thigh": (0.3,), "shin": (0.7,), "arm": (0.7,), "forearm": (0.35,)}, "bone{name}{number}x"),
        ({"thigh": (0.3, 0.6), "shin": (0.25, 0.5, 0.75), "arm": (0.4, 0.8)}, "{name}Share{number}"),
        ({"thigh": (0.0,), "shin": (1e-4,), "arm": (0.999,)}, "{name}0{number}"),
        ({"forearm": (0.5,)}, "{name}0{number}"),
    ],
)
@pytest.mark.parametrize("rig", [PLAIN, STANDING, replace(PLAIN, folded=True)], ids=["squat", "stand", "folded"])
def test_limbs_of_several_bones(
    prepared: Callable[[Rig], Prepared], rig: Rig, split: dict[str, tuple[float, ...]], name: str
) -> None:
    whole, _ = prepared(rig)
    clip, report = prepared(replace(rig, split=split, split_names=name, twist=30.0))
    assert apart(clip, whole) < 0.005
    assert report.scale == pytest.approx(prepared(rig)[1].scale, rel=0.01)


def test_a_said_joint_is_kept(tmp_path: Path) -> None:
    motion = read_motion(write_rig(replace(PLAIN, split=HALVES), tmp_path / "m.bvh"))
    positions = sample(motion.forward_kinematics()[0])
    found = identify(motion.skeleton, {"left_shin": "LeftLeg02"}, positions)
    names = motion.skeleton.names
    assert names[found.parts["left_shin"]] == "LeftLeg02"
    assert names[found.parts["right_shin"]] == "RightLeg"
    assert names[found.frame("right_thigh")] == "RightUpLeg02"
    assert "RightUpLeg02" not in found.unmapped


# --- lying, upside down ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "up"), [("handstand_y", "y"), ("upright_minus_y", "-y"), ("lying_zup", "z")])
def test_the_cases_keep_their_up_axis(name: str, up: str, shared: Path) -> None:
    motion = read_motion(shared / "cases" / f"{name}.bvh")
    assert motion.meta["up"] == up
    clip, report = case(shared / "cases" / f"{name}.bvh")
    positions = clip.forward_kinematics()[0]
    rises = positions[:, HUMANOID.head, 2] - positions[:, 0, 2]
    if name == "handstand_y":
        assert (rises < -0.4).all()
        assert ["head is below the hips in frames 0 to" in line for line in report.warnings] == [True]
    elif name == "lying_zup":
        assert np.abs(rises).max() < 0.3
        assert ["lies" in line for line in report.warnings] == [True]
    else:
        assert (rises > 0.4).all()
        assert not report.warnings
    lowest = np.minimum(lowest_points(HUMANOID, clip), sole_positions(HUMANOID, clip)[..., 2].min(axis=1))
    assert np.abs(lowest + 0.004).max() < 0.01  # it rests on the floor, whatever it rests on


@pytest.mark.parametrize(
    ("world", "rest", "up"),
    [
        ((0, 0, 0), (0, 0, 0), "y"),
        ((180, 0, 0), (0, 0, 0), "y"),  # on the hands
        ((90, 0, 0), (0, 0, 0), "y"),  # on the back
        ((0, 0, 90), (0, 0, 0), "y"),  # on the side
        ((90, 0, 0), (90, 0, 0), "z"),
        ((0, 0, 0), (90, 0, 0), "z"),
        ((-90, 0, 0), (90, 0, 0), "z"),
        ((180, 0, 0), (180, 0, 0), "-y"),
        ((0, 0, 0), (180, 0, 0), "-y"),
    ],
)
def test_the_rest_pose_says_what_is_up(
    world: tuple[float, float, float], rest: tuple[float, float, float], up: str, tmp_path: Path
) -> None:
    rig = replace(PLAIN, world=world, rest_world=rest, seconds=1.0)
    assert read_motion(write_rig(rig, tmp_path / "m.bvh")).meta["up"] == up


# --- frames that are no motion ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "frames"), [("lead_1", 1), ("lead_2", 2), ("lead_5", 5), ("lead_end1", 1)])
def test_posed_frames_are_left_out_in_the_cases(name: str, frames: int, shared: Path) -> None:
    motion = read_motion(shared / "cases" / f"{name}.bvh")
    cut = without_lead_in(motion)
    assert len(motion) - len(cut) == frames
    start = 0 if name == "lead_end1" else frames
    assert np.array_equal(cut.qpos, motion.qpos[start : start + len(cut)])
    assert len(without_lead_in(cut)) == len(cut)


def test_a_quick_start_is_no_pose(prepared: Callable[[Rig], Prepared], tmp_path: Path) -> None:
    motion = read_motion(write_rig(STANDING, tmp_path / "m.bvh"))
    assert len(without_lead_in(motion)) == len(motion)
    quick = motion.qpos[::6]  # moves from the first frame on
    assert len(without_lead_in(replace(motion, qpos=quick))) == len(quick)
