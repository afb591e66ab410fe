"""TRC and C3D in: a skeleton fitted to points, against the motion the points were taken from."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from helpers.hostile import blamed, reads_or_says_why, run_child
from helpers.marker_files import in_file, layout, write_layout
from helpers.mocap import default_humanoid, rig_motion
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io import read_motion, write_motion
from egopose.motion.io.frames import UP_AXES
from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget

HUMANOID = default_humanoid()


@pytest.fixture(scope="module")
def walk() -> Motion:
    """An embedded walk on the humanoid."""
    clip = files("egopose") / "assets" / "clips" / "deepmimic_walk.motion.npz"
    moved, _ = retarget(read_motion(str(clip)), HUMANOID.skeleton, HUMANOID.joint_range)
    return moved


def apart(found: Motion, truth: Motion, joints: str = "") -> tuple[float, float]:
    """Mean distance (mm) and angle (degrees) of the joints whose names end so, once the motion is on the humanoid."""
    moved, _ = retarget(found, HUMANOID.skeleton, HUMANOID.joint_range)
    (a, qa), (b, qb) = moved.forward_kinematics(), truth.forward_kinematics()
    which = [k for k, name in enumerate(HUMANOID.skeleton.names) if re.search(f"({joints})$", name)]
    off = np.linalg.norm(a - b, axis=-1)[:, which]
    turn = np.linalg.norm(rot.to_rotvec(rot.multiply(rot.conjugate(qb), qa)), axis=-1)[:, which]
    return float(1000 * off.mean()), float(np.rad2deg(turn).mean())


@pytest.mark.parametrize("ending", [".trc", ".c3d"])
def test_what_the_project_writes_comes_back(walk: Motion, tmp_path: Path, ending: str) -> None:
    write_motion(walk, tmp_path / f"m{ending}")
    back = read_motion(tmp_path / f"m{ending}")
    assert back.fps == walk.fps
    assert len(back) == len(walk)
    mm, degrees = apart(back, walk)
    assert mm < 10.0
    assert degrees < 5.0
    # Joints that the skeleton takes over lie where the file has them.
    (mine, _), (theirs, _) = back.forward_kinematics(), walk.forward_kinematics()
    for joint in ("LeftArm", "RightHand", "LeftLeg", "RightFoot"):
        off = mine[:, back.skeleton.index(joint)] - theirs[:, walk.skeleton.index(joint)]
        assert np.linalg.norm(off, axis=1).mean() < 0.005, joint


@pytest.mark.parametrize("rig", ["bandai", "deepmimic", "cc_base", "acclaim", "cmu31"])
def test_rigs_written_as_points_are_known(rig: str, shared: Path, tmp_path: Path) -> None:
    """Other rigs' names. Where a rig's rest pose leans (CMU's by 6 degrees) points cannot tell: its legs are right."""
    motion = rig_motion(rig, shared, tmp_path, 2.0)
    truth, _ = retarget(motion, HUMANOID.skeleton, HUMANOID.joint_range)
    write_motion(motion, tmp_path / "m.trc")
    back = read_motion(tmp_path / "m.trc")
    assert apart(back, truth, "Leg|Foot")[0] < 10.0
    if rig in ("bandai", "deepmimic"):
        assert apart(back, truth)[0] < 10.0


@pytest.mark.parametrize("kind", ["HALPE_26", "BODY_25", "mediapipe", "COCO_17"])
def test_pose_networks_layouts(walk: Motion, tmp_path: Path, kind: str) -> None:
    points = layout(walk, kind)
    for k, name in enumerate(points):
        points[name] = points[name].copy()
        points[name][3 + k % 5 :: 11] = np.nan
    write_layout(tmp_path / "m.trc", points)
    back = read_motion(tmp_path / "m.trc")
    mm, degrees = apart(back, walk)
    assert mm < 10.0
    # Without toes nothing tells how a foot is held.
    assert degrees < (10.0 if kind == "COCO_17" else 5.0)
    (note,) = back.meta["notes"]
    assert note.startswith("gaps were filled by interpolation: ")
    assert f"of {len(walk)} frames" in note
    assert not {"left_hip"} - set(note.replace(" ", ",").split(",")) or "parts more" in note


def test_measurement_noise_is_borne(walk: Motion, tmp_path: Path) -> None:
    """Ten millimetres of noise on every point move joints by little more, and turn no limb over."""
    random = np.random.default_rng(0)
    points = {k: v + random.normal(0, 0.01, v.shape) for k, v in layout(walk, "HALPE_26").items()}
    write_layout(tmp_path / "m.trc", points)
    mm, degrees = apart(read_motion(tmp_path / "m.trc"), walk)
    assert mm < 30.0
    assert degrees < 15.0


@pytest.mark.parametrize("up", UP_AXES)
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_any_axis_and_unit(walk: Motion, tmp_path: Path, up: str, unit: str) -> None:
    points = layout(walk, "BODY_25")
    write_layout(tmp_path / "m.trc", points, up=up, unit=unit)
    found = read_motion(tmp_path / "m.trc", up=up)
    mm, _ = apart(found, walk)
    assert mm < 10.0
    if up != "-y":  # feet above a floor at zero: that could be a handstand
        assert read_motion(tmp_path / "m.trc").meta["up"] == up


def test_a_handstand_stays_one(walk: Motion, tmp_path: Path) -> None:
    points = layout(walk, "BODY_25")
    over = {k: v * [1.0, -1.0, -1.0] for k, v in points.items()}
    lowest = min(float(v[:, 2].min()) for v in over.values())
    over = {k: v - [0.0, 0.0, lowest] for k, v in over.items()}
    write_layout(tmp_path / "m.trc", over)
    back = read_motion(tmp_path / "m.trc")
    assert back.meta["up"] == "y"
    positions, _ = back.forward_kinematics()
    assert (positions[:, back.skeleton.index("LeftFoot"), 2] > positions[:, 0, 2] + 0.3).all()


def test_unknown_names_are_listed_and_can_be_given(walk: Motion, tmp_path: Path) -> None:
    points = layout(walk, "COCO_17")
    names = {name: f"P{k:02d}" for k, name in enumerate(points)}
    renamed = {names[name]: value for name, value in points.items()}
    # The knee as two markers on the skin, inside and outside.
    renamed[names["RKnee"]] = points["RKnee"] + [0.0, 0.05, 0.0]
    renamed["P99"] = points["RKnee"] - [0.0, 0.05, 0.0]
    write_layout(tmp_path / "m.trc", renamed)
    with pytest.raises(InputError, match=r"no point is known as right_hip, right_knee.* the file has: P00, P01"):
        read_motion(tmp_path / "m.trc")
    parts = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "ear")
    given = {
        f"{side}_{part}": names[side[0].upper() + part.capitalize()] for side in ("right", "left") for part in parts
    }
    given |= {"right_knee": [names["RKnee"], "P99"], "nose": names["Nose"]}
    mm, _ = apart(read_motion(tmp_path / "m.trc", points=given), walk)
    assert mm < 10.0
    blamed(tmp_path / "m.trc", "option points.nose: there is no point P77", points={**given, "nose": "P77"})
    blamed(tmp_path / "m.trc", "option points.tail: is no part; there are neck, head, crown", points={"tail": "P01"})


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ("suffix", lambda n: n[1:] + "_" + n[0].lower() if n[0] in "RL" else n),
        ("shouted", str.upper),
        ("subject", lambda n: f"Ann:{n}"),
        ("take", lambda n: f"walk_{n}"),
        ("study", lambda n: f"{n}_study"),
        ("words", lambda n: {"R": "Right ", "L": "Left "}.get(n[0], "") + n[n[0] in "RL" :]),
    ],
)
def test_names_may_be_dressed_up(walk: Motion, tmp_path: Path, change: str, names: Callable[[str], str]) -> None:
    points = layout(walk, "COCO_17")
    write_layout(tmp_path / "m.trc", points)
    write_layout(tmp_path / "d.trc", {names(k): v for k, v in points.items()})
    plain, dressed = read_motion(tmp_path / "m.trc"), read_motion(tmp_path / "d.trc")
    np.testing.assert_allclose(dressed.qpos, plain.qpos, atol=1e-9)


