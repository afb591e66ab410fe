"""Kinds of motion files as programs really write them: each comes in right, and what was decided is noted."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.motion_files import Bvh, parts_positions, plain
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose import export
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import prepare
from egopose.data.prepare_motion import without_lead_in
from egopose.data.report import store_report
from egopose.data.store import TakeStore
from egopose.motion import rotations as rot
from egopose.motion.io import read_motion
from egopose.motion.io.amass import rest_positions
from egopose.motion.io.frames import frame_rate, up_rotation
from egopose.motion.mapping import identify
from egopose.motion.motion import Motion
from egopose.motion.notes import notes_of
from egopose.motion.rotations import Array
from egopose.viewer.clip_sources import read_run

MANY = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.fixture(scope="module")
def squat(shared: Path) -> Bvh:
    return plain(shared / "cases" / "plain.bvh")


@pytest.fixture(scope="module")
def expected(shared: Path) -> Motion:
    return read_motion(shared / "cases" / "plain.bvh")


@pytest.fixture(scope="module")
def expected_case(shared: Path) -> Array:
    """The cases' own 90 frames, on the humanoid: those of a file in which only a keyword is odd."""
    return parts_positions(read_motion(shared / "cases" / "endsite_oneword.bvh"))


def read_text(folder: Path, content: str | bytes, name: str = "a.bvh", **options: object) -> Motion:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_motion(path, **options)


def assert_same(motion: Motion, expected: Motion, tolerance: float = 1e-5) -> None:
    """Same joints, same places (m), same rate."""
    assert motion.fps == expected.fps
    assert len(motion) == len(expected)
    apart = motion.forward_kinematics()[0] - expected.forward_kinematics()[0]
    assert np.abs(apart).max() < tolerance


# --- the cases -------------------------------------------------------------------------------------------------------

CASES = {
    "six_delta.bvh": "added to OFFSET",
    "frames_plus1.bvh": "89 frames are announced and 90 are there",
    "frames_minus1.bvh": "91 frames are announced and 90 are there",
    "ft_0.033.bvh": "30 frames/s",
    "ft_0.0167.bvh": "60 frames/s",
    "ft_0.017.bvh": "60 frames/s",
    "child_0.95m_cm.bvh": "0.95 m",
    "child_1.05m_cm.bvh": "1.05 m",
    "child_1.2m_cm.bvh": "1.20 m",
    "dm.bvh": "taken for dm",
    "suffixLR.bvh": "",
    "asset_prefix.bvh": "",
    "latin1.bvh": "",
    "endsite_oneword.bvh": "",
    "lead_1.bvh": "a frame of a still pose before",
    "lead_2.bvh": "2 frames of a still pose before",
    "lead_5.bvh": "5 frames of a still pose before",
    "lead_end1.bvh": "a frame of a still pose after",
}


@pytest.mark.parametrize("name", CASES)
def test_every_case_is_the_same_motion(name: str, shared: Path, expected_case: Array, tmp_path: Path) -> None:
    motion = without_lead_in(read_motion(shared / "cases" / name))
    assert len(motion) == 90
    if name in ("ft_0.0167.bvh", "ft_0.017.bvh"):  # these two hold half as long a piece
        exact = re.sub("(?<=Frame Time: )(.*)", "0.01666667", (shared / "cases" / name).read_text())
        assert_same(motion, read_text(tmp_path, exact))
        assert motion.fps == 60
    else:
        assert np.abs(parts_positions(motion) - expected_case).max() < 0.02
        assert motion.fps == 30
    assert CASES[name] in " ".join(notes_of(motion))
    assert bool(CASES[name]) == bool(notes_of(motion))


# --- positions below the root ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("positions", "added"),
    [(np.zeros_like, True), (lambda offset: 0.002 * offset, True), (np.copy, False), (lambda o: 1.003 * o, False)],
    ids=["zero", "nearly zero", "offset", "nearly offset"],
)
@pytest.mark.parametrize("unit", ["cm", "m"])
def test_positions_are_added_or_replace(
    positions: Callable[[Array], Array], added: bool, unit: str, squat: Bvh, expected: Motion, tmp_path: Path
) -> None:
    scale = 1.0 if unit == "cm" else 0.01
    motion = read_text(tmp_path, squat.scaled(scale).with_six_channels(positions).text(decimals=8))
    assert motion.meta["unit"] == unit
    assert_same(motion, expected, tolerance=0.005 if unit == "cm" else 0.05)
    assert any("added to OFFSET" in note for note in notes_of(motion)) == added


