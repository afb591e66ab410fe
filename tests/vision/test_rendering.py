"""The rendered wearer's video: geometry against calculation, rooms, resumability, and a real take's flow."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.vision import gl
from egopose.vision.features import extract_flow
from egopose.vision.mounts import camera_orientations
from egopose.vision.rendering import (
    SceneRenderer,
    WearerCamera,
    side_view_frames,
    wearer_frames,
)
from egopose.vision.rooms import draw_room, furnish, room_seed
from egopose.vision.surfaces import random_pattern
from egopose.vision.takes import RenderConfig, RenderJob, is_rendered, render_takes
from egopose.vision.video import probe_video, read_frames

CONF = Path(__file__).resolve().parents[2] / "conf"

# A wearer of four parts: a trunk, a head with a camera that (oddly) looks along y, and an arm before it.
WEARER = """
<mujoco>
  <worldbody>
    <light pos="0 0 4"/>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="Hips" pos="0 0 1">
      <freejoint/>
      <geom type="capsule" fromto="0 0 0 0 0 .4" size=".12"/>
      <body name="Head" pos="0 0 .5" euler="0 0 90">
        <joint axis="1 0 0"/>
        <geom type="sphere" size=".1"/>
        <camera name="head" pos=".1 0 .05" xyaxes="0 -1 0 0 0 1"/>
      </body>
      <body name="Arm" pos="0 .1 .3">
        <joint axis="1 0 0"/>
        <geom type="capsule" fromto="0 0 0 0 .4 -.05" size=".05"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def config() -> RenderConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return RenderConfig.from_mapping(compose(overrides=["+vision=light"]).vision)


def standing(count: int) -> np.ndarray:
    qpos = np.zeros((count, 9))
    qpos[:, 2], qpos[:, 3] = 1.0, 1.0
    return qpos


def render(qpos: np.ndarray, config: RenderConfig, room: int = 1, take: int = 1, size: int = 128) -> list[np.ndarray]:
    frames = wearer_frames(
        WEARER,
        qpos,
        room_seed=room,
        take_seed=take,
        room=config.room,
        camera=config.camera,
        size=size,
        fps=config.fps,
    )
    return list(frames)


def still_camera(config: RenderConfig, pitch: float = 0.0) -> RenderConfig:
    exact = replace(
        config.camera,
        field_of_view=(90.0, 90.0),
        pitch_down=(pitch, pitch),
        roll=(0.0, 0.0),
        yaw=(0.0, 0.0),
        shake=(0.0, 0.0),
    )
    return replace(config, camera=exact)


def test_camera_is_mounted_as_measured_on_a_person_standing_straight() -> None:
    model = mujoco.MjModel.from_xml_string(WEARER)
    data = mujoco.MjData(model)
    down, yaw, roll = np.deg2rad([30.0, 10.0, 5.0])
    for angles, ahead in (([0, 0, 0], [0, 1, 0]), ([0, down, 0], [0, np.cos(down), -np.sin(down)])):
        model.cam_quat[0] = camera_orientations(model, np.array([angles]))[0]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(-data.cam_xmat[0].reshape(3, 3)[:, 2], ahead, atol=1e-9)
        np.testing.assert_allclose(data.cam_xmat[0].reshape(3, 3)[:, 0], [1, 0, 0], atol=1e-9)
    # All three at once, against SciPy: intrinsic turns about the camera's own y, x and z.
    model.cam_quat[0] = camera_orientations(model, np.array([[yaw, down, roll]]))[0]
    mujoco.mj_forward(model, data)
    level = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=float)  # columns: right, up, back
    expected = level @ Rotation.from_euler("YXZ", [yaw, -down, roll]).as_matrix()
    np.testing.assert_allclose(data.cam_xmat[0].reshape(3, 3), expected, atol=1e-9)


def test_shake_has_the_size_and_the_mounting_it_is_drawn_with() -> None:
    camera = WearerCamera(90.0, 0.1, 0.5, -0.05, shake=0.01, shake_time=0.1)
    angles = camera.angles(np.random.default_rng(0), 20000, 30.0)
    np.testing.assert_allclose(angles.mean(0), [0.1, 0.5, -0.05], atol=1e-3)
    np.testing.assert_allclose(angles.std(0), 0.01, rtol=0.05)
    steps = np.corrcoef(angles[1:, 0], angles[:-1, 0])[0, 1]
    assert steps == pytest.approx(np.exp(-1 / 3), abs=0.03)


