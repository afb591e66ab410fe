"""Hostile files in a process of their own: each is refused or read within seconds and far below 2 GB."""

from __future__ import annotations

import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import run_child

from egopose.vision.video import write_video

#: By default files are a fifth of the largest that are read; ``make test-slow`` takes them whole.
FULL_SIZE = [pytest.param(5, id="fifth"), pytest.param(1, id="whole", marks=pytest.mark.slow)]


def fill(path: Path, start: bytes, middle: bytes, end: bytes, size: int) -> None:
    count = (size - len(start) - len(end)) // len(middle)
    path.write_bytes(start + middle * count + end)


HEAD = b"HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"


def endless_bvh(path: Path, part: int) -> None:
    fill(path, b"HIERARCHY\nROOT a\n{\n", b"\n", b"MOTION\n", 64 * 2**20 // part)


def wide_letters(path: Path, part: int) -> None:
    """One letter that makes Python take four bytes for every other."""
    fill(path, "HIERARCHY\nROOT \U0001f600\n".encode(), b" 0 \r\n", b"", 128 * 2**20 // part)


def tips(path: Path, part: int) -> None:
    fill(path, HEAD, b"End Site\n{\nOFFSET 0 1 0\n}\n", b"}\nMOTION\nFrames: 1\nFrame Time: 1\n0 0 0\n", 3 * 2**20)


def many_joints_few_channels(path: Path, part: int) -> None:
    """Each frame is six bytes in the file and 2048 translations in memory."""
    joints = b"".join(b"JOINT j%d\n{\nOFFSET 0 1 0\n" % k for k in range(2000)) + b"}\n" * 2001
    frames = 2_000_000
    path.write_bytes(HEAD + joints + b"MOTION\nFrames: %d\nFrame Time: 0.01\n" % frames + b"0 0 0\n" * frames)


def one_line(path: Path, part: int) -> None:
    fill(path, b"HIERARCHY ", b"{", b"\nMOTION\n", 128 * 2**20 // part)


def empty_lists(path: Path, part: int) -> None:
    fill(path, b'{"Frames": [', b"[],", b"[]]}", 32 * 2**20 // part)


def too_much_json(path: Path, part: int) -> None:
    fill(path, b'{"Frames": [', b"[],", b"[]]}", 40 * 2**20)


def bomb(path: Path, part: int) -> None:
    """600 MB of zeros in 600 kB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out, out.open("poses.npy", "w", force_zip64=True) as entry:
        np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": (75 * 2**20,)})  # type: ignore[arg-type]
        for _ in range(75):
            entry.write(bytes(8 * 2**20))


def small_numbers(path: Path, part: int) -> None:
    """Half-precision zeros, four times as large as doubles, within what may be unpacked."""
    frames = (2**27 - 2**12) // 66
    np.savez_compressed(path, poses=np.zeros((frames, 66), np.float16), trans=np.zeros((1, 3)))


def announced(path: Path, part: int) -> None:
    np.savez(path, poses=np.zeros((1, 66)), trans=np.zeros((1, 3)))
    path.write_bytes(path.read_bytes().replace(b"(1, 66)", b"(9**9,)"))


def directory(path: Path, part: int) -> None:
    """Two million entries listed, none there."""
    entry = b"PK\x01\x02" + bytes(24) + b"\x01\0" + bytes(16) + b"a"
    count = 2_000_000
    end = b"PK\x05\x06" + bytes(4) + b"\xff\xff\xff\xff" + (len(entry) * count).to_bytes(4, "little") + bytes(6)
    path.write_bytes(entry * count + end)


def lzma(path: Path, part: int) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as out:
        out.writestr("poses.npy", bytes(1000))


def long_header(path: Path, part: int) -> None:
    np.savez_compressed(path, header=np.frombuffer(b"[" + b"[]," * (4 * 2**20) + b"[]]", np.uint8))


MOTION: dict[str, tuple[Callable[[Path, int], None], str]] = {
    "endless.bvh": (endless_bvh, "lines; at most"),
    "wide.bvh": (wide_letters, "lines; at most"),
    "tips.bvh": (tips, "End Sites"),
    "joints.bvh": (many_joints_few_channels, "cut the motion into parts"),
    "line.bvh": (one_line, "more than any hierarchy takes"),
    "lists.txt": (empty_lists, "a frame is 44 numbers"),
    "big.txt": (too_much_json, "bytes; at most"),
    "bomb.npz": (bomb, "bytes announced"),
    "halves.npz": (small_numbers, "more than"),
    "announced.npz": (announced, "poses"),
    "directory.npz": (directory, "the list of entries takes more"),
    "lzma.npz": (lzma, "compression 14"),
    "header.npz": (long_header, "bytes; at most"),
}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are set as Linux has them")
@pytest.mark.parametrize("part", FULL_SIZE)
def test_motion_files(part: int, tmp_path: Path) -> None:
    for name, (make, _) in MOTION.items():
        make(tmp_path / name, part)
    said = run_child("motion", [tmp_path / name for name in MOTION])
    wrong = {name: text for name, text in said.items() if MOTION[name][1] not in text or "refused" not in text}
    assert not wrong


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are set as Linux has them")
@pytest.mark.parametrize("part", FULL_SIZE)
def test_json_of_a_checkpoint_or_store(part: int, tmp_path: Path) -> None:
    fill(tmp_path / "lists.json", b"[", b"[],", b"[]]", 16 * 2**20 // part)
    fill(tmp_path / "big.json", b"[", b"[],", b"[]]", 17 * 2**20)
    (tmp_path / "deep.json").write_bytes(b"[" * 10**6)
    said = run_child("json", [tmp_path / f"{name}.json" for name in ("lists", "big", "deep")])
    assert said["lists.json"] == "read"
    assert "at most" in said["big.json"]
    assert "nested too deeply" in said["deep.json"]


def video_corpus(folder: Path) -> dict[str, str]:
    """Files made from one good video: name to what is expected of them, ``""`` for either."""
    good = folder / "good.mp4"
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    write_video(good, [np.roll(picture, k, 0) for k in range(10)], 30.0)
    raw = good.read_bytes()
    made = {
        "empty": (b"", "refused"),
        "playlist": (b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "not an MP4"),
        "concat": (b"ffconcat version 1.0\nfile /etc/passwd\n", "not an MP4"),
        "only a name": (raw[:28], "refused"),
        "half": (raw[: len(raw) // 2], "refused"),
        "no index": (raw[: raw.index(b"moov") - 4], "refused"),
        "no pictures": (raw[:32] + raw[raw.index(b"moov") - 4 :], "refused"),
        "huge": (resized(raw, 65535, 65535), ""),
        "huge box": (b"\0\0\0\x01ftyp" + b"\xff" * 8 + raw[16:], ""),
    }
    at = raw.index(b"stts") + 8
    # One sample, lasting 2^31 ticks: the rest of the film would be filled with one frame.
    made["pause"] = (raw[:at] + b"\0\0\0\x01\0\0\0\x0a\x7f\xff\xff\xff" + raw[at + 12 :], "")
    for name in (b"stsz", b"stco", b"stsc", b"stts"):
        at = raw.index(name) + 8
        made[f"counts of {name.decode()}"] = (raw[:at] + b"\x7f\xff\xff\xff" + raw[at + 4 :], "")
    random = np.random.default_rng(1)
    for k in range(40):
        flipped = bytearray(raw)
        for place in random.integers(0, len(raw), 1 + k):
            flipped[place] ^= 1 << int(random.integers(8))
        made[f"flips {k}"] = (bytes(flipped), "")
    for name, (content, _) in made.items():
        (folder / f"{name}.mp4").write_bytes(content)
    return {f"{name}.mp4": expected for name, (_, expected) in made.items()}


def resized(raw: bytes, width: int, height: int) -> bytes:
    at = raw.index(b"mp4v", raw.index(b"stsd")) + 28
    return raw[:at] + width.to_bytes(2, "big") + height.to_bytes(2, "big") + raw[at + 4 :]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are set as Linux has them")
def test_videos(tmp_path: Path) -> None:
    expected = video_corpus(tmp_path)
    said = run_child("video", [tmp_path / name for name in expected])
    assert all(text == "read" or text.startswith("refused") for text in said.values())
    wrong = {name: said[name] for name, want in expected.items() if want not in said[name]}
    assert not wrong