@pytest.mark.parametrize("joints", ["all", "two"])
def test_positions_may_be_places_in_the_world(joints: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    """As some exporters of CMU's mocap write them, for the trunk and the head alone."""
    places = (
        rot.rotate(rot.conjugate(up_rotation("y")), expected.forward_kinematics()[0]) / expected.meta["unit_metres"]
    )
    six = squat.with_six_channels(np.copy)
    rows = six.rows.copy()
    for i in range(1, places.shape[1]):
        rows[:, 6 * i : 6 * i + 3] = places[:, i]
    six = replace(six, rows=rows)
    if joints == "two":  # the root's first child and its first child keep their places, all others only turn
        kept = [k for i in range(places.shape[1]) for k in range(6 * i, 6 * i + 6) if i < 3 or k % 6 > 2]
        parts = six.hierarchy.split("CHANNELS 6 Xposition Yposition Zposition ")
        hierarchy = "".join(
            part if not i else f"CHANNELS {'6 Xposition Yposition Zposition' if i < 4 else '3'} {part}"
            for i, part in enumerate(parts)
        )
        six = Bvh(hierarchy, six.frame_time, rows[:, kept])
    motion = read_text(tmp_path, six.text(decimals=8))
    assert_same(motion, expected)
    assert any("places in the world" in note for note in notes_of(motion))


def test_the_place_of_the_body_on_a_carrier_is_none_in_the_world(squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    """Hips that sway by less than their height stay about as far from the carrier's origin as their OFFSET is long."""
    root = squat.rows[:, :3]
    offset = " ".join(f"{v:.5f}" for v in root.mean(axis=0))
    body = re.sub(r"ROOT (\w+)\s*\{\s*OFFSET .*", rf"JOINT \1\n{{\nOFFSET {offset}", squat.hierarchy.split("\n", 1)[1])
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    hierarchy = f"HIERARCHY\nROOT Carrier\n{{\nOFFSET 0 0 0\n{channels}\n{body}}}\n"
    turned = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 90.0], (len(root), 1))
    rows = np.concatenate([turned, squat.rows], axis=1)
    rows[:, 6:9] = root.mean(axis=0)
    rows[:, 6] += np.linspace(-8.0, 8.0, len(rows))
    motion = read_text(tmp_path, Bvh(hierarchy, squat.frame_time, rows).text(decimals=8))
    assert not any("places in the world" in note for note in notes_of(motion))
    hips = motion.forward_kinematics()[0][:, motion.skeleton.names.index(expected.skeleton.names[0])]
    np.testing.assert_allclose(sorted(np.ptp(hips, axis=0)), [0.0, 0.0, 0.16], atol=1e-4)  # the sway and no more