@pytest.mark.parametrize("preset", ["ultrafast", "fast", "medium"])
def test_flow_of_a_turning_head_is_the_turn(config: RenderConfig, tmp_path: Path, preset: str) -> None:
    """Turning left by w a frame moves the middle of the picture right by tan(w) / (2 tan(fov / 2)) of its width."""
    rate = np.deg2rad(2.0)
    qpos = standing(12)
    for t in range(12):
        qpos[t, 3:7] = [np.cos(rate * t / 2), 0, 0, np.sin(rate * t / 2)]
    # Walls far away: the camera's own way round the neck adds nothing to speak of.
    far = replace(still_camera(config), room=replace(config.room, margin=(7.0, 8.0), furniture_density=(0.0, 0.0)))
    job = RenderJob("turn", WEARER, qpos, tmp_path / "turn.mp4", "train")
    assert render_takes([job], far, workers=1, progress=False) == 1
    flow = extract_flow(job.path, {"preset": preset, "working_size": 128, "stored_size": 32}).astype(float)
    middle = flow[1:, :, 4:14, 12:20]  # above the horizon: no arm there
    assert np.median(middle[:, 0]) == pytest.approx(np.tan(rate) / 2, rel=0.1)
    assert abs(np.median(middle[:, 1])) < 2e-3


def test_a_moving_arm_is_seen_and_is_flow(config: RenderConfig, tmp_path: Path) -> None:
    still, moving = standing(16), standing(16)
    moving[:, 8] = 0.5 * np.sin(0.5 * np.arange(16))
    worn = still_camera(config, pitch=28.0)
    flows = []
    for name, qpos in (("still", still), ("moving", moving)):
        job = RenderJob("same", WEARER, qpos, tmp_path / f"{name}.mp4", "train")
        render_takes([job], worn, workers=1, progress=False)
        flows.append(
            extract_flow(job.path, {"preset": "ultrafast", "working_size": 128, "stored_size": 32}).astype(float)
        )
    speed = [np.abs(f).max(axis=(0, 1)) for f in flows]
    assert speed[0].max() < 5e-3
    assert (speed[1] > 1e-2).sum() > 20


def test_rooms_keep_clear_of_the_motion_and_enclose_it(config: RenderConfig) -> None:
    path = np.stack([np.linspace(0, 6, 200), np.sin(np.linspace(0, 6, 200))], axis=1)
    for seed in range(30):
        room = draw_room(seed, path, 2.9, config.room)
        assert np.all(path - room.low >= config.room.margin[0] - 1e-9)
        assert np.all(room.high - path >= config.room.margin[0] - 1e-9)
        assert room.height >= 3.2 - 1e-9
        for piece in room.pieces:
            gap = np.linalg.norm(path - piece.centre, axis=1).min() - np.linalg.norm(piece.half_size[:2])
            assert gap > config.room.clearance
    assert sum(len(draw_room(s, path, 2, config.room).pieces) for s in range(30)) > 30


def test_a_room_looks_the_same_for_its_seed_and_touches_nothing(config: RenderConfig) -> None:
    a, b, c = (render(standing(1), config, room=seed)[0] for seed in (5, 5, 6))
    assert np.array_equal(a, b)
    assert np.abs(a.astype(float) - c).mean() > 10
    spec = mujoco.MjSpec.from_string(WEARER)
    furnish(spec, draw_room(5, np.zeros((1, 2)), 2, config.room), config.room)
    model = spec.compile()
    world = model.geom_bodyid == 0
    assert world.sum() >= 6
    assert not model.geom_contype[world].any()
    assert not model.geom_conaffinity[world].any()


