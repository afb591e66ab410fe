"""The sync offset: found on rendered takes whose offset is known, refused where there is none to be found."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import prepare
from egopose.data.store import TakeStore
from egopose.data.sync_offset import (
    find_offset,
    head_turning,
    run_sync,
    settings_of,
    sync_offset,
    unexplained,
    video_turning,
)
from egopose.motion.io import read_motion, write_motion
from egopose.motion.motion import Motion
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera
from egopose.vision.video import read_frames, write_video

CLIPS = Path(str(files("egopose") / "assets" / "clips"))
NAMES = ("cmu07_05", "cmu07_06", "deepmimic_cartwheel")
FLOW = FlowConfig("medium", 128, 32, 1)


def config(overrides: list[str]) -> dict:
    return compose_config("prepare", ["data=own", "vision.workers=1", "vision.flow.workers=1", *overrides])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> TakeStore:
    rows = [f"{{motion: {CLIPS / name}.motion.npz}}" for name in NAMES]
    folder = tmp_path_factory.mktemp("sync") / "store"
    return prepare(config([f"data.takes=[{', '.join(rows)}]", f"data.store={folder}"]), progress=False)


def cut(name: str, start: float, seconds: float) -> tuple[Motion, float]:
    """A piece of a clip and the time in the clip at which it begins."""
    motion = read_motion(CLIPS / f"{name}.motion.npz")
    first = round(start * motion.fps)
    return motion.slice(first, first + round(seconds * motion.fps)), first / motion.fps


@pytest.mark.parametrize(("take", "start"), [(0, 0.61), (0, 1.09), (1, 0.377), (1, 0.9), (2, 0.213), (2, 0.55)])
def test_the_offset_is_found_within_a_frame(rendered: TakeStore, take: int, start: float) -> None:
    name = rendered.takes[take].name
    seconds = 0.7 * rendered.takes[take].length / 30
    motion, began = cut(name, start, seconds)
    found = sync_offset(rendered.video(take), motion, settings_of(config([])["data"]), FLOW)
    assert abs(found.offset - began) < 1 / 30
    assert found.confidence > 1.25


def test_another_takes_motion_is_refused(rendered: TakeStore) -> None:
    motion, _ = cut("deepmimic_cartwheel", 0.2, 2.0)
    with pytest.raises(InputError, match=r"no offset stands out.*give it as a number"):
        sync_offset(rendered.video(0), motion, settings_of(config([])["data"]), FLOW)


def test_what_cannot_be_looked_for_is_refused(rendered: TakeStore) -> None:
    search = settings_of(config([])["data"])
    with pytest.raises(InputError, match=r"lasts 0\.\d+ s; to find an offset 1 s are needed"):
        sync_offset(rendered.video(0), cut("cmu07_05", 0, 0.5)[0], search, FLOW)
    with pytest.raises(InputError, match="cannot cover 80% of"):
        sync_offset(rendered.video(2), cut("cmu01_01", 0, 6.0)[0], search, FLOW)
    with pytest.raises(InputError, match="no offset stands out"):
        find_offset(np.zeros((60, 3)), np.zeros((90, 3)), search)


def test_prepare_finds_the_offset_itself(rendered: TakeStore, tmp_path: Path) -> None:
    motion, began = cut("deepmimic_cartwheel", 0.4, 1.9)
    write_motion(motion, tmp_path / "wheel.motion.npz")
    row = f"{{motion: {tmp_path}/wheel.motion.npz, video: {rendered.video(2)}, sync_offset: auto, camera: {{fps: 30}}}}"
    store = prepare(config([f"data.takes=[{row}]", f"data.store={tmp_path / 'store'}"]), progress=False)
    assert abs(store.takes[0].sync_offset - began) < 1 / 30
    assert store.takes[0].camera["fps"] == 30
    assert TakeStore.open(store.root).takes == store.takes


def test_the_verb_finds_it_in_a_faster_video_shot_in_slow_motion(rendered: TakeStore, tmp_path: Path) -> None:
    # Each frame twice: 60 frames/s, stamped as 7.5.
    slow = tmp_path / "slow.mp4"
    write_video(slow, [f for _, f in read_frames(rendered.video(2)) for _ in range(2)], 7.5)
    motion, began = cut("deepmimic_cartwheel", 0.5, 1.9)
    write_motion(motion, tmp_path / "wheel.bvh")
    overrides = [f"video={slow}", f"motion={tmp_path}/wheel.bvh", "data.camera.fps=60"]
    found = run_sync(compose_config("sync", overrides))
    assert abs(found.offset - began) < 1.5 / 30


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{motion: CLIP, sync_offset: auto}", "auto needs a video"),
        ("{motion: CLIP, video: CLIP, sync_offset: soon}", "seconds, or auto"),
        ("{motion: CLIP, video: CLIP, camera: {lens: fish}}", "there are pinhole, fisheye"),
        ("{motion: CLIP, video: CLIP, camera: {readout: 12}}", "is it in milliseconds"),
        ("{motion: CLIP, video: CLIP, camera: {zoom: 2}}", "is not a setting"),
    ],
)
def test_settings_that_cannot_be_are_named(row: str, message: str) -> None:
    clip = str(CLIPS / "cmu07_05.motion.npz")
    with pytest.raises(InputError, match=message):
        prepare(config([f"data.takes=[{row.replace('CLIP', clip)}]"]), progress=False)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.3, 3.0))
def test_mounting_and_scale_do_not_matter(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    head = rng.normal(size=(40, 3))
    mounted = scale * Rotation.random(random_state=seed).apply(head) + rng.normal(size=3)
    assert unexplained(head, mounted) == pytest.approx(0.0, abs=1e-9)
    # Mirrored axes are no mounting.
    assert unexplained(head, mounted * [1, 1, -1]) > 0.1
    assert 0.0 <= unexplained(head, rng.normal(size=(40, 3))) <= 1.0


@settings(max_examples=25, deadline=None)
@given(turn=st.tuples(*[st.floats(-0.03, 0.03)] * 3), view=st.floats(60, 110))
def test_a_turn_is_read_from_its_flow(turn: tuple[float, float, float], view: float) -> None:
    side, focal = 24, 0.5 / np.tan(np.deg2rad(view) / 2)
    centres = (np.arange(side) + 0.5) / side - 0.5
    x, y = np.meshgrid(centres, centres)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1).reshape(-1, 3)
    # A camera that turns sees the world turn the other way; in its axes, with this sign, u = -wy at the middle.
    seen = Rotation.from_rotvec(-np.array(turn)).apply(rays)
    flow = (seen[:, :2] / seen[:, 2:] * focal - np.stack([x, y], -1).reshape(-1, 2)).T.reshape(1, 2, side, side)
    flow[:, :, :6, :6] += 0.2  # a hand
    np.testing.assert_allclose(camera_rotation(flow, view)[0], turn, atol=3e-3)


def test_a_still_video_turns_nowhere(tmp_path: Path) -> None:
    write_video(tmp_path / "still.mp4", [np.full((64, 64, 3), 90, np.uint8)] * 20, 30)
    assert not video_turning(tmp_path / "still.mp4", Camera(), FLOW, 30.0, 100.0).any()


def test_head_turning_is_the_heads(rendered: TakeStore) -> None:
    clip = rendered.clip(0)
    turning = head_turning(clip, 30.0)
    _, quats = clip.forward_kinematics()
    head = Rotation.from_quat(quats[:, clip.skeleton.index("Head")][:, [1, 2, 3, 0]])
    np.testing.assert_allclose(turning, (head[:-1].inv() * head[1:]).as_rotvec() * 30, atol=1e-6)