def test_positions_alone_make_the_bones_where_offsets_are_nought(squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    six = squat.with_six_channels(np.copy)
    bare = re.sub(r"OFFSET .*(\n\s*CHANNELS)", r"OFFSET 0 0 0\1", six.hierarchy)
    assert_same(read_text(tmp_path, replace(six, hierarchy=bare).text()), expected)


def test_a_unit_that_makes_no_body_is_refused(squat: Bvh, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"option unit: makes the body 0\.0017 m tall"):
        read_text(tmp_path, squat.scaled(0.01).text(decimals=7), unit="mm")


# --- how many frames, and how long -----------------------------------------------------------------------------------


@given(there=st.integers(9, 40), apart=st.integers(-3, 3))
@MANY
def test_one_frame_more_or_fewer_than_announced(there: int, apart: int, squat: Bvh, tmp_path: Path) -> None:
    text = replace(squat, rows=squat.rows[:there]).text(announced=there + apart)
    if abs(apart) <= 1 and (apart == 0 or there + apart >= 10):
        motion = read_text(tmp_path, text)
        assert len(motion) == there
        told = [note for note in notes_of(motion) if "announced" in note]
        assert told == ([f"{there + apart} frames are announced and {there} are there: those were read"] * abs(apart))
    else:
        with pytest.raises(InputError, match="frames"):
            read_text(tmp_path, text)


@given(
    rate=st.sampled_from([24, 25, 30, 50, 60, 72, 90, 100, 120, 144, 200, 240]),
    decimals=st.integers(4, 10),
    cut=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_a_customary_rate_is_known_by_four_digits(rate: int, decimals: int, cut: bool) -> None:
    shift = 10**decimals
    written = f"{int(shift / rate) / shift:.{decimals}f}" if cut else f"{1 / rate:.{decimals}f}"
    assert frame_rate(written) == rate


@pytest.mark.parametrize(
    ("written", "rate"),
    [
        *(("0.033", 30), ("0.017", 60), ("0.016", 60), ("0.008", 120), ("0.03", 30), ("0.04", 25), ("0.01", 100)),
        *(("0.042", 24), ("0.02", 50), ("0.011", 90), ("0.005", 200), ("0.004", 250), ("0.05", 20), ("0.1", 10)),
        *(("0.0333667", 30 / 1.001), ("0.0417083", 24 / 1.001), ("0.01668333", 60 / 1.001), ("3.33333e-2", 30)),
        *(("0.0303030", 33), ("0.0" + 40 * "3", 30), ("0.0625", 16), ("0.0306", 1 / 0.0306)),
    ],
)
def test_rates_of_written_frame_times(written: str, rate: float) -> None:
    assert frame_rate(written) == pytest.approx(rate, rel=1e-9)


def test_the_option_fps_wins_over_what_is_written(squat: Bvh, tmp_path: Path) -> None:
    for frame_time in ("0.0333333", "0", "fast"):
        motion = read_text(tmp_path, replace(squat, frame_time=frame_time).text(), fps=50)
        assert (motion.fps, notes_of(motion)) == (50.0, ())
    with pytest.raises(InputError, match="line 129: Frame Time 'fast' is not a number; the option fps"):
        read_text(tmp_path, replace(squat, frame_time="fast").text())
    for bad in (0, -30, float("nan"), "60", True):
        with pytest.raises(InputError, match="option fps"):
            read_text(tmp_path, squat.text(), fps=bad)


# --- how large -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["m", "dm", "cm", "mm", "inch", "asf"])
@pytest.mark.parametrize("stature", [1.5, 1.6, 1.75, 1.9])
def test_the_unit_of_grown_people(stature: float, unit: str, squat: Bvh, tmp_path: Path) -> None:
    metres = {"m": 1, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "asf": 0.0254 / 0.45}[unit]
    motion = read_text(tmp_path, squat.scaled(stature / 1.75 * 0.01 / metres).text(decimals=7))
    assert motion.meta["unit"] == unit
    assert motion.meta["stature"] == pytest.approx(stature, rel=0.05)


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
@pytest.mark.parametrize("stature", [0.85, 0.9, 1.0, 1.1, 1.3, 1.4])
def test_the_unit_of_children(stature: float, unit: str, squat: Bvh, tmp_path: Path) -> None:
    metres = {"m": 1, "cm": 0.01, "mm": 0.001}[unit]
    motion = read_text(tmp_path, squat.scaled(stature / 1.75 * 0.01 / metres).text(decimals=7))
    assert motion.meta["unit"] == unit
    assert any(f"taken for {unit}" in note for note in notes_of(motion))


def test_a_doubtful_unit_is_told_and_the_option_decides(squat: Bvh, tmp_path: Path) -> None:
    small = squat.scaled(0.78 / 1.696).text()  # of 78 units: a tall man in inches, or a toddler in centimetres
    guessed = read_text(tmp_path, small)
    other = {"inch": "cm", "cm": "inch"}[guessed.meta["unit"]]
    assert any(f"reader.unit={other}" in note for note in notes_of(guessed))
    given = read_text(tmp_path, small, unit=other)
    assert (given.meta["unit"], notes_of(given)) == (other, ())


def test_what_is_too_quick_in_one_unit_is_of_the_other(squat: Bvh, tmp_path: Path) -> None:
    """Of 80 units: in inches the hips of this sprinter would make 15 m/s."""
    rows = squat.scaled(0.80 / 1.696)
    slow = read_text(tmp_path, squat.scaled(0.74 / 1.696).text())
    assert slow.meta["unit"] == "inch"
    run = replace(rows, rows=rows.rows.copy())
    run.rows[:, 0] += np.arange(len(run.rows)) / 30 * 590
    fast = squat.scaled(0.74 / 1.696)
    fast.rows[:, 0] += np.arange(len(fast.rows)) / 30 * 790
    assert read_text(tmp_path, run.text()).meta["unit"] == "cm"
    assert read_text(tmp_path, fast.text()).meta["unit"] == "cm"


# --- poses that are not of the motion --------------------------------------------------------------------------------


def t_pose(squat: Bvh) -> Array:
    row = np.zeros(squat.rows.shape[1])
    row[1] = 98.0
    return row


@given(
    before=st.integers(0, 70),
    after=st.integers(0, 70),
    jitter=st.sampled_from([0.0, 0.2]),
    rate=st.sampled_from([30, 60, 120]),
)
@MANY
def test_t_poses_of_any_length_are_cut(
    before: int, after: int, jitter: float, rate: int, squat: Bvh, expected: Motion, tmp_path: Path
) -> None:
    random = np.random.default_rng(before)

    def held(count: int) -> Array:
        return t_pose(squat) + jitter * random.standard_normal((count, squat.rows.shape[1]))

    rows = np.concatenate([held(before), squat.rows, held(after)])
    motion = read_text(tmp_path, replace(squat, rows=rows).text(), fps=rate)
    cut = without_lead_in(motion)
    assert len(cut) == len(expected)
    assert np.abs(cut.forward_kinematics()[0] - expected.forward_kinematics()[0]).max() < 1e-3
    assert len(notes_of(cut)) == bool(before) + bool(after)
    assert without_lead_in(cut) is cut


@given(hold=st.integers(1, 60), leave=st.floats(0.3, 2.0), rate=st.sampled_from([30, 60, 120]))
@MANY
def test_who_moves_out_of_a_t_pose_stays(hold: int, leave: float, rate: int, squat: Bvh, tmp_path: Path) -> None:
    """From standing with arms held out into the motion in ``leave`` seconds, speed rising from nothing."""
    count = round(leave * rate)
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, count) / count)[:, None]
    way = t_pose(squat) * (1 - share) + squat.rows[0] * share
    rows = np.concatenate([np.tile(t_pose(squat), (hold, 1)), way, squat.rows])
    for ordered in (rows, rows[::-1]):
        motion = read_text(tmp_path, replace(squat, rows=ordered).text(), fps=rate)
        assert without_lead_in(motion) is motion


