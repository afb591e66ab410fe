"""What is fuzzed: for each reader its seeds, what one input becomes, what must hold of what comes out, a mutator.

An input is bytes. Files of two parts (a skeleton and its motion, a folder's JSON) are cut at a line ``%%``.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CUT = b"\n%%\n"
HOSTILE = (
    *(b"nan inf -inf 1e308 -1e308 1e-320 0 -0 -1 1 2 7 44 2049 65536 4294967296 9223372036854775808".split()),
    *(b'99999999999999999999 0x10 1_0 1e5 1e7 .5 +3 \xef\xbc\x91 \xe2\x80\xae \xff { } [ ] " , : # ( )'.split()),
    *(b'true null NaN Infinity {} [] "" ${oc.env:HOME} &a *a !!python/object/apply:os.system ../x /dev/zero'.split()),
    *(b"ROOT JOINT End Site OFFSET CHANNELS Xposition Zrotation MOTION Frames: HIERARCHY".split()),
    *(b"<!DOCTYPE <!ENTITY &a; <frame <position> </frames> type= tpose label= frameRate= PathFileType Units".split()),
    *(b":units :root :bonedata :hierarchy begin end dof axis order rx tz length angle rad :RADIANS root".split()),
)


@dataclass(frozen=True)
class Reader:
    """One reader under test.

    Args:
        seeds: small whole files to start from.
        read: takes a path to a file of the input's bytes and reads it; raises what the reader raises, or
            AssertionError when what it returns is not what it promises.
        suffix: of the file.
        instrument: modules in which edges are counted.
        binary: mutated as an archive, not as words.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], None]
    suffix: str
    instrument: tuple[str, ...]
    binary: bool = False


def sane(motion: object) -> None:
    """What every reader promises of the Motion it returns."""
    from egopose.motion.motion import Motion

    assert isinstance(motion, Motion)
    assert np.isfinite(motion.qpos).all()
    assert np.isfinite(motion.fps)
    assert 0 < motion.fps <= 1e6
    assert (np.linalg.norm(motion.qpos[:, 3:7], axis=-1) > 0.05).all()
    positions, _ = motion.slice(0, 3).forward_kinematics()
    assert np.isfinite(positions).all()


def read_motion_file(path: Path) -> None:
    from egopose.motion.io import read_motion

    sane(read_motion(path))


def read_acclaim(path: Path) -> None:
    from egopose.motion.io import read_motion

    asf, _, amc = path.read_bytes().partition(CUT)
    skeleton, motion = path.with_suffix(".asf"), path.with_suffix(".amc")
    skeleton.write_bytes(asf)
    motion.write_bytes(amc)
    sane(read_motion(motion, asf=skeleton))


def read_tensors(path: Path) -> None:
    from egopose.core.safe_tensors import check_checkpoint_states, load_tensors

    meta, _, state = path.read_bytes().partition(CUT)
    component = path.parent / "checkpoint" / "components" / "0000-policy"
    (component / "state").mkdir(parents=True, exist_ok=True)
    (component / "state" / "a.memmap").write_bytes(bytes(96))
    (component / "state" / "meta.json").write_bytes(meta)
    (component / "state.json").write_bytes(state)
    tensors = load_tensors(component / "state", "state")
    assert sum(t.numel() * t.element_size() for t in tensors.values()) <= 96 * len(tensors.keys())
    check_checkpoint_states(path.parent / "checkpoint")


def read_store(path: Path) -> None:
    from egopose.data.store import TakeStore

    folder = path.parent / "store"
    (folder / "flow" / "f").mkdir(parents=True, exist_ok=True)
    card, _, done = path.read_bytes().partition(CUT)
    (folder / "store.json").write_bytes(card)
    (folder / "flow" / "f" / "done.json").write_bytes(done)
    store = TakeStore.open(folder)
    store.flow_done("f")
    assert len(store.fingerprint) >= 0
    for take in range(len(store.takes)):
        assert store.video(take).name
        assert store.frames(take).stop <= store.frames_total


def read_config(path: Path) -> None:
    from egopose.core.safe_io import read_yaml
    from egopose.data.take_sources import find_sources

    for name in ("a.bvh", "a.mp4"):
        (path.parent / name).touch()
    with contextlib.chdir(path.parent):
        settings = read_yaml(path, "settings")
        json.dumps(settings, default=str)
        if isinstance(settings, dict) and isinstance(settings.get("data"), dict):
            find_sources(settings["data"])


def read_video(path: Path) -> None:
    from egopose.vision.video import iter_frames

    for count, frame in enumerate(iter_frames(path, fps=30.0)):
        assert frame.dtype == np.uint8
        assert frame.ndim == 3
        assert count < 100_000


