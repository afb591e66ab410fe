"""Broken and hostile files: one clear error that names file, place and cause, at once and in little memory."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import blamed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.motion.io import _npz, read_motion, write_motion
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Joint, Skeleton, hinges

HEAD = """HIERARCHY
ROOT Hips
{
OFFSET 0 0 0
CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT LeftFoot
{
OFFSET 0 -90 0
CHANNELS 3 Zrotation Xrotation Yrotation
End Site
{
OFFSET 0 -5 10
}
}
JOINT Head
{
OFFSET 0 70 0
CHANNELS 3 Zrotation Xrotation Yrotation
End Site
{
OFFSET 0 15 0
}
}
}
"""
ROW = "0 95 0 0 0 0 0 0 0 0 0 0\n"
GOOD = HEAD + "MOTION\nFrames: 2\nFrame Time: 0.0333\n" + ROW + ROW

BVH: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "size: the file is empty"),
    "blank": (" \n\n", "size: the file is empty"),
    "not bvh": ("hello\nMOTION\n", "line 1: expected HIERARCHY"),
    "no motion": (HEAD, "no MOTION section"),
    "not utf8": (GOOD.encode().replace(b"Head", b"H\xe9ad"), "line 15: byte 0xe9 is not UTF-8"),
    "binary": (GOOD.encode() + b"\0", "zero byte"),
    "2 GB of zeros announced": (GOOD.replace("Frames: 2", "Frames: 89478485"), "line 26: 89478485 frames of 12"),
    "10^12 frames": (GOOD.replace("Frames: 2", "Frames: 1000000000000"), "line 26: 1000000000000 frames"),
    "10^99 frames": (GOOD.replace("Frames: 2", "Frames: 1" + "0" * 99), "line 26: Frames must be a positive"),
    "negative frames": (GOOD.replace("Frames: 2", "Frames: -2"), "line 26: Frames must be"),
    "no frames": (GOOD.replace("Frames: 2", "Frames: 0"), "line 26: Frames must be"),
    "too many rows": (GOOD + ROW, "line 30: more than the 2 frames"),
    "cut between rows": (
        GOOD[: -len(ROW)],
        "line 26: 2 frames of 12 numbers announced, only 25 bytes follow: cut short",
    ),
    "cut in a row": (GOOD[:-2] + "\n", "line 29: frame 2 of 2 has 11 numbers"),
    "cut in the head": (GOOD[: len(HEAD) + 20], "line 27: expected 'Frames:' and 'Frame Time:', found 'Fra'"),
    "nan": (GOOD.replace("0 95", "nan 95"), "line 28: 'nan' is not finite"),
    "inf": (GOOD[:-2] + "inf\n", "line 29: 'inf' is not finite"),
    "huge number": (GOOD.replace("0 95", "1e300 95"), "line 28: '1e300' is not finite or absurdly large"),
    "word": (GOOD.replace("0 95", "zero 95"), "line 28: 'zero' is not a number"),
    "frame time zero": (GOOD.replace("0.0333", "0"), "line 27: Frame Time"),
    "frame time nan": (GOOD.replace("0.0333", "nan"), "line 27: Frame Time"),
    "frame time word": (GOOD.replace("0.0333", "fast"), "line 27: Frame Time"),
    "missing brace": (GOOD.replace("}\n}\nMOTION", "}\nMOTION"), "line 23: 1 brace(s) not closed"),
    "brace too many": (GOOD.replace("}\nMOTION", "}\n}\nMOTION"), "line 25: '}' without a '{'"),
    "duplicate": (GOOD.replace("Head", "LeftFoot"), "line 15: joint 'LeftFoot' stands twice, first on line 6"),
    "offset nan": (GOOD.replace("0 70 0", "0 nan 0"), "line 17: OFFSET"),
    "offset short": (GOOD.replace("0 70 0", "0 70"), "line 17: OFFSET"),
    "no offset": (GOOD.replace("OFFSET 0 70 0\n", ""), "joint 'Head' has no OFFSET"),
    "channel": (GOOD.replace("Zrotation Xrotation", "Wrotation Xrotation", 1), "line 5: unknown channel 'wrotation'"),
    "channel twice": (GOOD.replace("Xposition Yposition", "Xposition Xposition"), "line 5: a channel stands twice"),
    "channel count": (GOOD.replace("CHANNELS 3", "CHANNELS 999999999999"), "line 9: CHANNELS wants"),
    "second root": (GOOD.replace("JOINT Head", "ROOT Head"), "line 15: one ROOT"),
    "micrometres": (GOOD.replace("-90", "-9e5").replace(" 70", " 7e5"), "OFFSET: the body is about"),
    "no size": (GOOD.replace("-90", "0").replace(" 70", " 0"), "OFFSET: the body is about 0 units"),
    "nested": (
        "HIERARCHY\nROOT j\n{\nOFFSET 0 0 0\n"
        + "".join(f"JOINT j{i}\n{{\nOFFSET 0 1 0\n" for i in range(100_000))
        + "MOTION\nFrames: 1\n",
        "more than 2048 joints",
    ),
    "one huge line": ("HIERARCHY " + "{" * 30_000_000 + "\nMOTION\n", "MOTION: stands behind 30000011 characters"),
    "one long line": ("HIERARCHY " + "{" * 30_000 + "\nMOTION\n", "line 1: 30010 characters long"),
    "huge motion line": (GOOD + "0 " * 10_000_000, "line 30: 20000000 characters long"),
}


@pytest.mark.parametrize("case", sorted(BVH))
def test_bvh(case: str, tmp_path: Path) -> None:
    content, expected = BVH[case]
    path = tmp_path / "bad.bvh"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    blamed(path, expected)


def test_the_good_file_reads(tmp_path: Path) -> None:
    path = tmp_path / "good.bvh"
    path.write_text("\ufeff" + GOOD.replace("\n", "\r\n"), encoding="utf-8")
    assert read_motion(path).meta["unit"] == "cm"
    path.write_text(BVH["micrometres"][0])
    assert len(read_motion(path, unit=1e-6)) == 2


def test_options_and_paths(tmp_path: Path) -> None:
    path = tmp_path / "good.bvh"
    path.write_text(GOOD)
    blamed(path, "option unit: 'furlong' is none of", unit="furlong")
    blamed(path, "option unit: -1 is none of", unit=-1)
    blamed(path, "option up: 'w' is none of", up="w")
    blamed(path, "option colour: read_bvh has the options unit, up", colour=1)
    blamed(tmp_path / "none.bvh", "no such file")
    blamed(tmp_path / "none.npz", "no such file")
    blamed(tmp_path / "a.fbx", "no reader for '.fbx'")
    (tmp_path / "folder.bvh").mkdir()
    blamed(tmp_path / "folder.bvh", "is a folder")
    with pytest.raises(InputError, match="no writer"):
        write_motion(read_motion(path), tmp_path / "a.fbx")
    with pytest.raises(InputError, match="no folder"):
        write_motion(read_motion(path), tmp_path / "none" / "a.bvh")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_bvh_reads_or_says_why(tmp_path: Path, data: st.DataObject) -> None:
    """Cut, doubled or overwritten anywhere: a Motion or one InputError, never another exception."""
    raw = GOOD.encode()
    start = data.draw(st.integers(0, len(raw)))
    stop = data.draw(st.integers(start, min(len(raw), start + 30)))
    damaged = raw[:start] + data.draw(st.one_of(st.just(raw[start:stop] * 2), st.binary(max_size=8))) + raw[stop:]
    path = tmp_path / "m.bvh"
    path.write_bytes(damaged)
    try:
        read_motion(path)
    except InputError as error:
        blamed_file = error.source
    else:
        blamed_file = str(path)
    assert blamed_file == str(path)


ASF = """:version 1.10
:units
length 0.45
angle deg
:root
order TX TY TZ RX RY RZ
axis XYZ
position 0 0 0
orientation 0 0 0
:bonedata
begin
name leg
direction 0 -1 0
length 16
axis 0 0 20 XYZ
dof rx ry rz
end
:hierarchy
begin
root leg
end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 17 0 0 0 0\nleg 1 2 3\n2\nroot 0 17 0 0 0 0\nleg 1 2 3\n"

