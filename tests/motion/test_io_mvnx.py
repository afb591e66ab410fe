"""MVNX in, against a motion written the way Xsens MVN does; hostile XML."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import blamed, reads_or_says_why, run_child
from helpers.mocap import default_humanoid
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.motion import rotations as rot
from egopose.motion.io import mvnx, read_motion
from egopose.motion.motion import Motion
from egopose.motion.retarget import retarget
from egopose.motion.rotations import Array

HUMANOID = default_humanoid()
SEGMENTS = ["Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head"] + [
    side + part
    for side, parts in (
        ("Right", ("Shoulder", "UpperArm", "ForeArm", "Hand")),
        ("Left", ("Shoulder", "UpperArm", "ForeArm", "Hand")),
        ("Right", ("UpperLeg", "LowerLeg", "Foot", "Toe")),
        ("Left", ("UpperLeg", "LowerLeg", "Foot", "Toe")),
    )
    for part in parts
]
_TRUNK = dict(zip(SEGMENTS[:7], ("Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"), strict=True))
_LIMBS = {"UpperArm": "Arm", "UpperLeg": "UpLeg", "LowerLeg": "Leg", "Toe": "Foot"}
_ENDS = {
    "Head": ("pTopOfHead", "0 0 0.2"),
    "RightHand": ("pRightTopOfHand", "0 -0.17 0"),
    "LeftHand": ("pLeftTopOfHand", "0 0.17 0"),
    "RightToe": ("pRightToe", "0.06 0 0"),
    "LeftToe": ("pLeftToe", "0.06 0 0"),
}


@pytest.fixture(scope="module")
def walk() -> Motion:
    clip = files("egopose") / "assets" / "clips" / "deepmimic_walk.motion.npz"
    return retarget(read_motion(str(clip)), HUMANOID.skeleton, HUMANOID.joint_range)[0]


def places(motion: Motion) -> tuple[Array, Array]:
    """Positions ``[T, 23, 3]`` and orientations ``[T, 23, 4]`` of segments; the humanoid's zero is a T-pose too."""
    positions, quats = motion.forward_kinematics()
    spots, turns = [], []
    for segment in SEGMENTS:
        side = next((s for s in ("Right", "Left") if segment.startswith(s)), "")
        part = segment.removeprefix(side)
        k = motion.skeleton.index(_TRUNK[segment] if not side else side + _LIMBS.get(part, part))
        ahead = np.array([0.131, 0.0, -0.03]) if part == "Toe" else np.zeros(3)
        spots.append(positions[:, k] + rot.rotate(quats[:, k], np.broadcast_to(ahead, positions[:, k].shape)))
        turns.append(quats[:, k])
    return np.stack(spots, axis=1), np.stack(turns, axis=1)


def numbers(values: Array) -> str:
    return " ".join(f"{v:.6f}" for v in np.ravel(values))


def document(
    motion: Motion, version: int = 4, tpose: Array | None = None, subject: str = "Ann", extra: str = ""
) -> str:
    """The file; ``tpose [23, 4]`` are orientations that the segments' frames have in the T-pose."""
    positions, quats = places(motion)
    zero = np.tile([1.0, 0.0, 0.0, 0.0], (len(SEGMENTS), 1)) if tpose is None else tpose
    quats = rot.multiply(quats, zero[None])
    points = {}
    for name, (label, end) in _ENDS.items():
        local = rot.rotate(rot.conjugate(zero[SEGMENTS.index(name)]), np.array(end.split(), dtype=float))
        points[name] = f'<point label="{label}"><pos_b>{numbers(local)}</pos_b></point>'
    segments = "".join(
        f'<segment label="{name}" id="{k}"><points>{points.get(name, "")}</points></segment>'
        for k, name in enumerate(SEGMENTS, start=1)
    )
    calibration = "".join(
        f'<frame time="0" index="" tc="" ms="0" type="{kind}"><orientation>{numbers(zero)}</orientation>'
        f"<position>{numbers(positions[0])}</position></frame>"
        for kind in (("identity", "tpose", "tpose-isb") if version > 2 else ())
    )
    frames = "".join(
        f'<frame time="{1000 * t / motion.fps:.0f}" index="{t}" type="normal"><orientation>{numbers(quats[t])}'
        f"</orientation>\n<position>{numbers(positions[t])}</position><velocity>{numbers(positions[t])}</velocity>"
        "<jointAngle>1 2 3</jointAngle></frame>\n"
        for t in range(len(motion))
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<mvnx version="{version}" xmlns="http://www.xsens.com/mvn/mvnx">\n'
        f'<mvn version="2020.0" build="1"/><comment>walk</comment>\n<subject label="{subject}" frameRate="30" '
        f'segmentCount="23">\n<segments>{segments}</segments><sensors><sensor label="Pelvis"/></sensors>{extra}\n'
        f'<frames segmentCount="23" sensorCount="17" jointCount="22">\n{calibration}\n{frames}</frames>\n</subject>'
        "</mvnx>\n"
    )


