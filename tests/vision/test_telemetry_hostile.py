"""Damaged, cut and hostile telemetry: it is read, or refused in one line that names the file."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import run_child
from helpers.telemetry_film import any_telemetry, film, telemetry_folder
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision.telemetry import read_telemetry
from egopose.vision.telemetry.klv import container, number_entry, text_entry


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("film"), any_telemetry(5, 100, 30.0), 100)


def reads_or_says_why(path: Path) -> None:
    try:
        read_telemetry(path)
    except InputError as error:
        said = str(error)
    else:
        said = f"{path}: "
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    assert len(said) < len(str(path)) + 300


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damage_anywhere_behind_the_pictures(good: Path, data: st.DataObject) -> None:
    raw = bytearray(good.read_bytes())
    begin = raw.index(b"DEVC") - 8
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(begin, len(raw) - 5))
        raw[at : at + 4] = data.draw(
            st.sampled_from([b"\0\0\0\0", b"\xff\xff\xff\xff", b"\0\0\0\1", b"\x7f\xff\xff\xff"])
        )
    path = good.with_name("damaged.mp4")
    path.write_bytes(raw)
    reads_or_says_why(path)


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0, 1), behind=st.booleans())
def test_cuts_anywhere(good: Path, share: float, behind: bool) -> None:
    raw = good.read_bytes()
    begin = raw.index(b"DEVC") - 8
    path = good.with_name("cut.mp4")
    path.write_bytes(raw[: int(begin + share * (len(raw) - begin))] if behind else raw[: int(share * len(raw))])
    reads_or_says_why(path)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damaged_streams_of_real_cameras(
    shared: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = telemetry_folder(shared)
    name = data.draw(st.sampled_from(["hero5.raw", "hero6+ble.raw", "hero11.raw", "consecutive2.raw", "mp4header.raw"]))
    raw = bytearray((folder / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(4, min(len(raw), 8000) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del raw[data.draw(st.integers(8, len(raw))) :]
    path = tmp_path_factory.getbasetemp() / "damaged.raw"
    path.write_bytes(raw)
    reads_or_says_why(path)


def gyroscope(*about: bytes, values: np.ndarray | None = None) -> bytes:
    stored = np.ones((10, 3)) if values is None else values
    return container(
        "DEVC", number_entry("DVID", "L", np.ones((1, 1))), container("STRM", *about, number_entry("GYRO", "s", stored))
    )


@pytest.mark.parametrize(
    ("raw", "cause"),
    [
        (
            gyroscope(number_entry("SCAL", "s", np.zeros((1, 1)))),
            "payload 1: GYRO: SCAL has 1 numbers for 3, or a zero",
        ),
        (gyroscope(number_entry("SCAL", "s", np.ones((2, 1)))), "SCAL has 2 numbers for 3"),
        (gyroscope(text_entry("ORIN", "ABC")), "ORIN: 'ABC'"),
        (gyroscope(values=np.ones((10, 2))), "GYRO: 2 numbers a sample; expected 3"),
        (gyroscope()[:-6], "telemetry payload 1: is damaged or cut short"),
        (container("DEVC", b"STRM\0\1\xff\xff"), "is damaged or cut short: STRM has 0 of 65535 bytes"),
    ],
)
def test_what_cannot_be_is_named(tmp_path: Path, raw: bytes, cause: str) -> None:
    path = tmp_path / "a.raw"
    path.write_bytes(raw)
    with pytest.raises(InputError) as caught:
        read_telemetry(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert cause in str(caught.value)


def test_numbers_that_are_none_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.raw"
    values = np.ones((10, 3))
    values[4, 1] = np.nan
    path.write_bytes(container("DEVC", container("STRM", number_entry("GYRO", "f", values))))
    found = read_telemetry(path)
    assert found is not None
    assert found.gyroscope is not None
    assert len(found.gyroscope.times) == 9


def table_at(raw: bytes, name: bytes) -> int:
    """Where the telemetry track's table of this name holds its numbers."""
    return raw.index(name, raw.index(b"gpmd", raw.index(b"GoPro MET"))) + 8


def test_tables_that_announce_too_much_cost_little(good: Path, tmp_path: Path) -> None:
    raw = good.read_bytes()
    deep = gyroscope()
    for _ in range(40):
        deep = container("DEVC", deep)
    many = b"".join(b"ABCDb\1\0\0" for _ in range(8000)) * 20
    cases = {
        "payloads.mp4": patched(raw, table_at(raw, b"stsz") + 4, struct.pack(">I", 0xFFFFFFFF)),
        "same_size.mp4": patched(raw, table_at(raw, b"stsz"), struct.pack(">II", 0x7FFFFFFF, 80_000)),
        "durations.mp4": patched(raw, table_at(raw, b"stts") + 4, struct.pack(">I", 0xFFFFFFFF)),
        "chunk.mp4": patched(raw, table_at(raw, b"stsc") + 8, struct.pack(">I", 0xFFFFFFFF)),
        "offset.mp4": patched(raw, table_at(raw, b"co64") + 4, b"\x7f" + b"\xff" * 7),
        "rows.mp4": patched(raw, table_at(raw, b"co64"), struct.pack(">I", 0xFFFFFFF0)),
        "deep.raw": deep,
        "many.raw": b"DEVC\0\4" + struct.pack(">H", 60_000) + many[:240_000] + b"DEVC\0\1\0\0" * 100_000,
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    said = run_child("telemetry", [tmp_path / name for name in cases])
    assert all(word.startswith("refused") for word in said.values()), said


def patched(raw: bytes, at: int, new: bytes) -> bytes:
    return raw[:at] + new + raw[at + len(new) :]
