"""The parts of a live stream by themselves: time, late frames, sources, messages, the file, memory."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_stand_in import write_walk

from egopose.errors import InputError
from egopose.inference.stream import messages
from egopose.inference.stream.body import LivePose
from egopose.inference.stream.broadcast import ServerSettings
from egopose.inference.stream.clock import ControlClock
from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.memory import MemoryTrace
from egopose.inference.stream.newest import Captured, NewestFrame
from egopose.inference.stream.recording import Recording
from egopose.inference.stream.sources import SourceSettings, capture, check_source
from egopose.motion.io import read_motion
from egopose.motion.io.native import skeleton_from_json
from egopose.motion.skeleton import Dof, Joint, Skeleton

STILL = np.zeros((4, 4, 3), np.uint8)
SKELETON = Skeleton((Joint("Hips", -1, (0, 0, 1)), Joint("Spine", 0, (0, 0, 0.2), (Dof("hinge", (1, 0, 0)),))))


def frame(number: int) -> Captured:
    return Captured(number / 30, 0.0, STILL)


def pose(number: int, **changed: object) -> LivePose:
    qpos = np.array([0, 0, 1, 1, 0, 0, 0, 0.01 * number])
    return LivePose(**{"frame": number, "qpos": qpos, "value": 1.5, "confidence": 0.9, "reset": False, **changed})


@given(rate=st.floats(12.0, 240.0), jitter=st.floats(0.0, 0.1), drift=st.floats(-0.01, 0.01), seed=st.integers(0, 1000))
def test_control_frames_keep_in_step_with_any_camera(rate: float, jitter: float, drift: float, seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, 300) / rate
    times = np.arange(300) / (rate * (1 + drift)) + noise
    clock = ControlClock(30.0)
    passed = np.cumsum([clock.intervals(t) for t in times]) - 1
    assert np.abs(passed - 30.0 * (times - times[0])).max() < 1.6


@given(jitter=st.floats(0.0, 0.2), drift=st.floats(-0.004, 0.004), seed=st.integers(0, 1000))
def test_a_camera_at_the_control_rate_is_used_frame_by_frame(jitter: float, drift: float, seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, 900) / 30
    clock = ControlClock(30.0)
    counts = [clock.intervals(t) for t in np.arange(900) / (30 * (1 + drift)) + noise]
    # 3.6 control frames of drift in all: no more are doubled or left out.
    assert sum(count != 1 for count in counts) <= 5


def test_the_newest_frame_waits_and_the_others_are_counted() -> None:
    newest = NewestFrame()
    for number in range(5):
        newest.put(frame(number))
    taken = newest.take(0.0)
    assert taken is not None
    assert taken.time == frame(4).time
    assert newest.dropped == 4
    assert newest.take(0.0) is None
    newest.put(frame(5))
    newest.close()
    assert not newest.ended
    assert newest.take(0.0) is not None
    assert newest.ended
    failed = NewestFrame()
    failed.close(InputError("x", "y", "z"))
    with pytest.raises(InputError, match="z"):
        failed.take(0.0)


def test_a_patient_source_loses_nothing() -> None:
    newest, seen = NewestFrame(), []

    def hand_over() -> None:
        for number in range(50):
            newest.put_patiently(frame(number))
        newest.close()

    threading.Thread(target=hand_over, daemon=True).start()
    while not newest.ended:
        if (taken := newest.take(1.0)) is not None:
            seen.append(round(30 * taken.time))
    assert seen == list(range(50))
    assert newest.dropped == 0


def test_latencies_are_the_percentiles_of_the_last_frames() -> None:
    table = LatencyTable(("a", "b"), 8)
    assert table.percentiles_ms() == {}
    for _ in range(20):
        arrived = time.perf_counter()
        table.begin()
        time.sleep(0.002)
        table.lap("a")
        table.lap("b")
        table.lap("a")
        table.end(arrived)
    found = table.percentiles_ms()
    assert list(found) == ["a", "b", "compute", "delay"]
    assert found["a"]["p50_ms"] >= 2.0
    assert found["a"]["p50_ms"] <= found["a"]["p95_ms"] <= found["a"]["p99_ms"]
    assert found["compute"]["p50_ms"] >= found["a"]["p50_ms"]
    assert table.frames == 20
    assert table.percentiles_ms(1)["delay"]["p50_ms"] == table.percentiles_ms(1)["delay"]["p99_ms"]
    assert table._rows.shape == (8, 4)


def test_memory_is_traced_in_bounded_memory() -> None:
    trace = MemoryTrace()
    assert trace.report()["rss_mb"] is None
    for second in range(4000):
        trace.sample(float(second))
    assert len(trace._samples) <= 512
    assert trace._samples[0][0] < 100
    assert trace._samples[-1][0] > 3900
    report = trace.report()
    assert report["rss_mb"] is None or report["rss_mb"] > 10


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"source": "file:///etc/passwd"}, "addresses begin with"),
        ({"source": "concat://a"}, "addresses begin with"),
        ({"pace": "quick"}, "real_time or every"),
    ],
)
def test_wrong_sources_are_named(changed: dict[str, str], match: str) -> None:
    with pytest.raises(InputError, match=match):
        SourceSettings(**{"source": "0", "pace": "every", "repeat": False, "offset": 0.0, **changed})


@pytest.mark.parametrize("source", ["97", "http://127.0.0.1:9/none.mp4"])
def test_what_cannot_be_opened_ends_in_one_error(source: str, capfd: pytest.CaptureFixture[str]) -> None:
    newest = NewestFrame()
    capture(SourceSettings(source, "real_time", False, 0.0), 30.0, newest, threading.Event())
    with pytest.raises(InputError, match=f"{source}: (camera|address): cannot be opened"):
        newest.take(0.0)


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.mp4").write_bytes(b"\0" * 100)
    for name, match in (("none.mp4", "no such file"), ("x.mp4", "not an MP4")):
        with pytest.raises(InputError, match=match):
            check_source(SourceSettings(str(tmp_path / name), "every", False, 0.0))


@pytest.fixture
def site(tmp_path: Path) -> Iterator[str]:
    """An address at which the files of ``tmp_path / "site"`` lie."""
    (tmp_path / "site").mkdir()

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "site")))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


def test_a_play_list_leads_to_no_file(site: str, tmp_path: Path) -> None:
    secret = write_walk(tmp_path / "secret.mp4", 12)
    lines = ["#EXTM3U", "#EXT-X-TARGETDURATION:1", "#EXTINF:1,", f"file://{secret}", "#EXT-X-ENDLIST"]
    (tmp_path / "site" / "list.m3u8").write_text("\n".join(lines))
    concat = f"ffconcat version 1.0\nfile 'file://{secret}'\n"
    (tmp_path / "site" / "list.ffconcat").write_text(concat)
    for name in ("list.m3u8", "list.ffconcat"):
        newest = NewestFrame()
        capture(SourceSettings(f"{site}/{name}", "real_time", False, 0.0), 30.0, newest, threading.Event())
        with pytest.raises(InputError, match=r"cannot be opened|gives no picture"):
            newest.take(0.0)


def test_an_address_is_read_as_a_camera(site: str, tmp_path: Path) -> None:
    write_walk(tmp_path / "site" / "walk.mp4", 12)
    newest = NewestFrame()
    capture(SourceSettings(f"{site}/walk.mp4", "real_time", False, 0.0), 30.0, newest, threading.Event())
    last = newest.take(0.0)
    assert last is not None
    assert last.image.shape == (120, 128, 3)
    assert newest.dropped == 11
    assert newest.ended


def test_a_file_comes_at_a_cameras_pace(tmp_path: Path) -> None:
    settings = SourceSettings(str(write_walk(tmp_path / "walk.mp4", 10)), "real_time", True, 0.0)
    newest, stop = NewestFrame(), threading.Event()
    threading.Thread(target=capture, args=(settings, 30.0, newest, stop), daemon=True).start()
    arrived = []
    while len(arrived) < 30:
        taken = newest.take(1.0)
        assert taken is not None
        arrived.append((taken.time, taken.arrived))
    stop.set()
    times, clock = np.array(arrived).T
    assert clock[-1] - clock[0] >= times[-1] - times[0] - 0.02


def test_frames_in_bytes_and_text_say_the_same() -> None:
    sent = pose(7, reset=True)
    back = messages.read_frame_binary(messages.frame_binary(sent, 30.0, 4.25))
    assert (back["frame"], back["reset"], back["value"], back["delay_ms"]) == (7, True, 1.5, 4.25)
    assert back["time"] == pytest.approx(7 / 30)
    np.testing.assert_array_equal(back["qpos"], sent.qpos.astype(np.float32))
    first = messages.read_frame_binary(messages.frame_binary(pose(0, value=None, confidence=None), 30.0, 0.0))
    assert np.isnan(first["value"])
    assert np.isnan(first["confidence"])
    for broken in (b"", b"EGOP", messages.frame_binary(sent, 30.0, 0.0)[:-1]):
        with pytest.raises(InputError):
            messages.read_frame_binary(broken)


def test_the_greeting_brings_the_skeleton() -> None:
    import json

    greeting = json.loads(messages.hello(SKELETON, 30.0, 10, "0"))
    assert skeleton_from_json(greeting["skeleton"]) == SKELETON
    assert (greeting["type"], greeting["version"], greeting["lookahead"]) == ("hello", 1, 10)


def test_the_file_holds_every_control_frame(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "sub" / "live.npz", SKELETON, 30.0)
    for number in (0, 1, 2, 6):
        recording.pose(pose(number))
    assert not recording.path.exists()
    recording.close()
    motion = read_motion(recording.path)
    np.testing.assert_allclose(motion.qpos[:, 7], [0, 0.01, 0.02, 0.02, 0.02, 0.02, 0.06])
    assert [path.name for path in recording.path.parent.iterdir()] == ["live.npz"]
    empty = Recording(tmp_path / "none.npz", SKELETON, 30.0)
    empty.close()
    assert not list(tmp_path.glob("*none*"))
    with pytest.raises(InputError, match=r"\.npz"):
        Recording(tmp_path / "live.bvh", SKELETON, 30.0)


def test_only_this_machine_hears_without_a_token() -> None:
    good = {"port": 8765, "token": None, "clients": 8, "queue": 30}
    for host in ("127.0.0.1", "::1", "localhost"):
        ServerSettings(host=host, **good)
    for host in ("0.0.0.0", "192.168.1.5", "example.org", "::"):
        with pytest.raises(InputError, match="EGOPOSE_STREAM_TOKEN"):
            ServerSettings(host=host, **good)
    ServerSettings(host="0.0.0.0", **{**good, "token": "0123456789abcdef"})
    with pytest.raises(InputError, match="16 characters"):
        ServerSettings(host="0.0.0.0", **{**good, "token": "short"})
    with pytest.raises(InputError, match="at least 1"):
        ServerSettings(host="127.0.0.1", **{**good, "queue": 0})