def test_the_rate_is_the_headers_and_must_fit_the_times(walk: Motion, tmp_path: Path) -> None:
    points = layout(walk, "COCO_17")
    write_layout(tmp_path / "m.trc", points, 60.0, rate="30")
    blamed(tmp_path / "m.trc", "DataRate: 30, but")
    assert read_motion(tmp_path / "m.trc", fps=60).fps == 60
    blamed(tmp_path / "m.trc", "option fps: 'fast' is not", fps="fast")
    write_layout(tmp_path / "m.trc", points, 60.0, rate="0")
    assert read_motion(tmp_path / "m.trc").fps == 60


def test_a_laboratorys_c3d(walk: Motion, tmp_path: Path) -> None:
    """Written by ezc3d: millimetres, y up, forces at four times the rate, points that were not seen."""
    points = layout(walk, "BODY_25")
    values = in_file(points, "y", 0.001)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [walk.fps]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(points)
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=2).transpose(2, 1, 0)
    file["parameters"]["ANALOG"]["RATE"]["value"] = [4 * walk.fps]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fz"]
    file["data"]["analogs"] = np.ones((1, 1, 4 * len(walk)))
    file["data"]["points"][:, list(points).index("LKnee"), 4:8] = np.nan
    file.write(str(tmp_path / "m.c3d"))
    back = read_motion(tmp_path / "m.c3d")
    assert (back.fps, back.meta["unit"], back.meta["up"]) == (walk.fps, "mm", "y")
    assert "left_knee in 4" in back.meta["notes"][0]
    assert apart(back, walk)[0] < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("frames", [65535, 65536, 70000])