ACCLAIM: dict[str, tuple[str, str, str]] = {
    "frame cut": (ASF, AMC[:-10], "frame 2 lacks bone 'leg'"),
    "numbers missing": (ASF, AMC[:-3] + "\n", "line 8: 3 numbers wanted, 2 found"),
    "nan": (ASF, AMC.replace("1 2 3", "1 nan 3"), "line 5: '1 nan 3': not finite"),
    "word": (ASF, AMC.replace("1 2 3", "1 x 3"), "line 5: '1 x 3' are not numbers"),
    "unknown bone": (ASF, AMC.replace("leg", "arm"), "line 5: 'arm' is no moving bone"),
    "frame number": (ASF, AMC.replace("\n2\n", "\n999999999999\n"), "line 6: frame '999999999999' where 2"),
    "bone twice": (ASF, AMC + "leg 1 2 3\n", "line 9: bone 'leg' twice in frame 2"),
    "no frames": (ASF, ":DEGREES\n", "no frames"),
    "empty": (ASF, "", "the file is empty"),
    "no hierarchy": (ASF[: ASF.index(":hier")], AMC, ":hierarchy: this section is missing"),
    "unknown child": (ASF.replace("root leg", "root leg arm"), AMC, "line 20: bone 'arm' is not among"),
    "two parents": (ASF.replace("root leg", "root leg leg"), AMC, "line 20: bone 'leg' has two parents"),
    "loop": (ASF.replace("root leg", "leg leg"), AMC, ":hierarchy: bone 'leg' hangs on no chain"),
    "no length": (ASF.replace("length 16\n", ""), AMC, "line 16: a bone without length"),
    "bad unit": (ASF.replace("0.45", "0"), AMC, "line 3: length 0"),
    "bone cut": (ASF.replace("dof rx ry rz\nend\n", ""), AMC, "the last bone has no end"),
    "bad axis": (ASF.replace("20 XYZ", "20 XXZ"), AMC, "line 15: axis order 'xxz'"),
    "bad dof": (ASF.replace("rx ry rz", "rx rx"), AMC, "line 16: dof 'rx rx'"),
    "no axis": (ASF.replace("axis 0 0 20 XYZ", "axis"), AMC, "line 15: 3 numbers wanted"),
}