BVH = b"""HIERARCHY
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
CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
End Site
{
OFFSET 0 15 0
}
}
}
MOTION
Frames: 3
Frame Time: 0.0333
0 95 0 0 0 0 1 2 3 0 70 0 0 0 0
0 95 1 0 0 90 4 2 3 0 70 0 0 5 0
0 95 2 0 0 180 9 2 3 0 70 1 0 0 0
"""
ASF = b""":version 1.10
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
begin
name foot
direction 0 0 1
length 3
axis 90 0 0 ZYX
dof rx tx
end
:hierarchy
begin
root leg
leg foot
end
"""
AMC = b""":FULLY-SPECIFIED
:DEGREES
1
root 0 17 0 0 0 0
leg 1 2 3
foot 4 0
2
root 0 17 0 0 9 0
leg 1 2 3
foot 5 1
"""
FRAME = [0.033, 0, 0.9, 0, *([1.0, 0, 0, 0] * 3), *([1.0, 0, 0, 0, 0.0, 1.0, 0, 0, 0, 1.0, 0, 0, 0, 0.0] * 2)]


def bvh_seeds() -> list[bytes]:
    return [BVH, BVH.replace(b"\n", b"\r\n"), _written(".bvh")]


def deepmimic_seeds() -> list[bytes]:
    uneven = [[0.05, *FRAME[1:]], FRAME, FRAME, FRAME]
    return [json.dumps({"Loop": "wrap", "Frames": frames}).encode() for frames in ([FRAME] * 2, uneven)]


def native_seeds() -> list[bytes]:
    return [_written(".npz")]


def amass_seeds() -> list[bytes]:
    arrays = {"poses": np.full((3, 66), 0.1), "trans": np.zeros((3, 3)), "mocap_framerate": np.array(60.0)}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]  # the stub takes allow_pickle for an array
    return [stream.getvalue()]


def mvnx_seeds() -> list[bytes]:
    segments = ["Pelvis", "T8", "Head", *(f"{s}{p}" for s in ("Right", "Left") for p in ("UpperArm", "Foot", "Toe"))]
    names = "".join(
        f'<segment label="{n}"><points><point label="p{n}"><pos_b>0 0 .1</pos_b></point></points></segment>'
        for n in segments
    )
    places = " ".join(f"0 {k / 10} 1" for k in range(len(segments)))
    turns = "1 0 0 0 " * len(segments)
    frames = "".join(
        f'<frame type="{kind}"><orientation>{turns}</orientation><position>{places}</position></frame>\n'
        for kind in ("identity", "tpose", "normal", "normal")
    )
    head = '<mvnx version="4" xmlns="http://www.xsens.com/mvn/mvnx"><subject label="a" frameRate="60"><segments>'
    return [f"{head}{names}</segments>\n<frames>{frames}</frames></subject></mvnx>".encode()]