def test_more_frames_than_two_bytes_count(walk: Motion, tmp_path: Path, frames: int) -> None:
    many = replace(walk, qpos=np.resize(walk.qpos, (frames, walk.qpos.shape[1])), contacts=None, contact_names=())
    write_motion(many, tmp_path / "m.c3d")
    assert len(read_motion(tmp_path / "m.c3d")) == frames


def trc(change: Callable[[str], str]) -> Callable[[str], bytes]:
    return lambda text: change(text).encode()


TRC: dict[str, tuple[Callable[[str], bytes], str]] = {
    "empty": (lambda _: b"", "the file is empty"),
    "binary": (lambda _: b"PathFileType\0", "zero byte"),
    "another": (trc(lambda t: t.replace("PathFileType", "Hello")), "line 1: a TRC begins with PathFileType"),
    "no frames": (trc(lambda t: "\n".join(t.split("\n")[:5]) + "\n"), "line 7: there are no frames"),
    "word": (trc(lambda t: t.replace("0.100000", "soon")), "are numbers"),
    "infinite": (
        lambda t: re.sub(r"\t0\.100000\t[^\t]+", "\t0.100000\tinf", t).encode(),
        "is infinite or absurdly large",
    ),
    "too many": (trc(lambda t: t.rstrip("\n") + "\t1\t2\n"), "fields;"),
    "no names": (trc(lambda t: t.replace("Frame#", "Table")), "line 4: expected Frame#"),
    "furlongs": (trc(lambda t: t.replace("\tm\t", "\tfurlong\t")), "Units: 'furlong' is not known"),
    "a giant": (trc(lambda t: t.replace("\tm\t", "\tinch\t")), "unit: in inch the person would be 0.04"),
    "endless names": (trc(lambda t: t.replace("Nose", "\t".join("a" * 3000))), "points; at most 2048"),
    "huge rate": (trc(lambda t: t.replace("\n30\t", "\n1e300\t", 1)), ""),
}


@pytest.mark.parametrize("case", sorted(TRC))
def test_hostile_trc(walk: Motion, tmp_path: Path, case: str) -> None:
    change, expected = TRC[case]
    path = tmp_path / "bad.trc"
    write_layout(path, layout(walk, "COCO_17"))
    path.write_bytes(change(path.read_text()))
    if expected:
        blamed(path, expected)
    else:
        assert read_motion(path).fps == 30