@pytest.mark.parametrize("case", sorted(ACCLAIM))
def test_acclaim(case: str, tmp_path: Path) -> None:
    asf, amc, expected = ACCLAIM[case]
    (tmp_path / "01.asf").write_text(asf)
    path = tmp_path / "01_01.amc"
    path.write_text(amc)
    with pytest.raises(InputError) as caught:
        read_motion(path)
    assert expected in str(caught.value)
    assert Path(caught.value.source).name == ("01.asf" if asf != ASF else "01_01.amc")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_acclaim_reads_or_says_why(tmp_path: Path, data: st.DataObject) -> None:
    texts = {"01.asf": ASF.encode(), "01_01.amc": AMC.encode()}
    name = data.draw(st.sampled_from(sorted(texts)))
    raw = texts[name]
    start = data.draw(st.integers(0, len(raw)))
    stop = data.draw(st.integers(start, min(len(raw), start + 30)))
    texts[name] = raw[:start] + data.draw(st.one_of(st.just(raw[start:stop] * 2), st.binary(max_size=8))) + raw[stop:]
    for each, content in texts.items():
        (tmp_path / each).write_bytes(content)
    try:
        read_motion(tmp_path / "01_01.amc")
    except InputError as error:
        blamed_file = Path(error.source)
    else:
        blamed_file = tmp_path / "01_01.amc"
    assert blamed_file.parent == tmp_path


