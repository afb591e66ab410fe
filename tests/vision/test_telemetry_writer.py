"""Telemetry written into an MP4: read back by ourselves, by telemetry-parser and by PyAV."""

from __future__ import annotations

import ast
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.telemetry_film import any_telemetry, film, plain_video
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision.telemetry import Samples, Telemetry, read_telemetry, write_gpmf_mp4
from egopose.vision.video import read_frames

#: Half a step of 16 bits, per stream; a large value makes the steps wider.
STEPS = {"gyroscope": 1 / 1878, "accelerometer": 1 / 418, "gravity": 1 / 32767, "image_orientation": 1 / 32767}
STREAMS = ("gyroscope", "accelerometer", "gravity", "camera_orientation", "image_orientation")


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate=st.sampled_from([100.0, 199.25, 400.0]),
    fps=st.sampled_from([23.976, 25.0, 29.97, 60.0]),
    begin=st.floats(-0.5, 0.5),
)
def test_what_is_written_is_read(seed: int, rate: float, fps: float, begin: float) -> None:
    frames = int(3.3 * fps)
    given_telemetry = any_telemetry(seed, frames, fps, rate, begin)
    with tempfile.TemporaryDirectory() as folder:
        read = read_telemetry(film(Path(folder), given_telemetry, frames, fps))
    assert read is not None
    for name in STREAMS:
        wanted, got = getattr(given_telemetry, name), getattr(read, name)
        np.testing.assert_allclose(got.times, wanted.times, atol=3e-6)
        if name.endswith("orientation"):  # q and -q are one turn
            np.testing.assert_allclose(np.abs((got.values * wanted.values).sum(1)), 1.0, atol=1e-8)
        else:
            step = max(STEPS[name], np.abs(wanted.values).max() / 32000)
            np.testing.assert_allclose(got.values, wanted.values, atol=step)
    for name in ("model", "lens", "stabilised"):
        assert getattr(read, name) == getattr(given_telemetry, name)
    assert read.field_of_view == pytest.approx(given_telemetry.field_of_view, rel=1e-5)
    assert read.readout == pytest.approx(given_telemetry.readout, rel=1e-5)


def test_an_outside_reader_finds_the_same(tmp_path: Path) -> None:
    outside = pytest.importorskip("telemetry_parser")
    written = any_telemetry(3, 70, 30.0, begin=0.0)
    parser = outside.Parser(str(film(tmp_path, written)))
    assert (parser.camera, parser.model) == ("GoPro", "HERO11 Black")
    measured = parser.normalized_imu()
    assert written.gyroscope is not None
    assert written.accelerometer is not None
    np.testing.assert_allclose([m["timestamp_ms"] / 1000 for m in measured], written.gyroscope.times, atol=1e-5)
    # It gives the numbers in the file's order, Z X Y, and in degrees.
    for key, samples, scale in (("gyro", written.gyroscope, np.rad2deg(1)), ("accl", written.accelerometer, 1.0)):
        right, down, ahead = samples.values.T
        expected = scale * np.stack([-down, -right, -ahead], axis=1)
        np.testing.assert_allclose([m[key] for m in measured], expected, atol=0.05)
    groups = parser.telemetry(human_readable=False)
    raw = [row for group in groups[1:] for row in _rows(group["GravityVector"]["Data"])]
    assert written.gravity is not None
    np.testing.assert_allclose(np.array(raw) / 32767, written.gravity.values, atol=1 / 32767)
    raw = [row for group in groups[1:] for row in _rows(group["ImageOrientation"]["Data"])]
    assert written.image_orientation is not None
    conjugated = written.image_orientation.values * [1, -1, -1, -1]
    np.testing.assert_allclose(np.array(raw) / 32767, conjugated, atol=1 / 32767)
    assert float(groups[0]["Default"]["0x53524f54"]) == pytest.approx(1000 * (written.readout or 0), rel=1e-5)


def _rows(data: str | list) -> list[list[float]]:
    return [list(row.values()) for row in (ast.literal_eval(data) if isinstance(data, str) else data)]


def test_the_video_is_as_before(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = film(tmp_path, any_telemetry(1, 70, 30.0))
    before, after = (list(read_frames(p)) for p in (tmp_path / "plain.mp4", path))
    np.testing.assert_array_equal([t for t, _ in before], [t for t, _ in after])
    np.testing.assert_array_equal([f for _, f in before], [f for _, f in after])
    with av.open(str(path)) as container:
        assert [stream.type for stream in container.streams] == ["video", "data"]
        track = container.streams[1]
        assert track.metadata["handler_name"].endswith("GoPro MET")
        payloads = [p for p in container.demux(track) if p.size]
    assert [float(p.pts * p.time_base) for p in payloads] == [0.0, 1.0, 2.0]
    assert all(bytes(p)[:4] == b"DEVC" for p in payloads)


def test_a_film_may_take_its_own_place(tmp_path: Path) -> None:
    path = plain_video(tmp_path / "own.mp4")
    write_gpmf_mp4(path, path, any_telemetry(1, 70, 30.0), 30.0)
    assert read_telemetry(path) is not None
    assert [p.name for p in tmp_path.iterdir()] == ["own.mp4"]


def test_an_index_at_the_front_stays_right(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    plain, front = plain_video(tmp_path / "plain.mp4"), tmp_path / "front.mp4"
    with av.open(str(plain)) as source, av.open(str(front), "w", options={"movflags": "faststart"}) as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    raw = front.read_bytes()
    assert raw.index(b"moov") < raw.index(b"mdat")
    write_gpmf_mp4(front, tmp_path / "out.mp4", any_telemetry(1, 70, 30.0), 30.0)
    assert read_telemetry(tmp_path / "out.mp4") is not None
    assert len(list(read_frames(tmp_path / "out.mp4"))) == 70


UNEVEN = Samples(np.array([0.0, 0.1, 0.3]), np.zeros((3, 3)))
EARLY = Samples(np.array([-2.0, -1.0]), np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("telemetry", "cause"),
    [
        (Telemetry(gyroscope=UNEVEN), "GYRO: samples are not evenly spaced"),
        (Telemetry(accelerometer=EARLY), "ACCL: begins 2.000 s before the video"),
        (Telemetry(gravity=Samples(np.zeros(1), np.full((1, 3), np.nan))), "GRAV: a sample is not finite"),
    ],
)
def test_samples_that_cannot_be_written_are_refused(tmp_path: Path, telemetry: Telemetry, cause: str) -> None:
    path = plain_video(tmp_path / "plain.mp4")
    with pytest.raises(InputError, match=cause):
        write_gpmf_mp4(path, tmp_path / "out.mp4", telemetry, 30.0)
    assert not (tmp_path / "out.mp4").exists()


def test_a_second_track_is_refused(tmp_path: Path) -> None:
    path = film(tmp_path, any_telemetry(1, 70, 30.0))
    with pytest.raises(InputError, match="telemetry track: is there already"):
        write_gpmf_mp4(path, tmp_path / "out.mp4", any_telemetry(1, 70, 30.0), 30.0)


def test_a_cut_video_is_refused(tmp_path: Path) -> None:
    path = plain_video(tmp_path / "plain.mp4")
    raw = path.read_bytes()
    path.write_bytes(raw[:-40])
    with pytest.raises(InputError, match="cut short"):
        write_gpmf_mp4(path, tmp_path / "out.mp4", any_telemetry(1, 70, 30.0), 30.0)


def test_fields_left_out_are_not_there(tmp_path: Path) -> None:
    empty = read_telemetry(film(tmp_path, Telemetry()))
    assert empty is not None
    assert replace(empty, model="") == Telemetry()