def test_every_surface_has_texture_at_every_scale() -> None:
    for seed in range(10):
        grey = random_pattern(np.random.default_rng(seed), 128, (40.0, 60.0), (90.0, 165.0)).mean(axis=2)
        for scale in (1, 4, 16):
            blocks = grey.reshape(128 // scale, scale, 128 // scale, scale).mean((1, 3))
            assert np.abs(np.diff(blocks, axis=1)).mean() > 4


def test_test_rooms_are_seen_by_no_training_take(config: RenderConfig) -> None:
    names = [f"take{i}" for i in range(2000)]
    train, test = ({room_seed(n, split, config.room) for n in names} for split in ("train", "test"))
    assert not train & test
    assert (len(train), len(test)) == (config.room.train_rooms, config.room.test_rooms)
    with pytest.raises(ValueError, match="split"):
        room_seed("take", "validation", config.room)


def test_takes_resume_and_follow_their_settings(config: RenderConfig, tmp_path: Path) -> None:
    jobs = [RenderJob(f"t{i}", WEARER, standing(4 + i), tmp_path / f"t{i}.mp4", "train") for i in range(3)]
    assert render_takes(jobs, config, workers=2, progress=False) == 3
    assert render_takes(jobs, config, workers=2, progress=False) == 0
    assert [len(list(read_frames(j.path))) for j in jobs] == [4, 5, 6]
    assert probe_video(jobs[0].path).width == config.size
    assert json.loads(jobs[0].path.with_suffix(".json").read_text())["frames"] == 4
    jobs[0].path.unlink()  # lost
    jobs[1].path.with_suffix(".json").write_text("{")  # damaged record
    jobs[2] = replace(jobs[2], qpos=standing(7))  # another motion under the same name
    assert not any(is_rendered(j, config) for j in jobs)
    assert render_takes(jobs, config, workers=1, progress=False) == 3
    assert len(list(read_frames(jobs[2].path))) == 7
    with pytest.raises(InputError, match="same video"):
        render_takes([jobs[0], jobs[0]], config, workers=1)


def test_a_worker_process_hands_its_error_over(config: RenderConfig, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file where the folder should be")
    jobs = [RenderJob(f"t{i}", WEARER, standing(2), tmp_path / "taken" / f"{i}.mp4", "train") for i in range(2)]
    with pytest.raises(InputError, match=r"taken.*folder: cannot be made"):
        render_takes(jobs, config, workers=2, progress=False)


def test_side_view_follows_each_motion(config: RenderConfig) -> None:
    model = mujoco.MjModel.from_xml_string(WEARER)
    here, there = standing(3), standing(2)
    there[:, 0] = 1.5
    frames = list(side_view_frames(model, [here, there], ["reference", "estimate"], 96))
    assert [f.shape for f in frames] == [(96, 192, 3)] * 2
    assert frames[0].std() > 5


def test_renderer_opens_and_closes_often_and_says_when_it_is_closed() -> None:
    model = mujoco.MjModel.from_xml_string(WEARER)
    pictures = []
    for _ in range(5):
        with SceneRenderer(model, 80, 48) as renderer:
            pictures.append(renderer.render(standing(1)[0], "head"))
    assert pictures[0].shape == (48, 80, 3)
    assert all(np.array_equal(pictures[0], p) for p in pictures)
    renderer.close()
    with pytest.raises(ValueError, match="closed"):
        renderer.render(standing(1)[0], "head")


def test_a_model_that_cannot_be_worn_is_refused(config: RenderConfig) -> None:
    with pytest.raises(ValueError, match="coordinates"):
        render(np.zeros((2, 5)), config)
    with pytest.raises(ValueError, match="without frames"):
        render(np.zeros((0, 9)), config)
    bare = WEARER.replace('name="head"', 'name="tail"')
    with pytest.raises(ValueError, match="no camera"):
        next(
            wearer_frames(
                bare,
                standing(1),
                room_seed=0,
                take_seed=0,
                room=config.room,
                camera=config.camera,
                size=64,
                fps=30,
            )
        )


def test_bad_settings_are_named() -> None:
    with pytest.raises(InputError, match="video"):
        RenderConfig.from_mapping({"room": {}, "camera": {}})
    with pytest.raises(InputError, match="colour"):
        RenderConfig.from_mapping({"video": {"size": 8, "fps": 30}, "room": {"colour": [0, 1]}, "camera": {}})


def test_without_opengl_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl, "_PROBE", "raise SystemExit(1)")
    gl.choose_backend.cache_clear()
    with pytest.raises(RuntimeError, match="apt-get install libosmesa6"):
        gl.choose_backend()
    gl.choose_backend.cache_clear()


def test_backend_is_chosen_whatever_was_imported_before() -> None:
    """dm_control and MuJoCo bind a back end at import; rendering has to work after that as well."""
    code = (
        "import dm_control.mjcf, mujoco, numpy as np\n"
        "from egopose.vision.rendering import SceneRenderer\n"
        'model = mujoco.MjModel.from_xml_string(\'<mujoco><worldbody><light pos="0 0 3"/>'
        '<camera name="c" pos="0 0 3"/><geom type="sphere" size="1"/></worldbody></mujoco>\')\n'
        "with SceneRenderer(model, 64, 64) as r:\n"
        "    print(r.render(np.zeros(0), 'c').mean() > 1)\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "True", done.stderr