@pytest.mark.parametrize("version", [3, 4])
def test_joints_lie_where_the_file_has_them(walk: Motion, tmp_path: Path, version: int) -> None:
    (tmp_path / "m.mvnx").write_text(document(walk, version))
    back = read_motion(tmp_path / "m.mvnx")
    assert (back.fps, len(back), back.skeleton.names) == (30.0, len(walk), tuple(mvnx._TREE))
    assert back.meta["calibration_frames"] == {"identity": 1, "tpose": 1, "tpose-isb": 1}
    positions, quats = back.forward_kinematics()
    spots, turns = places(walk)
    order = [SEGMENTS.index(name) for name in back.skeleton.names]
    np.testing.assert_allclose(positions, spots[:, order], atol=1e-4)
    np.testing.assert_allclose(rot.to_matrix(quats), rot.to_matrix(turns[:, order]), atol=1e-4)
    moved, _ = retarget(back, HUMANOID.skeleton, HUMANOID.joint_range)
    off = np.linalg.norm(moved.forward_kinematics()[0] - walk.forward_kinematics()[0], axis=-1)
    assert off.mean() < 0.005


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 99))
def test_the_t_pose_is_the_zero_pose_whatever_its_frames(walk: Motion, tmp_path: Path, seed: int) -> None:
    tpose = rot.normalize(np.random.default_rng(seed).normal(size=(23, 4)))
    (tmp_path / "m.mvnx").write_text(document(walk))
    (tmp_path / "t.mvnx").write_text(document(walk, tpose=tpose))
    plain, turned = read_motion(tmp_path / "m.mvnx"), read_motion(tmp_path / "t.mvnx")
    np.testing.assert_allclose(turned.skeleton.offsets, plain.skeleton.offsets, atol=1e-4)
    for mine, theirs in zip(turned.skeleton.joints, plain.skeleton.joints, strict=True):
        np.testing.assert_allclose(mine.tips, theirs.tips, atol=1e-5)
    np.testing.assert_allclose(turned.forward_kinematics()[0], plain.forward_kinematics()[0], atol=1e-4)


def test_people_props_and_bodies_cut_short(walk: Motion, tmp_path: Path) -> None:
    path = tmp_path / "m.mvnx"
    one = document(walk)
    two = document(walk, subject="Bob")
    start = two.index("<subject")
    path.write_text(one.replace("</subject></mvnx>", "</subject>" + two[start:]))
    blamed(path, "subject: 2 people: say which with subject=NAME out of Ann, Bob")
    blamed(path, "option subject: there is no 'Eve'; the file has Ann, Bob", subject="Eve")
    assert read_motion(path, subject="Bob").meta["subject"] == "Bob"
    # A thing that was tracked besides stands behind the body in every list.
    text = one.replace("</segments>", '<segment label="Prop1" id="24"/></segments>')
    text = text.replace("</orientation>", " 1 0 0 0</orientation>").replace("</position>", " 0 0 0</position>")
    path.write_text(text)
    back = read_motion(path)
    assert len(back.skeleton) == 23
    assert back.meta["notes"] == ["segments of no body were left out: Prop1"]
    np.testing.assert_allclose(back.qpos[:, :3], walk.qpos[:, :3], atol=1e-4)


def laughs() -> str:
    """A billion times ``lol`` from ten lines."""
    entities = '<!ENTITY a0 "lol">' + "".join(f'<!ENTITY a{k} "' + f"&a{k - 1};" * 10 + '">' for k in range(1, 10))
    return f'<?xml version="1.0"?><!DOCTYPE mvnx [{entities}]><mvnx>&a9;</mvnx>'