FRAME = [0.033, 0, 0.9, 0, *([1.0, 0, 0, 0] * 3), *([1.0, 0, 0, 0, 0.0, 1.0, 0, 0, 0, 1.0, 0, 0, 0, 0.0] * 2)]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{", "line 1: not JSON"),
        ("[1, 2]", "Frames: a DeepMimic clip is"),
        (json.dumps({"Frames": []}), "Frames: a DeepMimic clip is"),
        (json.dumps({"Frames": [FRAME, FRAME[:-1]]}), "Frames[1]: a frame is 44 numbers, found 43 numbers"),
        (json.dumps({"Frames": [FRAME, "x"]}), "Frames[1]: a frame is 44 numbers, found str"),
        (json.dumps({"Frames": [[*FRAME[:43], "x"]]}), "Frames[0]: number 43 is 'x'"),
        (json.dumps({"Frames": [[*FRAME[:43], float("nan")]]}), "Frames[0]: number 43 is nan"),
        (json.dumps({"Frames": [[*FRAME[:43], 1e999]]}), "Frames[0]: number 43 is inf"),
        (json.dumps({"Frames": [[*FRAME[:43], 10**400]]}), "Frames[0]: number 43 is 1000"),
        (json.dumps({"Frames": [[0.03, 0, 1, 0, *[0.0] * 40]]}), "a quaternion of length 0"),
        (json.dumps({"Frames": [[-1.0, *FRAME[1:]], FRAME]}), "Frames[0]: duration -1 s is not positive"),
        (json.dumps({"Frames": [[1e5, *FRAME[1:]], FRAME, FRAME, FRAME]}), "durations differ too much"),
        ("[" * 200_000, "nested too deeply"),
        ('{"Frames": [[' + "9" * 5000 + "]]}", "not JSON"),
    ],
)
def test_deepmimic(content: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "clip.txt"
    path.write_text(content)
    blamed(path, expected)


def archive(**arrays: np.ndarray | bytes) -> bytes:
    """An npz of arrays, or of raw entries."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as out:
        for name, value in arrays.items():
            if isinstance(value, np.ndarray):
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, value, allow_pickle=True)
                value = buffer.getvalue()
            out.writestr(f"{name}.npy", value)
    return stream.getvalue()


def npy_header(shape: tuple[int, ...]) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue()


POSES, TRANS, RATE = np.zeros((3, 156)), np.zeros((3, 3)), np.array(60.0)


def bomb() -> bytes:
    """32 MB of zeros in 32 kB."""
    stream = io.BytesIO()
    with (
        zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as out,
        out.open("poses.npy", "w", force_zip64=True) as entry,
    ):
        entry.write(npy_header((2**25 // (156 * 8), 156)))
        entry.write(bytes(2**25))
    return stream.getvalue()


NPZ: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "size: not an npz"),
    "no zip": (lambda: b"PK hello", "zip: not an npz"),
    "cut": (lambda: archive(poses=POSES, trans=TRANS)[:-30], "zip: not an npz"),
    "no trans": (lambda: archive(poses=POSES), "trans: missing"),
    "no rate": (lambda: archive(poses=POSES, trans=TRANS), "mocap_framerate: missing"),
    "bad rate": (lambda: archive(poses=POSES, trans=TRANS, mocap_framerate=np.array(-1.0)), "is not a frame rate"),
    "rates": (lambda: archive(poses=POSES, trans=TRANS, mocap_framerate=TRANS), "is not a frame rate"),
    "columns": (lambda: archive(poses=POSES[:, :7], trans=TRANS, mocap_framerate=RATE), "poses: 7 columns"),
    "frames": (lambda: archive(poses=POSES, trans=TRANS[:2], mocap_framerate=RATE), "trans: shape (2, 3)"),
    "rank": (lambda: archive(poses=POSES[0], trans=TRANS, mocap_framerate=RATE), "poses: must be [T, n]"),
    "no rows": (lambda: archive(poses=POSES[:0], trans=TRANS[:0], mocap_framerate=RATE), "poses: must be [T, n]"),
    "text": (lambda: archive(poses=np.array([["a"]]), trans=TRANS), "poses: holds '<U1', which are no numbers"),
    "nan": (lambda: archive(poses=POSES * np.nan, trans=TRANS, mocap_framerate=RATE), "poses: frame 0 is not finite"),
    "pickle": (lambda: archive(poses=np.array([{}], dtype=object), trans=TRANS), "poses: holds pickled objects"),
    "false shape": (lambda: archive(poses=npy_header((10**12, 156)) + bytes(99)), "poses: shape (1000000000000, 156)"),
    "no header": (lambda: archive(poses=b"xx", trans=TRANS), "poses: damaged"),
    "bomb": (bomb, "bytes announced once unpacked; at most 16777216"),
    "own, no json": (lambda: archive(header=np.frombuffer(b"{", np.uint8)), "header: not JSON"),
    "own, wrong": (lambda: archive(header=np.frombuffer(b"{}", np.uint8)), "header.format: is not"),
    "own, floats": (lambda: archive(header=TRANS), "header: missing or not bytes"),
}


@pytest.mark.parametrize("case", sorted(NPZ))
def test_npz(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _npz.MAX_UNPACKED_BYTES == 2**28
    monkeypatch.setattr(_npz, "MAX_UNPACKED_BYTES", 2**24)
    make, expected = NPZ[case]
    path = tmp_path / "clip.npz"
    path.write_bytes(make())
    blamed(path, expected)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"version": 99}, "header.version: 99; this program reads 1"),
        ({"fps": -1}, "header.fps: -1 is not"),
        ({"fps": "fast"}, "header.fps: 'fast' is not"),
        ({"meta": 3}, "header.meta"),
        ({"skeleton": {"name": "", "joints": []}}, "header.skeleton: a skeleton needs at least one joint"),
        ({"skeleton": {}}, "header.skeleton: key 'joints' is missing"),
        ({"skeleton": {"joints": [{"name": "a", "parent": 4}]}}, "header.skeleton: key 'dofs' is missing"),
        ({"contact_names": None}, "qpos: "),
    ],
)  # fmt: skip
def test_own_clip(change: dict[str, object], expected: str, tmp_path: Path) -> None:
    skeleton = Skeleton((Joint("root", -1, (0, 0, 0)), Joint("a", 0, (0, 0, 1), hinges("z"))))
    path = tmp_path / "clip.npz"
    write_motion(Motion(skeleton, np.ones((2, 8)), 30.0), path)
    with np.load(path, allow_pickle=False) as arrays:
        header, qpos = json.loads(arrays["header"].tobytes()), arrays["qpos"]
    encoded = np.frombuffer(json.dumps({**header, **change}).encode(), np.uint8)
    path.write_bytes(archive(header=encoded, qpos=qpos))
    blamed(path, expected)
    for bad, cause in ((qpos[:, :5], "qpos must be"), (qpos * np.nan, "not finite"), (qpos.astype(int), "not float32")):
        path.write_bytes(archive(header=np.frombuffer(json.dumps(header).encode(), np.uint8), qpos=bad))
        blamed(path, cause)
