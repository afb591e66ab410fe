"""The viewer: its timeline, its door, what it reads, and all of it in a headless Chromium."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.waiting import wait_until
from hypothesis import given
from hypothesis import strategies as st

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.result_files import write_columns_csv
from egopose.humanoid.config import HumanoidConfig
from egopose.inference.outputs import TakeVideo, write_footage, write_motion_files
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.viewer.auth_proxy import Address, judge
from egopose.viewer.clip import Footage
from egopose.viewer.clip_sources import read_columns, read_run, read_runs
from egopose.viewer.player import Player
from egopose.viewer.video_panel import Pictures
from egopose.vision.video import write_video

FRAMES = 40
TOKEN = "0123456789abcdef"


def walk(phase: float = 0.0, forces: bool = False) -> Motion:
    """A body gliding along x, swinging its arms."""
    skeleton = HumanoidConfig.from_mapping(compose_config("prepare")["humanoid"]).skeleton()
    qpos = np.tile(skeleton.rest_qpos(), (FRAMES, 1))
    t = np.arange(FRAMES) / 30
    qpos[:, 0], qpos[:, 2], qpos[:, 3] = t, 0.95, 1
    qpos[:, 30] = np.sin(4 * t + phase)
    if not forces:
        return Motion(skeleton, qpos, 30.0, "walk")
    push = np.zeros((FRAMES, 2, 3))
    push[..., 2] = 350
    feet = ("RightFoot", "LeftFoot")
    point = np.stack([np.stack([t, 0 * t + y, 0 * t], axis=1) for y in (-0.1, 0.1)], axis=1)
    return Motion(
        skeleton, qpos, 30.0, "walk",
        contacts=np.ones((FRAMES, 2), bool), contact_names=tuple(f"{f}_heel" for f in feet),
        torques=100 * np.abs(np.sin(np.arange(FRAMES * skeleton.n_dofs))).reshape(FRAMES, -1),
        ground_reaction=GroundReaction(feet, push, point, 0 * push),
    )  # fmt: skip


def evaluation(folder: Path, phase: float) -> Path:
    """As `egopose evaluate` leaves it: one take with a video, and one window of a forecast."""
    take = folder / "takes" / "walk_0-40"
    take.mkdir(parents=True)
    write_motion_files(take, "estimate", walk(phase, forces=True))
    write_motion_files(take, "reference", walk())
    value = 10 + np.cos(np.arange(FRAMES) / 5 + phase)
    write_columns_csv(
        take / "frames.csv",
        {"E_pose": value / 10, "E_vel": value[1:], "value": value, "confidence": value / 10, "reset": 0 * value},
    )
    picture = np.zeros((FRAMES, 64, 192, 3), np.uint8)
    picture[:, :, 128:, 0] = 255
    write_video(take / "side_by_side.mp4", picture, 30.0)
    window = folder / "windows" / "walk_10"
    window.mkdir(parents=True)
    for name in ("forecast", "reference", "future_0"):
        write_motion_files(window, name, walk(phase + len(name)))
    angle = walk(phase).qpos[:, 30]
    edges = {"low": angle - 0.2, "median": angle, "high": angle + 0.2}
    write_columns_csv(window / "bands.csv", {f"RightHand_0_{k}": v for k, v in edges.items()})
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    base = tmp_path_factory.mktemp("view")
    return [evaluation(base / "first", 0.0), evaluation(base / "second", 1.0)]


def test_evaluations_are_read_whole(folders: list[Path]) -> None:
    run = read_run(folders[0])
    assert list(run.clips) == ["walk_0-40", "walk_10"]
    take, window = run.clips.values()
    assert take.reference is not None
    assert take.footage == Footage(folders[0] / "takes/walk_0-40/side_by_side.mp4", last_panel=True)
    assert np.isnan(take.curves["E_vel"][0])
    assert window.forecast
    assert len(window.futures) == 1
    assert list(window.bands) == ["RightHand_0"]
    assert [r.label for r in read_runs([folders[0], folders[0], folders[1]])] == ["first", "first (2)", "second"]


def test_the_wearers_own_video_comes_first(folders: list[Path], tmp_path: Path) -> None:
    take = tmp_path / "take"
    shutil.copytree(folders[0] / "takes/walk_0-40", take)
    video = tmp_path / "wearer.mp4"
    write_footage(take, TakeVideo(video, 0.5, rendered=True), 15, 30.0)
    assert read_run(take).clips["take"].footage == Footage(take / "side_by_side.mp4", last_panel=True)  # it is gone
    write_video(video, np.zeros((FRAMES, 32, 48, 3), np.uint8), 30.0)
    assert read_run(take).clips["take"].footage == Footage(video, 0.5, 0.5, rendered=True)
    (take / "wearer.json").write_text('{"video": 3}')
    with pytest.raises(InputError, match="footage"):
        read_run(take)


def test_pictures_keep_step_where_the_video_begins_late(tmp_path: Path) -> None:
    grey = np.arange(0, 200, 10, dtype=np.uint8)
    write_video(tmp_path / "v.mp4", np.broadcast_to(grey[:, None, None, None], (20, 32, 32, 3)).copy(), 30.0)
    for offset, first in ((-0.2, 6), (0.1, 0)):
        pictures = Pictures(Footage(tmp_path / "v.mp4", offset), 30.0, 12)
        pictures._thread.join()
        assert pictures.fault is None
        assert (pictures.at(first - 1) is None) or first == 0
        for frame in (first, first + 4):
            seen = pictures.at(frame)
            assert seen is not None
            assert abs(float(seen.mean()) - grey[frame + round(offset * 30)]) < 6
        pictures.close()


def test_what_cannot_be_shown_is_told(folders: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_run(tmp_path / "nothing")
    with pytest.raises(InputError, match="egopose evaluate"):
        read_run(tmp_path)
    with pytest.raises(InputError, match="one clip, and here are 2"):
        read_run(folders[0], Footage(tmp_path / "x.mp4"))
    for text in ("frame,value\n0,1\n", "frame,value\n0,x\n1,2\n", "frame,value\n0\n1,2\n", ""):
        (tmp_path / "frames.csv").write_text(text)
        with pytest.raises(InputError):
            read_columns(tmp_path / "frames.csv", 2)


@given(
    frames=st.integers(1, 500), fps=st.floats(1, 120), speed=st.sampled_from([0.1, 1.0, 4.0]),
    waits=st.lists(st.floats(0, 3), max_size=10), loop=st.booleans(),
)  # fmt: skip
def test_the_timeline_keeps_time_and_stays_inside(
    frames: int, fps: float, speed: float, waits: list[float], loop: bool
) -> None:
    now = [0.0]
    player = Player(lambda: now[0])
    player.load(frames, fps)
    player.loop, player.speed = loop, speed
    player.play(True)
    for wait in waits:
        now[0] += wait
        expected = now[0] * fps * speed
        shown = player.frame()
        assert 0 <= shown < frames
        if not loop:
            assert abs(shown - min(expected, frames - 1)) <= 1
    player.play(False)
    here = player.frame()
    now[0] += 10
    assert player.frame() == here
    player.seek(10**6)
    assert player.frame() == frames - 1


def head(path: str = "/", **headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", *(f"{k}: {v}" for k, v in headers.items())]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def test_the_door_lets_in_its_own_pages_only() -> None:
    here = Address()
    assert judge(head(Host="127.0.0.1:8080"), here) is None
    assert judge(head(Host="localhost:8080", Origin="http://localhost:8080"), here) is None
    for bad in (
        head(Host="evil.example"),
        head(Host="127.0.0.1:8080", Origin="http://evil.example"),
        head(Host="127.0.0.1:8080", Origin="null"),
        head(Host="127.0.0.1:8080", Origin="http://127.0.0.1:9"),
        head(),
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"\xff\r\n\r\n",
    ):
        answer = judge(bad, here)
        assert answer is not None
        assert answer.startswith(b"HTTP/1.1 40")


def test_another_address_asks_for_a_token() -> None:
    with pytest.raises(InputError, match="token"):
        Address(host="0.0.0.0")
    with pytest.raises(InputError, match="16"):
        Address(host="0.0.0.0", token="short")
    there = Address(host="0.0.0.0", token=TOKEN)
    welcome = judge(head(f"/?token={TOKEN}", Host="box:8080"), there)
    assert welcome is not None
    assert b"303" in welcome
    assert b"HttpOnly" in welcome
    assert judge(head(Host="box:8080", Cookie=f"egopose_view={TOKEN}"), there) is None
    for bad in (
        head(Host="box"),
        head("/?token=wrong", Host="box"),
        head(Host="box", Cookie="egopose_view=wrong"),
        head(Host="box", Cookie="egopose_view=\xff"),
        head(Host="box", Cookie=f"egopose_view={TOKEN}", Origin="http://evil.example"),
    ):
        answer = judge(bad, there)
        assert answer is not None
        assert b"403" in answer


def test_in_a_browser_it_loads_plays_scrubs_and_switches(folders: list[Path], page: Any) -> None:
    from egopose.viewer.app import Viewer

    viewer = Viewer(read_runs(folders), Address(port=0, token=TOKEN))
    faults, addresses = [], []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: addresses.append(request.url))
    try:
        assert page.goto(viewer.url.partition("?")[0]).status == 403
        page.goto(viewer.url)
        assert "token" not in page.url
        page.wait_for_selector("canvas")
        status = page.locator("text=/^frame \\d+ of/")
        status.wait_for()
        frame = page.locator("input.mantine-NumberInput-input").first

        def scrub(number: int) -> None:
            # Keys as a person gives them: after a change from the server the box overlooks a value set at once.
            frame.click()
            page.keyboard.press("Control+A")
            page.keyboard.type(str(number))
            page.wait_for_selector(f"text=/^frame {number} of 40/")

        def choose(label: str, option: str) -> None:
            page.get_by_label(label, exact=True).first.click()
            page.get_by_role("option", name=option, exact=True).click()

        scrub(25)
        page.wait_for_selector("text=Wearer's video")
        before = page.locator("canvas").first.screenshot()
        scrub(5)
        page.wait_for_timeout(300)
        assert page.locator("canvas").first.screenshot() != before
        page.get_by_role("button", name="Play", exact=True).click()
        page.get_by_role("button", name="Pause", exact=True).wait_for()
        page.wait_for_function("!document.body.innerText.includes('frame 5 of')")
        page.get_by_role("button", name="Pause", exact=True).click()
        page.get_by_role("button", name="Play", exact=True).wait_for()
        choose("Compare", "second")
        page.wait_for_selector("text=/orange: second/")
        choose("Run", "second")
        page.wait_for_selector("text=/blue: second/")
        choose("Take", "walk_10")
        page.wait_for_selector("text=Joint angle and its band")
        page.wait_for_selector("text=/violet: other futures drawn/")
        scrub(7)
        if where := os.environ.get("VIEWER_SCREENSHOT"):
            page.screenshot(path=where)
        assert not faults
        assert all(url.startswith((viewer.url.partition("?")[0], "data:", "blob:")) for url in addresses)
    finally:
        viewer.close()


def test_in_a_browser_the_sync_is_moved_by_frames(
    tmp_path: Path, page: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    from egopose.viewer.app import Viewer

    write_motion_files(tmp_path, "walk", walk())
    write_video(tmp_path / "walk.mp4", np.zeros((2 * FRAMES, 32, 48, 3), np.uint8), 30.0)
    footage = Footage(tmp_path / "walk.mp4", 0.4)
    viewer = Viewer([read_run(tmp_path / "walk.bvh", footage)], Address(port=0))
    try:
        page.goto(viewer.url)
        page.get_by_text("Sync", exact=True).click()
        page.wait_for_selector("text=sync_offset: 0.400")
        page.get_by_role("button", name="+10", exact=True).click()
        page.wait_for_selector("text=sync_offset: 0.733")
        page.get_by_role("button", name="-1", exact=True).click()
        page.wait_for_selector("text=sync_offset: 0.700")
        page.get_by_role("button", name="Find", exact=True).click()
        page.wait_for_selector("text=/no offset stands out/")  # of a head that does not turn
        page.get_by_role("button", name="Print setting", exact=True).click()
        wait_until(lambda: "sync_offset: 0.700" in capsys.readouterr().out, "the setting is printed")
    finally:
        viewer.close()


class Gui:
    """A folder that counts the charts made in it."""

    visible = True

    def __init__(self) -> None:
        self.made: list[Any] = []

    def add_folder(self, title: str) -> Gui:
        return self

    def add_uplot(self, data: Any, series: Any, scales: Any, **other: Any) -> Any:
        self.made.append(SimpleNamespace(data=data, scales=scales, remove=lambda: None))
        return self.made[-1]

    def __enter__(self) -> None: ...

    def __exit__(self, *error: object) -> None: ...


def test_lines_that_change_all_the_time_stay_one_chart() -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'egopose[view]'")
    from egopose.viewer.charts import Chart

    gui = Gui()
    chart: Any = Chart(gui, "V")  # type: ignore[arg-type]
    for k in range(5):
        chart.set({"value": (np.sin(np.arange(10.0) + k), "red")}, 10.0, begin=-0.9, now=9)
    (made,) = gui.made
    time, values, now = made.data
    np.testing.assert_allclose(time[[0, -1]], [-0.9, 0.0])
    np.testing.assert_allclose(values, np.sin(np.arange(10.0) + 4))
    assert now.argmax() == 9
    for scale in (1000.0, 0.001):
        chart.set({"value": (scale * np.sin(np.arange(10.0)), "red")}, 10.0)
        low, high = made.scales["y"]["range"]
        assert 2 * scale < high - low < 5 * scale
    chart.set({"other": (np.ones(3), "red")}, 10.0)
    assert len(gui.made) == 2
    chart.set({"other": (np.full(3, np.nan), "red")}, 10.0)
    assert not gui.visible


def test_a_stream_is_shown_live() -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'egopose[view]'")
    from egopose.inference.stream.broadcast import Broadcast, ServerSettings
    from egopose.inference.stream.live_body import LivePose
    from egopose.inference.stream.live_forecasts import LiveForecast
    from egopose.inference.stream.messages import forecast_json, frame_json, hello
    from egopose.viewer.live import LiveViewer

    motion = walk()
    sent = Broadcast(ServerSettings("127.0.0.1", 0, None, 2, 60), hello(motion.skeleton, 30.0, 10, "test"))
    viewer = LiveViewer(f"ws://127.0.0.1:{sent.port}/json", Address(port=0))
    try:
        pose = LivePose(frame=7, qpos=motion.qpos[7], value=1.0, confidence=None, reset=False)
        wait_until(lambda: viewer.frame == 7, "the pose is shown", lambda: sent.send(frame_json(pose, 30.0, 5.0)))
        assert not any(shape.visible for shape in viewer._poses_ahead)
        # A forecast begun two frames earlier: its poses ahead of the one shown, as far as it reaches.
        turning = np.tile(motion.qpos[7], (40, 1))
        turning[:, 7] += 0.01 * np.arange(40)
        angles = turning[:, 7:]
        coming = LiveForecast(5, turning, np.stack([turning] * 2), angles - 0.1, angles + 0.2, None, False)
        name = viewer._degrees[0]
        viewer._joint.value = name
        turns = itertools.count()

        def send() -> None:
            sent.send(forecast_json(coming, 30.0, 80.0))
            sent.send(frame_json(LivePose(7 + next(turns) % 2, motion.qpos[7], 1.0, None, False), 30.0, 5.0))

        wait_until(lambda: viewer.forecast >= 5 and viewer._angle._lines, "the forecast is shown", send)
        assert viewer.forecast == 5
        assert [shape.visible for shape in viewer._poses_ahead] == [True, True, False, False]
        high, low, middle = viewer._angle._lines
        np.testing.assert_allclose(middle, turning[:, 7], atol=1e-4)
        np.testing.assert_allclose(high - low, 0.3, atol=1e-3)
        sent.send(frame_json(LivePose(7, motion.qpos[7], 1.0, None, False), 30.0, 5.0))
        wait_until(lambda: viewer.frame == 7, "the pose before is shown")
        row = 7 + 12 - 5 - 1
        posed = forward_kinematics(motion.skeleton, turning[row][None])
        root = motion.qpos[7, :3] * [1, 1, 0]  # the body shown stands before the camera
        expected = viewer._surface.posed(posed[0][0] - root, posed[1][0])
        np.testing.assert_allclose(viewer._poses_ahead[0].vertices, expected, atol=1e-3)
    finally:
        viewer.close()
        sent.close()
    with pytest.raises(InputError, match="stream"):
        LiveViewer("ws://127.0.0.1:9/json", Address(port=0))