HOSTILE: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda t: "", "the file is empty"),
    "no xml": (lambda t: "hello", "line 1: not XML"),
    "another": (lambda t: "<svg/>", "line 1: begins with <svg>, not with <mvnx>"),
    "billion laughs": (lambda t: laughs(), "line 1: a DOCTYPE"),
    "names a file": (
        lambda t: '<!DOCTYPE mvnx [<!ENTITY x SYSTEM "file:///etc/passwd">]><mvnx>&x;</mvnx>',
        "line 1: a DOCTYPE",
    ),
    "a schema elsewhere": (lambda t: '<!DOCTYPE mvnx SYSTEM "http://x/y.dtd"><mvnx/>', "line 1: a DOCTYPE"),
    "cut": (lambda t: t[: len(t) // 2], "not XML: "),
    "nobody": (lambda t: '<mvnx version="4"/>', "subject: there is none"),
    "nested": (lambda t: "<mvnx>" + "<a>" * 10_000, "nested more than 32 deep"),
    "encoding": (lambda t: t.replace("UTF-8", "utf-99"), "not XML"),
    "no pelvis": (lambda t: t.replace('"Pelvis"', '"Hips"'), "segments: there is no Pelvis; found Hips, L5"),
    "rate": (lambda t: t.replace('frameRate="30"', 'frameRate="1e999"'), "frameRate: '1e999' is not a frame rate"),
    "no rate": (lambda t: t.replace("frameRate", "speed"), "frameRate: '' is not a frame rate"),
    "calibration alone": (
        lambda t: t[: t.index('<frame time="0" index="0"')] + "</frames></subject></mvnx>",
        "no frame of type normal",
    ),
    "unknown frames": (lambda t: t.replace('"normal"', '"odd"'), "a frame of the unknown type 'odd'"),
    "no positions": (lambda t: t.replace("position", "place"), "the frame has no <position>: export"),
    "short": (lambda t: t.replace("<position>", "<position>1 "), "<position> has 70 numbers, 69 are wanted"),
    "word": (lambda t: t.replace("<orientation>1.0", "<orientation>x1.0"), "<orientation>: not all of it is numbers"),
    "zero quaternion": (lambda t: t.replace("<orientation>1.000000", "<orientation>0.000000"), "length is far from 1"),
    "segment twice": (lambda t: t.replace('"L3"', '"L5"'), "segment 'L5' stands twice"),
    "many segments": (
        lambda t: t.replace("</segments>", "".join(f'<segment label="s{k}"/>' for k in range(3000)) + "</segments>"),
        "more than 2048 segments",
    ),
    "endless number": (lambda t: t.replace("<position>", "<position>" + "1" * 300_000, 1), "more than 262144 letters"),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(HOSTILE))
def test_hostile_mvnx(walk: Motion, tmp_path: Path, case: str) -> None:
    change, expected = HOSTILE[case]
    path = tmp_path / "bad.mvnx"
    path.write_text(change(document(walk)))
    blamed(path, expected)


@pytest.mark.parametrize("value", ["nan", "inf", "-1e300"])
def test_numbers_that_are_none(walk: Motion, tmp_path: Path, value: str) -> None:
    head, _, tail = document(walk).rpartition("<position>")
    path = tmp_path / "bad.mvnx"
    path.write_text(f"{head}<position>{value} {tail.partition(' ')[2]}")
    blamed(path, "<position>: a number is not finite or absurdly large")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_mvnx_reads_or_says_why(walk: Motion, tmp_path: Path, data: st.DataObject) -> None:
    raw = document(walk.slice(0, 2)).encode()
    start = data.draw(st.integers(0, len(raw)))
    stop = data.draw(st.integers(start, min(len(raw), start + 30)))
    path = tmp_path / "m.mvnx"
    path.write_bytes(
        raw[:start] + data.draw(st.one_of(st.just(raw[start:stop] * 2), st.binary(max_size=8))) + raw[stop:]
    )
    reads_or_says_why(path)


def test_limits_hold(walk: Motion, tmp_path: Path) -> None:
    """Long files in a process that may map 2 GB beyond its imports: numbers without end, a tag without end."""
    text = document(walk.slice(0, 1))
    frame = text[text.index('<frame time="0" index="0"') : text.index("</frames>")]
    start, end = text.split(frame)
    many = 40_000_000 // len(frame)
    (tmp_path / "long.mvnx").write_text(start + frame * many + end)
    (tmp_path / "tag.mvnx").write_text('<mvnx version="' + " " * 100_000_000 + '"/>')
    (tmp_path / "comment.mvnx").write_text("<mvnx><!--" + "a" * 100_000_000 + "--></mvnx>")
    said = run_child("motion", [tmp_path / f"{name}.mvnx" for name in ("long", "tag", "comment")])
    assert said["long.mvnx"] == "read"
    assert "a tag or comment of over" in said["tag.mvnx"]
    assert "a tag or comment of over" in said["comment.mvnx"]