def test_bodies_that_are_none(walk: Motion, tmp_path: Path) -> None:
    points = layout(walk, "COCO_17")
    path = tmp_path / "m.trc"
    write_layout(path, {k: v * 0 + [1.0, 1.0, 1.0] for k, v in points.items()})
    blamed(path, "lie in one place: no body")
    for nothing in (np.nan, 0.0):
        write_layout(path, {k: v * 0 + nothing for k, v in points.items()})
        blamed(path, f"seen in 0 of {len(walk)} frames")
    half = points["LKnee"].copy()
    half[: len(half) // 2 + 1] = np.nan
    write_layout(path, {**points, "LKnee": half})
    blamed(path, "points.left_knee: seen in")
    write_layout(path, {**points, "Nose": points["Nose"] * np.nan})
    assert len(read_motion(path)) == len(walk)
    write_layout(path, {k: v[:1] for k, v in points.items()})
    assert len(read_motion(path)) == 1


def test_points_that_fall_together_leave_a_body(walk: Motion, tmp_path: Path) -> None:
    """A neck in a shoulder, a head in the neck, toes in the ankle: no direction, but a motion."""
    points = layout(walk, "HALPE_26")
    points |= {"Neck": points["LShoulder"], "Head": points["LShoulder"], "RBigToe": points["RAnkle"]}
    points |= {"RSmallToe": points["RAnkle"], "RHeel": points["RAnkle"]}
    write_layout(tmp_path / "m.trc", points)
    back = read_motion(tmp_path / "m.trc")
    assert np.isfinite(back.forward_kinematics()[0]).all()
    apart(back, walk)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), min_size=1, max_size=12))
def test_damaged_c3d_reads_or_says_why(walk: Motion, tmp_path: Path, changes: list[tuple[int, int]]) -> None:
    """Overwritten anywhere: a Motion or one InputError, never another exception, never the end of the process."""
    good = tmp_path / "good.c3d"
    if not good.exists():
        write_motion(walk, good)
    raw = bytearray(good.read_bytes())
    for place, value in changes:
        raw[place] = value
    path = tmp_path / "m.c3d"
    path.write_bytes(raw)
    reads_or_says_why(path)


def test_hostile_c3d(walk: Motion, tmp_path: Path) -> None:
    good, path = tmp_path / "good.c3d", tmp_path / "bad.c3d"
    write_motion(walk, good)
    raw = good.read_bytes()
    cases = {
        "not a C3D file": [b"", b"\x02", raw[:600], b"hello" * 500],
        "they are not where the header says": [b"\xff" + raw[1:], raw[:515] + b"\0" + raw[516:]],
        "cut short": [raw[:-2000]],
        "not as the format says": [raw[:2] + b"\xff\xff" + raw[4:]],
    }
    at = raw.index(b"ACTUAL_END_FIELD")
    end = at + len("ACTUAL_END_FIELD") + 2 + 3
    cases["frames; 1 to"] = [raw[:end] + b"\xff" * 4 + raw[end + 4 :]]
    for expected, contents in cases.items():
        for content in contents:
            path.write_bytes(content)
            blamed(path, expected)


def test_limits_hold(walk: Motion, tmp_path: Path) -> None:
    """The largest that is read, in a process that may map 2 GB beyond its imports."""
    points = layout(walk, "COCO_17")
    write_layout(tmp_path / "long.trc", points)
    text = (tmp_path / "long.trc").read_text()
    row = text.rstrip("\n").split("\n")[-1] + "\n"
    (tmp_path / "long.trc").write_text(text + row * (12_000_000 // len(row)))
    (tmp_path / "rows.trc").write_text(text + "1\t1\t1\n" * 500_000)
    said = run_child("motion", [tmp_path / "long.trc", tmp_path / "rows.trc"])
    assert said["long.trc"] == "read"
    assert "cut the motion into parts" in said["rows.trc"]