def test_a_frame_that_is_wrong_does_not_cost_the_still_part_before_it(squat: Bvh, tmp_path: Path) -> None:
    rows = np.repeat(squat.rows[:1], 60, axis=0)
    rows[40] = t_pose(squat)
    motion = read_text(tmp_path, replace(squat, rows=rows).text())
    assert without_lead_in(motion) is motion
    last = replace(squat, rows=np.concatenate([np.repeat(squat.rows[:1], 60, axis=0), t_pose(squat)[None]]))
    assert len(without_lead_in(read_text(tmp_path, last.text()))) == 60


# --- names and syntax ------------------------------------------------------------------------------------------------


def parts(motion: Motion) -> dict[str, int]:
    return identify(motion.skeleton).parts


def short(name: str) -> str:
    """``LeftFoot`` -> ``Foot``."""
    return name.removeprefix("Left").removeprefix("Right")


def side(name: str) -> str:
    return "L" if name.startswith("Left") else "R" if name.startswith("Right") else ""


STYLES: dict[str, Callable[[str], str]] = {
    "FootL": lambda n: short(n) + side(n),
    "footl": lambda n: (short(n) + side(n)).lower(),
    "FOOTL": lambda n: (short(n) + side(n)).upper(),
    "FootL_jnt": lambda n: f"{short(n)}{side(n)}_jnt",
    "Foot_L": lambda n: short(n) + (f"_{side(n)}" if side(n) else ""),
    "foot.l.001": lambda n: short(n).lower() + (f".{side(n).lower()}.001" if side(n) else ""),
    "LFoot": lambda n: side(n) + short(n),
    "l_foot": lambda n: ((f"{side(n)}_" if side(n) else "") + short(n)).lower(),
    "FootLeft": lambda n: short(n) + n.removesuffix(short(n)),
    "Foot-L": lambda n: short(n) + (f"-{side(n)}" if side(n) else ""),
}
PREFIXES = (
    "",
    "Bob_",
    "Wright_",
    "Carroll_",
    "Hand_Model_01:",
    "Armature|",
    "rig.",
    "Leftwich:",
    "Char01-",
    "Footman_",
)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("prefix", PREFIXES)
def test_sides_and_assets_in_names(style: str, prefix: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    odd = squat.renamed(lambda name: "@" + name)
    hierarchy = re.sub("@(\\w+)", lambda match: prefix + STYLES[style](match[1]), odd.hierarchy)
    motion = read_text(tmp_path, replace(odd, hierarchy=hierarchy).text())
    assert parts(motion) == parts(expected)
    assert_same(motion, expected)


@pytest.mark.parametrize("prefix", ["Bob", "Model7"])
def test_an_asset_that_is_glued_to_its_joints(prefix: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    motion = read_text(tmp_path, squat.renamed(lambda name: prefix + STYLES["LFoot"](name)).text())
    assert parts(motion) == parts(expected)


MMD = {
    "Hips": "センター",
    "Spine": "上半身",
    "Chest": "上半身2",
    "Neck": "首",
    "Head": "頭",
    "Shoulder": "肩",
    "Arm": "腕",
    "ForeArm": "ひじ",
    "Hand": "手首",
    "UpLeg": "足",
    "Leg": "ひざ",
    "Foot": "足首",
    "ToeBase": "つま先",
    "Toe": "つま先",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp932", "utf-16"])
def test_japanese_names(encoding: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    def japanese(name: str) -> str:
        return {"L": "左", "R": "右", "": ""}[side(name)] + MMD[short(name)]

    motion = read_text(tmp_path, squat.renamed(japanese).text().encode(encoding))
    assert "左足首" in motion.skeleton.names
    assert parts(motion) == parts(expected)
    assert_same(motion, expected)


@pytest.mark.parametrize("name", ["Jürgen", "Élodie", "René", "Zoë", "Åsa", "Núñez", "Šárka"])
@pytest.mark.parametrize("joint", [":", "_"])
def test_western_european_letters(name: str, joint: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    hierarchy = re.sub("@", name + joint, squat.renamed(lambda n: "@" + n).hierarchy)
    text = replace(squat, hierarchy=hierarchy).text()
    for encoding in ("cp1252", "utf-8"):
        motion = read_text(tmp_path, text.encode(encoding))
        assert motion.skeleton.names[0] == f"{name}{joint}Hips"
        assert parts(motion) == parts(expected)


def test_one_stray_byte_is_damage_unless_the_encoding_is_given(squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    raw = squat.text().encode().replace(b"JOINT Chest", b"JOINT Ch\xe9st")
    with pytest.raises(InputError, match=r"line 10: byte 0xe9 is not UTF-8 text; the option encoding"):
        read_text(tmp_path, raw)
    assert "Chést" in read_text(tmp_path, raw, encoding="latin-1").skeleton.names
    with pytest.raises(InputError, match="option encoding: 'klingon' is no encoding"):
        read_text(tmp_path, raw, encoding="klingon")


def lower_words(text: str) -> str:
    return re.sub(
        r"HIERARCHY|ROOT|JOINT|End Site|OFFSET|CHANNELS|MOTION|Frames|Frame Time", lambda m: m[0].lower(), text
    )


SYNTAX: dict[str, Callable[[str], str]] = {
    "EndSite": lambda t: t.replace("End Site", "EndSite"),
    "END SITE": lambda t: t.replace("End Site", "END SITE"),
    "End_Site": lambda t: t.replace("End Site", "End_Site"),
    "small letters": lower_words,
    "capitals": lambda t: lower_words(t).upper().replace("ROTATION", "rotation").replace("POSITION", "position"),
    "windows": lambda t: "\ufeff" + t.replace("\n", "\r\n"),
    "mac": lambda t: t.replace("\n", "\r"),
    "tabs": lambda t: t.replace(" ", "\t").replace("Frame\tTime", "Frame Time").replace("End\tSite", "End Site"),
    "blank lines": lambda t: t.replace("\n", "\n\n \t\n"),
    "comments": lambda t: "# by me\n" + t.replace("MOTION", "// turned\nMOTION\n# rows").replace("\n0", "\n# row\n0"),
    "no colons": lambda t: t.replace("Frames:", "Frames").replace("Frame Time:", "Frame Time"),
    "blank before colon": lambda t: t.replace("Frames:", "Frames :").replace("Frame Time:", "FrameTime :"),
    "brace behind": lambda t: re.sub(r"\n\s*\{", " {", t),
}


@pytest.mark.parametrize("kind", SYNTAX)
def test_ways_to_write_it(kind: str, squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    motion = read_text(tmp_path, SYNTAX[kind](squat.text()))
    assert_same(motion, expected)
    assert notes_of(motion) == ()


@pytest.mark.parametrize("glue", ["minus", "width"])
@pytest.mark.parametrize("decimals", [4, 6])
def test_numbers_without_a_blank_between_them(
    glue: str, decimals: int, squat: Bvh, expected: Motion, tmp_path: Path
) -> None:
    text = squat.text(decimals=decimals)
    head, rows = text.split("Frame Time")
    if glue == "minus":
        rows = rows.replace(" -", "-")
    else:  # columns as wide as the longest number of this file
        lines = rows.split("\n")
        width = max(len(word) for line in lines[1:] for word in line.split())
        lines[1:] = ["".join(word.rjust(width) for word in line.split()) for line in lines[1:]]
        rows = "\n".join(lines)
        assert re.search(rf"\.\d{{{decimals}}}-?\d", rows)
    motion = read_text(tmp_path, head + "Frame Time" + rows)
    assert_same(motion, expected, tolerance=2e-3)
    assert any("told apart" in note for note in notes_of(motion))


def test_glued_offsets(squat: Bvh, expected: Motion, tmp_path: Path) -> None:
    hierarchy = re.sub(r"(?<=OFFSET)(.*)", lambda m: " " + m[1].strip().replace(" -", "-"), squat.hierarchy)
    assert hierarchy != squat.hierarchy
    assert_same(read_text(tmp_path, replace(squat, hierarchy=hierarchy).text()), expected)


def test_what_cannot_be_read_names_line_expected_and_found(squat: Bvh, tmp_path: Path) -> None:
    for broken, line, said in (
        (squat.text().replace("CHANNELS", "CHANELS", 1), 5, "unknown word 'CHANELS' in the hierarchy: expected JOINT"),
        (squat.text().replace("\nFrame Time", "\nTime"), 129, "expected 'Frames:' and 'Frame Time:', found 'Time"),
    ):
        with pytest.raises(InputError, match=re.escape(f"line {line}: {said}")):
            read_text(tmp_path, broken)


# --- AMC -------------------------------------------------------------------------------------------------------------


def amc(shared: Path) -> tuple[str, str]:
    folder = shared / "cases" / "amc_start0"
    return (folder / "s.asf").read_text(), (folder / "s.amc").read_text()


@pytest.mark.parametrize("name", ["amc_start0", "amc_start100"])
def test_amc_cases(name: str, shared: Path, tmp_path: Path) -> None:
    motion = read_motion(shared / "cases" / name / "s.amc")
    frames = len(re.findall(r"^\d+\s*$", (shared / "cases" / name / "s.amc").read_text(), re.MULTILINE))
    assert len(motion) == frames > 10
    assert_same(motion, read_motion(shared / "cases" / "amc_start0" / "s.amc"))


@given(first=st.integers(0, 10**8))
@MANY
def test_amc_starts_anywhere_and_skips_nothing(first: int, shared: Path, tmp_path: Path) -> None:
    asf, text = amc(shared)
    (tmp_path / "s.asf").write_text(asf)
    numbered = re.sub(r"^(\d+)\s*$", lambda m: str(int(m[1]) + first), text, flags=re.MULTILINE)
    assert_same(read_text(tmp_path, numbered, "s.amc"), read_motion(shared / "cases" / "amc_start0" / "s.amc"))
    skipped = re.sub(rf"^{first + 7}\s*$", str(first + 8), numbered, flags=re.MULTILINE)
    with pytest.raises(InputError, match=f"frame '{first + 8}' where {first + 7} should be"):
        read_text(tmp_path, skipped, "s.amc")


def test_options_of_amc(shared: Path, tmp_path: Path) -> None:
    asf, text = amc(shared)
    (tmp_path / "s.asf").write_text(asf)
    right = read_text(tmp_path, text, "s.amc")
    assert_same(read_text(tmp_path, re.sub(r"(?<=\d) -", "-", text), "s.amc"), right)
    # The same numbers under a unit that is not theirs: no person is as small as that.
    (tmp_path / "s.asf").write_text(asf.replace("length 1.0", "length 10.0"))
    mended = read_text(tmp_path, text, "s.amc")
    assert_same(mended, right)
    assert "inch is taken" in notes_of(mended)[0]
    asked = read_text(tmp_path, text, "s.amc", unit="cm", fps=60, up="z")
    assert (asked.fps, asked.meta["unit"], asked.meta["up"]) == (60, "cm", "z")
    offset = rot.rotate(up_rotation("y"), asked.qpos[:, :3]) / 0.01
    np.testing.assert_allclose(offset, right.qpos[:, :3] / 0.0254, atol=1e-9)


def test_up_and_rate_of_deepmimic(shared: Path, tmp_path: Path) -> None:
    path = shared / "data" / "deepmimic" / "humanoid3d_walk.txt"
    right, asked = read_motion(path), read_motion(path, up="z", fps=60)
    np.testing.assert_allclose(rot.rotate(up_rotation("y"), asked.qpos[:, :3]), right.qpos[:, :3], atol=1e-12)
    assert asked.fps == 60
    content = json.loads(path.read_text())
    for frame in content["Frames"]:
        frame[0] = 0.033
    assert read_text(tmp_path, json.dumps(content), "clip.txt").fps == 30
    with pytest.raises(InputError, match="option up"):
        read_motion(path, up="down")


# --- AMASS and SMPL --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smpl(shared: Path) -> dict[str, Array]:
    with np.load(shared / "cases" / "amass_zup.npz", allow_pickle=False) as arrays:
        return {name: arrays[name] for name in ("poses", "trans", "mocap_framerate")}


@pytest.fixture(scope="module")
def standing(shared: Path) -> Motion:
    return read_motion(shared / "cases" / "amass_zup.npz")


def save(folder: Path, **arrays: object) -> Path:
    np.savez(folder / "a.npz", **arrays)
    return folder / "a.npz"


@pytest.mark.parametrize("name", ["amass_yup", "amass_zup", "split_keys", "gvhmr_keys", "poses3d", "no_rate"])
def test_smpl_cases(name: str, shared: Path, standing: Motion) -> None:
    path = shared / "cases" / f"{name}.npz"
    options = {}
    if name in ("gvhmr_keys", "no_rate"):
        with pytest.raises(InputError, match="the frame rate is not said; give the option fps"):
            read_motion(path)
        options["fps"] = 60
    motion = read_motion(path, **options)
    assert (motion.fps, motion.meta["up"]) == (60, "y" if name in ("amass_yup", "gvhmr_keys") else "z")
    assert any("y is taken for up" in note for note in notes_of(motion)) == (motion.meta["up"] == "y")
    # The pelvis's own place is not turned in a file that was turned as a whole: everything is off by one vector.
    apart = parts_positions(motion) - parts_positions(standing)
    assert np.abs(apart - apart[:1, :1]).max() < 0.02
    assert np.abs(apart).max() < 0.35


def turned(arrays: dict[str, Array], to_file: Array, moved: Array) -> dict[str, Array]:
    """Arrays z up in another world: turned by a quaternion after a move along the floor."""
    pelvis = rest_positions()[0]
    poses = arrays["poses"].copy()
    poses[:, :3] = rot.to_rotvec(rot.multiply(to_file[None], rot.from_rotvec(poses[:, :3])))
    place = rot.rotate(to_file[None], arrays["trans"] + pelvis + moved) - pelvis
    return {**arrays, "poses": poses, "trans": place}


@given(
    up=st.sampled_from(["z", "y", "-y"]),
    yaw=st.floats(-np.pi, np.pi),
    moved=st.tuples(st.floats(-4, 4), st.floats(-4, 4)),
    zeroed=st.booleans(),
    still=st.booleans(),
)
@MANY
def test_up_is_found_of_whoever_stands(
    up: str, yaw: float, moved: tuple[float, float], zeroed: bool, still: bool,
    smpl: dict[str, Array], standing: Motion, tmp_path: Path,
) -> None:  # fmt: skip
    to_file = rot.multiply(rot.conjugate(up_rotation(up)), rot.from_axis_angle(np.array([0.0, 0, 1]), np.array(yaw)))
    arrays = turned(smpl, to_file, np.array([*moved, 0.0]))
    if zeroed:
        arrays["trans"] = arrays["trans"] - arrays["trans"][0]
    if still:
        arrays |= {name: np.repeat(arrays[name][:1], 30, axis=0) for name in ("poses", "trans")}
    motion = read_motion(save(tmp_path, **arrays))
    assert motion.meta["up"] == up
    expected = standing.forward_kinematics()[0][: len(motion) if not still else 1]
    unturned = rot.from_axis_angle(np.array([0.0, 0, 1]), np.array(-yaw))
    found = rot.rotate(unturned, motion.forward_kinematics()[0])
    np.testing.assert_allclose(
        found - found[:1, :1], np.broadcast_to(expected, found.shape) - expected[:1, :1], atol=1e-6
    )


@given(
    up=st.sampled_from(["z", "y"]),
    yaw=st.floats(-np.pi, np.pi),
    # Recorded about the origin: further off, the side of a body that lies may be as near to nought as its floor.
    moved=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
@MANY
def test_up_is_found_of_one_who_lies_down(
    up: str, yaw: float, moved: tuple[float, float], smpl: dict[str, Array], tmp_path: Path
) -> None:
    """From standing to lying on the back and up again: head and feet say little on the whole, the floor says it."""
    angle = np.clip(np.sin(np.linspace(0, np.pi, 240)) * 1.4, 0, 1) * np.pi / 2
    poses, trans = smpl["poses"][:1].repeat(240, 0), np.zeros((240, 3))
    back = rot.from_axis_angle(np.array([1.0, 0, 0]), -angle)
    poses[:, :3] = rot.to_rotvec(rot.multiply(back, rot.from_rotvec(poses[:, :3])))
    trans[:, 2] = 0.95 * np.cos(angle) + 0.12 * np.sin(angle)
    to_file = rot.multiply(rot.conjugate(up_rotation(up)), rot.from_axis_angle(np.array([0.0, 0, 1]), np.array(yaw)))
    arrays = turned({**smpl, "poses": poses, "trans": trans}, to_file, np.array([*moved, 0.0]))
    assert read_motion(save(tmp_path, **arrays)).meta["up"] == up


def test_the_option_up_of_smpl_files(smpl: dict[str, Array], tmp_path: Path) -> None:
    path = save(tmp_path, **smpl)
    as_y = read_motion(path, up="y")
    assert (as_y.meta["up"], notes_of(as_y)) == ("y", ())
    right = read_motion(path, up="z")
    turned_back = rot.rotate(up_rotation("y"), right.forward_kinematics()[0])
    np.testing.assert_allclose(as_y.forward_kinematics()[0], turned_back, atol=1e-9)
    with pytest.raises(InputError, match="option up: 'w' is none of auto, x"):
        read_motion(path, up="w")


def matrices(vectors: Array) -> Array:
    return rot.to_scipy(rot.from_rotvec(vectors)).as_matrix().reshape(*vectors.shape, 3)


def flat(vectors: Array) -> Array:
    return vectors.reshape(len(vectors), -1)


ARRAYS: dict[str, Callable[[Array, Array], dict[str, Array]]] = {
    "amass smplx": lambda v, t: {"trans": t, "root_orient": v[:, 0], "pose_body": flat(v[:, 1:22])},
    "smplx": lambda v, t: {"transl": t, "global_orient": v[:, 0], "body_pose": flat(v[:, 1:22])},
    "smpl": lambda v, t: {"transl": t, "global_orient": v[:, :1], "body_pose": v[:, 1:24]},
    "flat smpl": lambda v, t: {"trans": t, "pose": flat(v[:, :24])},
    "joints": lambda v, t: {"trans": t, "poses": v[:, :22]},
    "matrices": lambda v, t: {
        "transl": t[:, None],
        "global_orient": matrices(v[:, :1]),
        "body_pose": matrices(v[:, 1:24]),
    },
    "root matrix": lambda v, t: {"transl": t, "global_orient": matrices(v[:, 0]), "body_pose": matrices(v[:, 1:22])},
    "float32": lambda v, t: {"trans": t.astype("f4"), "fullpose": flat(v).astype("f4")},
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_of_other_tools(kind: str, smpl: dict[str, Array], standing: Motion, tmp_path: Path) -> None:
    vectors = smpl["poses"].reshape(len(smpl["poses"]), -1, 3)
    path = save(tmp_path, **ARRAYS[kind](vectors, smpl["trans"]), betas=np.zeros(10), fps=np.array(60))
    assert_same(read_motion(path), standing)
    assert_same(read_motion(path, fps=60.0), standing)


def test_arrays_that_do_not_fit_are_named(smpl: dict[str, Array], tmp_path: Path) -> None:
    good = {"transl": smpl["trans"], "global_orient": smpl["poses"][:, :3], "body_pose": smpl["poses"][:, 3:66]}
    for change, said in (
        ({"body_pose": smpl["poses"][:, 3:60]}, r"body_pose: shape \(240, 57\) beside global_orient"),
        ({"body_pose": smpl["poses"][:, 3:65]}, "body_pose: 62 columns"),
        ({"global_orient": smpl["poses"][:9, :3]}, "body_pose: shape"),
        ({"body_pose": np.full((240, 21, 3, 3), np.nan)}, "body_pose: frame 0 is not finite"),
        ({"transl": smpl["trans"][0]}, r"transl: shape \(3,\), body_pose have 240 frames"),
    ):
        with pytest.raises(InputError, match=said):
            read_motion(save(tmp_path, **{**good, **change}), fps=30)
    with pytest.raises(InputError, match="poses: missing: an AMASS or SMPL file holds poses, or root_orient"):
        read_motion(save(tmp_path, transl=smpl["trans"], body_pose=good["body_pose"]), fps=30)


# --- what the commands pass on and tell ------------------------------------------------------------------------------


def test_prepare_passes_reader_options_on_and_tells_the_notes(
    squat: Bvh, smpl: dict[str, Array], tmp_path: Path
) -> None:
    rows = np.concatenate([t_pose(squat)[None], squat.rows[:40]])
    (tmp_path / "led.bvh").write_text(replace(squat, rows=rows, frame_time="0.033").text(announced=40))
    poses, trans = smpl["poses"][:60], smpl["trans"][:60]
    np.savez(tmp_path / "timeless.npz", poses=poses, trans=trans)
    takes = f"[{{motion: {tmp_path}/led.bvh}}, {{motion: {tmp_path}/timeless.npz, reader: {{fps: 60}}}}]"
    overrides = ["data=own", f"data.takes={takes}", f"data.store={tmp_path}/store", "data.reader.up=y", "sim=fast"]
    with pytest.raises(InputError, match=r"fps: 'x' is not a frame rate"):
        prepare(compose_config("prepare", [*overrides, "data.reader.fps=x"]), progress=False, flow=False)
    store = prepare(compose_config("prepare", overrides), progress=False, flow=False)
    assert [take.length for take in store.takes] == [40, 30]
    assert store.clip(0).meta["up"] == store.clip(1).meta["up"] == "y"
    lines = store_report(TakeStore.open(store.root)).splitlines()
    told = [line for line in lines if line.startswith("led: ")]
    assert told == [f"led: {note}" for note in notes_of(store.clip(0))]
    assert len(told) == 3
    assert "40 frames are announced and 41 are there" in told[0]
    assert "a frame of a still pose before the motion" in told[2]


def test_export_and_view_read_with_options_and_tell(
    squat: Bvh, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.bvh"
    path.write_text(replace(squat, frame_time="0.033").text())
    monkeypatch.setattr("sys.argv", ["export", str(path), f"to={tmp_path}/b.csv", "reader.unit=m", "reader.up=z"])
    with pytest.raises(SystemExit):
        export.main()
    assert "option unit: makes the body 170 m tall" in capsys.readouterr().err
    monkeypatch.setattr(
        "sys.argv", ["export", str(path), f"to={tmp_path}/b.npz", "reader.up=z", "forces.enabled=false"]
    )
    export.main()
    assert "a: the frame time 0.033 s is taken for 30 frames/s" in capsys.readouterr().err
    assert read_motion(tmp_path / "b.npz").meta["up"] == "z"
    clip = read_run(path, reader={"up": "z", "fps": 25}).clips["a"].motion
    assert (clip.fps, clip.meta["up"]) == (25, "z")


def test_notes_of_a_clip_from_elsewhere_are_short_lines_of_text(expected: Motion) -> None:
    strange = replace(expected, meta={"notes": ["a\nb", 3, None, "c" * 1000, *["d"] * 50]})
    assert notes_of(strange)[0] == "a b"
    assert max(map(len, notes_of(strange))) == 300
    assert len(notes_of(strange)) < 30
    for meta in ({}, {"notes": "text"}, {"notes": {"a": 1}}):
        assert notes_of(replace(expected, meta=meta)) == ()