def tensor_seeds() -> list[bytes]:
    entry = {"device": "cpu", "shape": [2, 3], "dtype": "torch.float32", "is_nested": False}
    meta = {"a": entry, "shape": [], "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
    tensor = {"kind": "tensor", "key": "a", "device": "cpu"}
    value = {"kind": "value", "value": 3}
    state = {"kind": "ordered_dict", "items": [[{"kind": "value", "value": "w"}, tensor], [value, value]]}
    state["metadata"] = {"kind": "dict", "items": [[value, {"kind": "tuple", "items": [value]}]]}
    return [json.dumps(meta).encode() + CUT + json.dumps(state).encode()]


def store_seeds() -> list[bytes]:
    take = {"name": "a", "subject": "1", "offset": 0, "length": 5, "lowest_head_height": 1.2, "source": "a.bvh"}
    take |= {
        "video": "videos/a.mp4",
        "sync_offset": 0.0,
        "rendered": True,
        "supported": [[0, 5]],
        "retargeting_mm": 3.0,
    }
    card = {"schema": 1, "fps": 30.0, "fingerprint": "f", "takes": [take]}
    return [json.dumps(card).encode() + CUT + b"[0]"]


def config_seeds() -> list[bytes]:
    takes = b"data:\n  source: takes\n  takes:\n    - {motion: a.bvh, video: a.mp4, sync_offset: 0.5, subject: x}\n"
    folder = b"data:\n  source: folder\n  folder: .\n  pattern: '*.bvh'\n  subject: '(.)'\n"
    folder += b"  exclude: [b]\n  reader: {unit: cm}\n"
    return [takes, folder, b"a: ${oc.env:HOME}\nb: [1, 2.5, null, yes]\nc: {d: 'x', e: \"y\"}\n"]


def video_seeds() -> list[bytes]:
    from egopose.vision.video import write_video

    rows = np.arange(64 * 48 * 3, dtype=np.uint8).reshape(48, 64, 3)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        write_video(path, [np.roll(rows, k, axis=1) for k in range(8)], 30.0)
        return [path.read_bytes()]


def _written(suffix: str) -> bytes:
    """A few frames of the first embedded clip."""
    from egopose.assets import __file__ as assets
    from egopose.motion.io import read_motion, write_motion

    clip = read_motion(sorted((Path(assets).parent / "clips").glob("*.npz"))[0]).slice(0, 2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write_motion(clip, path)
        return path.read_bytes()


_MOTION = ("egopose.motion",)
READERS = {
    "bvh": Reader(bvh_seeds, read_motion_file, ".bvh", _MOTION),
    "acclaim": Reader(lambda: [ASF + CUT + AMC], read_acclaim, ".two", _MOTION),
    "deepmimic": Reader(deepmimic_seeds, read_motion_file, ".txt", _MOTION),
    "native": Reader(native_seeds, read_motion_file, ".npz", _MOTION, binary=True),
    "amass": Reader(amass_seeds, read_motion_file, ".npz", _MOTION, binary=True),
    "mvnx": Reader(mvnx_seeds, read_motion_file, ".mvnx", _MOTION),
    "trc": Reader(lambda: [_written(".trc")], read_motion_file, ".trc", _MOTION),
    "c3d": Reader(lambda: [_written(".c3d")], read_motion_file, ".c3d", (*_MOTION, "c3d"), binary=True),
    "tensors": Reader(tensor_seeds, read_tensors, ".two", ("egopose.core.safe_io",)),
    "store": Reader(store_seeds, read_store, ".two", ("egopose.core.safe_io", "egopose.data.store")),
    "config": Reader(config_seeds, read_config, ".yaml", ("egopose.core.safe_io", "egopose.data.take_sources")),
    "video": Reader(video_seeds, read_video, ".mp4", ("egopose.vision",), binary=True),
}


def mutate(data: bytes, seed: int, blind: Callable[[bytes], bytes], archive: bool) -> bytes:
    """One structured change (of a word, a line, an entry of an archive), or ``blind``, libFuzzer's own."""
    draw = random.Random(seed)
    if draw.random() < (0.2 if archive else 0.1):
        return blind(data)
    if archive:
        return _mutate_archive(data, draw, blind)
    return _mutate_words(data, draw)


def _mutate_words(data: bytes, draw: random.Random) -> bytes:
    for _ in range(draw.choice((1, 1, 2, 4))):
        if draw.random() < 0.6:
            spans = [m.span() for m in re.finditer(rb"[A-Za-z0-9_.+\-]+|[^\sA-Za-z0-9]", data)]
            if not spans:
                return draw.choice(HOSTILE)
            start, stop = draw.choice(spans)
            other = slice(*draw.choice(spans))
            new = draw.choice(
                (draw.choice(HOSTILE), b"", data[other], data[start:stop] * 2, b"%d" % draw.getrandbits(31))
            )
            data = data[:start] + new + data[stop:]
        else:
            separator = draw.choice((b"\n", b"\n", b"{", b",", b"}"))
            lines = data.split(separator)
            first, second = draw.randrange(len(lines)), draw.randrange(len(lines))
            kind = draw.randrange(4)
            if kind == 0:
                del lines[first]
            elif kind == 1:
                lines.insert(first, lines[second])
            elif kind == 2:
                lines[first], lines[second] = lines[second], lines[first]
            else:
                lines[first:first] = lines[first : first + 5] * draw.randrange(1, 20)
            data = separator.join(lines)
    return data


def _mutate_archive(data: bytes, draw: random.Random, blind: Callable[[bytes], bytes]) -> bytes:
    """An entry changed and the archive sealed again; bytes of anything else."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {i.filename: archive.read(i) for i in archive.infolist() if i.file_size < 2**20}
    except Exception:  # whatever the damage happens to be
        return _mutate_bytes(data, draw)
    if not entries:
        return blind(data)
    name = draw.choice(sorted(entries))
    content, kind = entries[name], draw.randrange(6)
    if kind == 0:
        entries[draw.choice((name + "x", "contacts.npy", "torques.npy", "header.npy", "poses.npy"))] = content
    elif kind == 1:
        del entries[name]
    elif kind == 2:  # the NumPy header: same length, so that it stays readable
        head = _mutate_words(content[10:128], draw)[:118].ljust(118)
        entries[name] = content[:10] + head + content[128:]
    elif kind == 3 and content[128:129] == b"{":  # the clip's JSON, with the header of an array that is as long
        text = _mutate_words(content[128:], draw)
        stream = io.BytesIO()
        np.lib.format.write_array(stream, np.frombuffer(text, np.uint8))
        entries[name] = stream.getvalue()
    elif kind == 4 and len(content) > 136:
        at = 128 + 8 * draw.randrange((len(content) - 128) // 8)
        number = np.array(draw.choice((np.nan, np.inf, 1e300, -1.0, 0.0, 1e7, 1e-310)))
        entries[name] = content[:at] + number.tobytes() + content[at + 8 :]
    else:
        entries[name] = _mutate_bytes(content, draw)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as out:
        for key, value in entries.items():
            out.writestr(key, value)
    return stream.getvalue()


def _mutate_bytes(data: bytes, draw: random.Random) -> bytes:
    """Flips, cuts, and big numbers where a length may stand."""
    changed = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8))):
        if not changed:
            break
        at = draw.randrange(len(changed))
        kind = draw.randrange(4)
        if kind == 0:
            changed[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            changed[at : at + 4] = draw.choice((b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", bytes(4), b"\0\0\xff\xff"))
        elif kind == 2:
            del changed[at : at + draw.choice((1, 4, 64, len(changed)))]
        else:
            changed[at:at] = changed[at : at + draw.choice((1, 4, 64))]
    return bytes(changed)
