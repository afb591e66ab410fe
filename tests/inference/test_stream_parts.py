"""The parts of a live stream by themselves: time, late frames, sources, messages, the file, memory."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.live_stand_in import write_walk
from helpers.waiting import PATIENCE, wait_until
from hypothesis import given
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.inference.stream import frame_sources as sources
from egopose.inference.stream import messages
from egopose.inference.stream.broadcast import ServerSettings
from egopose.inference.stream.clock import ControlClock
from egopose.inference.stream.frame_features import FrameFeatures
from egopose.inference.stream.frame_sources import (
    PictureTimes,
    ReconnectSettings,
    SourceSettings,
    capture,
    check_source,
)
from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.live_body import LivePose
from egopose.inference.stream.memory import MemoryTrace
from egopose.inference.stream.newest_frame import Captured, NewestFrame
from egopose.inference.stream.recording import Recording
from egopose.motion.io import read_motion
from egopose.motion.io.native import skeleton_from_json
from egopose.motion.skeleton import Dof, Joint, Skeleton
from egopose.vision.features import extract_flow
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera
from egopose.vision.video import write_video

STILL = np.zeros((4, 4, 3), np.uint8)
SKELETON = Skeleton((Joint("Hips", -1, (0, 0, 1)), Joint("Spine", 0, (0, 0, 0.2), (Dof("hinge", (1, 0, 0)),))))


AT_ONCE = ReconnectSettings(0.05, 0.1, 0.0)


def source_of(source: object, pace: str = "real_time", **changed: object) -> SourceSettings:
    given = {"repeat": False, "offset": 0.0, "reconnect": AT_ONCE, **changed}
    return SourceSettings(str(source), pace, **given)


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
        source_of(**{"source": "0", **changed})


@pytest.mark.parametrize(
    ("source", "advice"),
    [
        ("97", "this machine has (no camera at all|[0-9, ]+); .*file|this machine has .*choose one"),
        ("http://127.0.0.1:9/none.mp4", "is 127.0.0.1:9 up and sending"),
        ("http://me:secret@127.0.0.1:9/none.mp4?key=1", "is 127.0.0.1:9 up and sending"),
    ],
)
def test_what_cannot_be_opened_ends_in_one_error(source: str, advice: str, capfd: pytest.CaptureFixture[str]) -> None:
    newest = NewestFrame()
    capture(source_of(source), newest, threading.Event())
    with pytest.raises(InputError, match=f"(camera|address): cannot be opened.*({advice})") as told:
        newest.take(0.0)
    assert "secret" not in str(told.value)
    assert "key=1" not in str(told.value)


def test_a_camera_that_is_not_there_is_named_before_anything_is_loaded() -> None:
    if not Path("/proc").is_dir():
        pytest.skip("only Linux lists its cameras")
    with pytest.raises(InputError, match="97: camera: is not there: this machine has"):
        check_source(source_of(97))


def test_a_file_that_is_no_video_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.mp4").write_bytes(b"\0" * 100)
    for name, match in (("none.mp4", "no such file"), ("x.mp4", "not an MP4")):
        with pytest.raises(InputError, match=match):
            check_source(source_of(tmp_path / name, "every"))


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
        capture(source_of(f"{site}/{name}"), newest, threading.Event())
        with pytest.raises(InputError, match=r"cannot be opened|gives no picture"):
            newest.take(0.0)


def test_an_address_is_read_as_a_camera(site: str, tmp_path: Path) -> None:
    write_walk(tmp_path / "site" / "walk.mp4", 12)
    newest = NewestFrame()
    capture(source_of(f"{site}/walk.mp4"), newest, threading.Event())
    last = newest.take(0.0)
    assert last is not None
    assert last.image.shape == (120, 128, 3)
    assert newest.dropped == 11
    assert newest.ended


def test_a_file_comes_at_a_cameras_pace(tmp_path: Path) -> None:
    settings = source_of(write_walk(tmp_path / "walk.mp4", 10), repeat=True)
    newest, stop = NewestFrame(), threading.Event()
    threading.Thread(target=capture, args=(settings, newest, stop), daemon=True).start()
    arrived = []
    while len(arrived) < 30:
        taken = newest.take(1.0)
        assert taken is not None
        arrived.append((taken.time, taken.arrived))
    stop.set()
    times, clock = np.array(arrived).T
    assert clock[-1] - clock[0] >= times[-1] - times[0] - 0.02
    # Each time round goes on where the one before ended.
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=2e-3)


def pictures(settings: SourceSettings) -> list[Captured]:
    newest, taken = NewestFrame(), []
    threading.Thread(target=capture, args=(settings, newest, threading.Event()), daemon=True).start()
    while not newest.ended:
        if (picture := newest.take(1.0)) is not None:
            taken.append(picture)
    return taken


@pytest.mark.parametrize("fps", [24.0, 25.0, 30000 / 1001, 30.0, 50.0, 60.0, 120.0])
def test_flow_is_that_of_a_control_frame_at_any_rate(tmp_path: Path, fps: float) -> None:
    """A texture that moves by 90 pixels a second, whatever the rate at which it is filmed."""
    texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (16, 60, 3)).astype(np.uint8), (600, 160))
    shifts = np.float32([[1, 0, 0], [0, 1, 0]])
    images = []
    for number in range(round(1.5 * fps)):
        shifts[0, 2] = -90 * number / fps
        images.append(cv2.warpAffine(texture, shifts, (160, 160)))
    write_video(tmp_path / "x.mp4", images, fps)
    flow = FlowConfig("medium", 128, 64)
    sight, clock = FrameFeatures(None, flow, Camera(), 30.0), ControlClock(30.0)
    moved, steps = [], 0
    for picture in pictures(source_of(tmp_path / "x.mp4", "every")):
        if count := clock.intervals(picture.time):
            found = sight.flow(picture.image, picture.time)
            steps += count
            moved += [-found[0, 8:-8, 8:-8].mean()] * count
    # 3 of 160 pixels a control frame.
    np.testing.assert_allclose(np.median(moved[1:]), 3 / 160, rtol=0.04)
    assert np.std(moved[1:]) < 0.1 * 3 / 160
    assert abs(steps - 45) <= 1
    # All of the way is there once, neither doubled nor left out.
    assert sum(moved) == pytest.approx(90 * 1.5 / 160, rel=0.07)


def test_a_known_rate_steadies_times_of_arrival() -> None:
    arrived = np.arange(300) / 29.97 + np.random.default_rng(0).uniform(-0.008, 0.008, 300)
    times = PictureTimes(30.0)
    stamps = np.array([times.stamp(t) for t in arrived])
    periods = np.diff(stamps) * 30
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-6)
    assert np.abs(stamps - arrived).max() < 1.5 / 30
    plain = PictureTimes(None)
    assert [plain.stamp(t) for t in arrived] == arrived.tolist()


def test_a_stated_rate_wins_over_the_stamps(tmp_path: Path) -> None:
    """Slow motion: filmed at 120, stamped as 30."""
    video = write_walk(tmp_path / "walk.mp4", 24)
    times = [picture.time for picture in pictures(source_of(video, "every", fps=120.0))]
    np.testing.assert_allclose(np.diff(times), 1 / 120)
    late = pictures(source_of(video, "every", offset=0.5))
    assert len(late) == 9
    assert late[0].time == 0.0
    with pytest.raises(InputError, match="behind the video's end"):
        pictures(source_of(video, "every", offset=5.0))


def test_the_cameras_lens_and_shutter_are_undone_as_offline(tmp_path: Path) -> None:
    video = write_walk(tmp_path / "walk.mp4", 12)
    camera, flow = Camera(field_of_view=110.0, lens="fisheye", readout=0.02), FlowConfig("medium", 128, 64)
    offline = extract_flow(video, flow, 30.0, 0.5 * camera.readout, camera=camera)
    sight = FrameFeatures(None, flow, camera, 30.0)
    live = [sight.flow(picture.image, picture.time) for picture in pictures(source_of(video, "every"))]
    np.testing.assert_allclose(live, offline, atol=1e-3)
    plain = extract_flow(video, flow)
    assert np.abs(plain - offline).max() > 5e-3


class Unsteady:
    """A camera that gives ``pictures`` pictures at each opening; the third opening fails."""

    opened = 0

    def __init__(self, pictures: int) -> None:
        Unsteady.opened += 1
        self.left = 0 if Unsteady.opened == 3 else pictures

    def isOpened(self) -> bool:  # OpenCV's name
        return self.left > 0

    def get(self, key: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, object]:
        self.left -= 1
        time.sleep(0.002)
        return self.left >= 0, STILL

    def release(self) -> None:
        pass


def test_a_source_that_breaks_off_is_opened_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    Unsteady.opened = 0
    monkeypatch.setattr(sources, "_open_address", lambda address: Unsteady(5))
    newest, stop = NewestFrame(), threading.Event()
    rule = ReconnectSettings(0.02, 0.04, None)
    settings = source_of("rtsp://host/live", reconnect=rule)
    thread = threading.Thread(target=capture, args=(settings, newest, stop), daemon=True)
    thread.start()
    wait_until(lambda: newest.reconnects >= 3, "three reconnections")
    stop.set()
    thread.join(PATIENCE)
    assert newest.reconnects >= 3
    assert Unsteady.opened >= 5  # the one that failed was no reconnection
    assert newest.ended or newest.take(0.0) is not None


def test_a_source_that_stays_away_ends_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    Unsteady.opened = 0
    monkeypatch.setattr(sources, "_open_address", lambda address: Unsteady(5 if Unsteady.opened == 0 else 0))
    newest = NewestFrame()
    capture(source_of("rtsp://host/live", reconnect=ReconnectSettings(0.02, 0.04, 0.2)), newest, threading.Event())
    assert Unsteady.opened >= 2
    assert newest.broken
    newest.take(0.0)
    with pytest.raises(InputError, match=r"rtsp://host/live: address: broke off.*give_up"):
        newest.take(0.0)
    for first, longest, give_up in ((0.0, 1.0, None), (2.0, 1.0, None), (1.0, 2.0, -1.0)):
        with pytest.raises(InputError, match="reconnect"):
            ReconnectSettings(first, longest, give_up)


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
