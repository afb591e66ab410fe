"""The virtual action camera: what it films against what it says of itself, and against geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, rotate
from egopose.vision.bystander_films import drone_film, moving_picture_film, still_film
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.camera_tracks import Poses, angular_velocity, worn_track
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera
from egopose.vision.mounts import camera_poses, mount_of
from egopose.vision.places.place import Builder, wrap
from egopose.vision.places.scenery import FILM_CAMERA
from egopose.vision.stabilisation import as_the_camera_saw
from egopose.vision.steadying import image_rotations
from egopose.vision.surfaces import add_lights
from egopose.vision.telemetry import read_telemetry
from egopose.vision.telemetry.frames import angular_velocity_at
from egopose.vision.video import Frame, read_frames
from egopose.vision.virtual_gopro import FilmSettings, film, record
from egopose.vision.virtual_imu import inertial_samples

FLOW = FlowConfig("medium", 128, 32, workers=1)
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def swaying(seconds: float = 1.2, rate: float = 30.0) -> Array:
    """One who stands and turns to and fro, his root's yaw and pitch rates up to 0.9 and 0.35 rad/s."""
    times = np.arange(round(seconds * rate) + 1) / rate
    turn = Rotation.from_euler("ZY", np.stack([0.15 * np.sin(6 * times), 0.05 * np.sin(7 * times)], axis=1))
    qpos = np.repeat(default_humanoid().mj_model.qpos0[None], len(times), axis=0)
    qpos[:, 3:7] = turn.as_quat()[:, [3, 0, 1, 2]]
    return qpos


def turns_seen(frames: list[Frame], view: float, fps: float) -> Array:
    """rad/s ``[T, 3]`` that flow tells of square pictures ``view`` degrees wide."""
    return camera_rotation(np.stack(list(flow_of_frames(frames, FLOW))), view) * fps


def filmed(settings: FilmSettings, path: Path, make: Callable) -> tuple[Array, Array]:  # type: ignore[type-arg]
    """What flow tells of a film without undoing its stabilisation, and what is true of the camera."""
    truth = make(path, settings)
    camera = Camera(settings.field_of_view, settings.lens)
    rectify = camera.rectifier(settings.width, settings.height, 128)
    view = camera.seen_view(settings.width, settings.height)
    return turns_seen([rectify(frame) for _, frame in read_frames(path)], view, settings.fps), truth


def worn(path: Path, settings: FilmSettings):  # type: ignore[no-untyped-def]
    return film(default_humanoid().xml, swaying(), 30.0, path, settings)


@pytest.mark.parametrize("changed", [{}, {"lens": "fisheye", "field_of_view": 110.0}, {"place": "street"}])
def test_flow_of_the_film_tells_the_cameras_turns(tmp_path: Path, changed: dict) -> None:  # type: ignore[type-arg]
    """To a tenth of the turns: what the camera's way round the neck moves the near ground by stays in it."""
    seen, truth = filmed(replace(FilmSettings(), **changed), tmp_path / "film.mp4", worn)
    true = truth.angular_velocity
    assert np.sqrt((true[1:] ** 2).mean()) > 0.2
    assert np.sqrt(((seen - true)[1:] ** 2).mean()) < 0.1 * np.sqrt((true[1:] ** 2).mean(axis=0)).max()


def test_the_truth_is_the_bodys_kinematics(tmp_path: Path) -> None:
    settings = FilmSettings(width=64, height=36, mount="chest", readout=0.016)
    truth = film(default_humanoid().xml, swaying(0.5), 30.0, tmp_path / "film.mp4", settings)
    poses = Poses(swaying(0.5), 30.0)
    mount = mount_of("chest", pitch_down=np.deg2rad(20.0))
    position, rotation = camera_poses(default_humanoid().mj_model, poses.at(truth.times + 0.008), mount)
    np.testing.assert_allclose(truth.positions, position, atol=1e-9)
    np.testing.assert_allclose(truth.rotations, rotation, atol=1e-9)
    mean = Rotation.from_matrix(rotation[3].T @ rotation[4]).as_rotvec() * 30.0
    np.testing.assert_allclose(truth.angular_velocity[4], mean, atol=1e-9)
    assert len(list(read_frames(tmp_path / "film.mp4"))) == len(truth.times)


def test_poses_between_frames_are_the_motions() -> None:
    """Splines meet a smooth motion sampled finely to a hundredth of a degree."""
    coarse, fine = Poses(swaying(2.0, 30.0), 30.0), swaying(2.0, 240.0)
    np.testing.assert_allclose(coarse.at(np.arange(len(fine)) / 240.0), fine, atol=2e-4)
    np.testing.assert_allclose(coarse.at(np.array([-1.0, 9.0])), fine[[0, -1]], atol=1e-9)


def test_a_stabilised_film_hides_the_turns_and_its_image_rotation_gives_them_back(tmp_path: Path) -> None:
    settings = FilmSettings(stabilised=True, imu=True, readout=0.008, gyroscope_noise=0.0, gyroscope_bias=0.0)
    path = tmp_path / "film.mp4"
    seen, truth = filmed(settings, path, worn)
    true, steady = truth.angular_velocity, truth.picture_angular_velocity
    size = float(np.sqrt((true[1:] ** 2).mean()))
    assert np.sqrt((steady[1:] ** 2).mean()) < 0.75 * size
    assert np.sqrt(((seen - steady)[1:] ** 2).mean()) < 0.2 * size
    assert np.sqrt(((seen - true)[1:] ** 2).mean()) > 0.3 * size
    telemetry, camera = read_telemetry(path), Camera(settings.field_of_view, settings.lens, readout=settings.readout)
    undone = [picture for _, picture, _ in as_the_camera_saw(read_frames(path), telemetry, camera, 128, path)]
    given_back = turns_seen(undone, camera.seen_view(settings.width, settings.height), settings.fps)
    assert np.sqrt(((given_back - true)[1:] ** 2).mean()) < 0.25 * size


def test_the_telemetry_is_the_cameras_own_turn_within_noise_and_bias(tmp_path: Path) -> None:
    settings = FilmSettings(width=64, height=36, imu=True, readout=0.016, gyroscope_noise=0.01, gyroscope_bias=0.02)
    truth = worn(tmp_path / "film.mp4", settings)
    told = read_telemetry(tmp_path / "film.mp4")
    assert (told.field_of_view, told.lens) == (pytest.approx(90.0, abs=0.1), "linear")
    assert told.readout == pytest.approx(0.016, abs=1e-6)
    mean = angular_velocity_at(told, truth.times[2:-2], 1 / 30)
    np.testing.assert_allclose(mean, truth.angular_velocity[2:-2], atol=4 * (0.02 + 0.01 / np.sqrt(6)))
    error = np.abs(mean - truth.angular_velocity[2:-2]).mean()
    assert 1e-4 < error < 0.06
    assert told.camera_orientation is not None
    from_first = Rotation.from_matrix(truth.rotations[0].T @ truth.rotations[5]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        rotate(told.camera_orientation.values[5], np.array([0.0, 0.0, 1.0])), from_first, atol=1e-3
    )


def test_sensors_measure_gravity_at_rest_and_the_turn_of_a_turning_camera() -> None:
    """A level camera that turns right about its own y axis at 0.5 rad/s, half a metre from the axis it goes round."""

    def track(times: Array) -> tuple[Array, Array]:
        turn = Rotation.from_euler("Z", -0.5 * np.asarray(times)[:, None]).as_matrix()
        return 0.5 * turn[:, :, 0], turn @ LEVEL

    rng = np.random.default_rng(0)
    gyroscope, accelerometer = inertial_samples(track, 1.0, rng, 0.0, 0.0)
    np.testing.assert_allclose(gyroscope.values, [[0.0, 0.5, 0.0]] * len(gyroscope.times), atol=1e-9)
    # Centripetal: towards the axis, which is behind.
    inner = accelerometer.values[2:-2]
    np.testing.assert_allclose(inner, [[0.0, -9.81, -0.5 * 0.5**2]] * len(inner), atol=1e-3)
    noisy, _ = inertial_samples(track, 20.0, rng, 0.01, 0.05)
    assert (noisy.values - [0.0, 0.5, 0.0]).std(axis=0) == pytest.approx(0.01, rel=0.1)


def test_a_rolling_shutter_slants_an_upright_edge_by_its_turn_during_the_readout(tmp_path: Path) -> None:
    """Turning right at w, an edge straight ahead moves left by f w t from row to row."""
    spec = mujoco.MjSpec()
    white, black = (wrap(spec, name, np.full((8, 8, 3), grey, np.uint8)) for name, grey in (("w", 255), ("b", 0)))
    b = Builder(spec, "edge")
    b.box(20.0, 0.0, 0.0, (0.1, 60.0, 60.0), white)
    b.box(10.0, 50.0, 0.0, (0.1, 50.0, 30.0), black)
    add_lights(spec, np.random.default_rng(0))
    spec.worldbody.add_camera(name=FILM_CAMERA)
    rate, readout, width, height = 2.0, 0.03, 640, 480

    def track(times: Array) -> tuple[Array, Array]:
        # The edge is straight ahead in the middle of the second frame's readout.
        yaw = -rate * (np.asarray(times) - 1 / 30 - readout / 2)
        return np.zeros((len(yaw), 3)), Rotation.from_euler("Z", yaw[:, None]).as_matrix() @ LEVEL

    settings = FilmSettings(width=width, height=height, readout=readout, field_of_view=90.0)
    nobody = Poses(np.tile([0.0, 0, 0, 1, 0, 0, 0], (4, 1)), 30.0)
    truth = record(tmp_path / "edge.mp4", settings, spec.compile(), 100.0, lambda m, d, t: None, track, nobody)
    frames = [frame for _, frame in read_frames(tmp_path / "edge.mp4")]
    # To parts of a pixel: how much of each row is dark.
    grey = frames[1].mean(axis=2)
    dark, light = np.percentile(grey, [5, 95])
    edge = np.clip((light - grey) / (light - dark), 0.0, 1.0).sum(axis=1)[4:-4]
    slant = np.polyfit(np.arange(len(edge)), edge, 1)[0] * height
    assert slant == pytest.approx(-0.5 * width * rate * readout, rel=0.1)
    np.testing.assert_allclose(edge[len(edge) // 2], width / 2, atol=2.0)
    np.testing.assert_allclose(truth.angular_velocity[1:], [[0.0, rate, 0.0]] * (len(frames) - 1), atol=1e-9)


def test_stabilisation_stays_within_the_sensor_and_needs_none_at_rest() -> None:
    optics = FilmSettings(stabilised=True).optics
    turning = Rotation.from_euler("ZY", np.stack([0.3 * np.sin(np.arange(90) / 5), np.zeros(90)], 1)).as_matrix()
    image = image_rotations(turning @ LEVEL, 30.0, optics)
    corners = np.einsum("tij,nj->tni", image, optics.border(kept=True))
    assert np.abs(optics.on_sensor(corners)).max() <= 1.0 + 1e-9
    assert np.abs(Rotation.from_matrix(image).as_rotvec()).max() > np.deg2rad(1.0)
    still = image_rotations(np.repeat(LEVEL[None], 30, axis=0), 30.0, optics)
    np.testing.assert_allclose(still, np.repeat(np.eye(3)[None], 30, axis=0), atol=1e-9)


def test_angular_velocity_is_the_derivative_of_the_rotation() -> None:
    poses = Poses(walking().qpos, 30.0)
    track = worn_track(default_humanoid().mj_model, poses, mount_of("head"), np.zeros((2, 3)), np.zeros((2, 3)))
    times = np.linspace(0.1, 0.8, 7)
    rotation, step = track(times)[1], 1e-4
    change = (track(times + step)[1] - track(times - step)[1]) / (2 * step)
    spin = np.einsum("tji,tjk->tik", rotation, change)
    found = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(angular_velocity(track, times), found, atol=2e-3)


def test_a_seed_gives_one_film(tmp_path: Path) -> None:
    settings = FilmSettings(width=64, height=48, mount="held", place="furnished_room", people=True, shake=0.5)
    films = []
    for k, seed in enumerate((1, 1, 2)):
        truth = film(default_humanoid().xml, swaying(0.2), 30.0, tmp_path / f"{k}.mp4", replace(settings, seed=seed))
        films.append((truth.rotations, np.stack([frame for _, frame in read_frames(tmp_path / f"{k}.mp4")])))
    np.testing.assert_array_equal(films[0][0], films[1][0])
    np.testing.assert_array_equal(films[0][1], films[1][1])
    assert np.abs(films[0][0] - films[2][0]).max() > 1e-3


def test_bystanders_films(tmp_path: Path) -> None:
    settings = FilmSettings(width=128, height=96, seed=5)
    for cliff in (False, True):
        truth = drone_film(tmp_path / "drone.mp4", settings, 0.5, cliff)
        assert 5.0 <= truth.positions[:, 2].min() <= truth.positions[:, 2].max() <= 60.0
        speed = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1) * 30.0
        assert speed.min() > 1.0
        assert np.linalg.norm(truth.angular_velocity, axis=1).max() < 1.0
    still = still_film(tmp_path / "still.mp4", settings, 0.5)
    np.testing.assert_array_equal(still.angular_velocity, 0.0)
    assert np.ptp(still.positions, axis=0).max() == 0.0
    qpos = np.repeat(default_humanoid().mj_model.qpos0[None], 16, axis=0)

    def standing(path: Path, settings: FilmSettings):  # type: ignore[no-untyped-def]
        return moving_picture_film(default_humanoid().xml, qpos, 30.0, path, settings)

    seen, truth = filmed(settings, tmp_path / "picture.mp4", standing)
    np.testing.assert_allclose(truth.angular_velocity, 0.0, atol=1e-9)
    assert np.abs(seen[1:, 1]).mean() > 0.2


def test_settings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    for changed, name in (({"readout": 0.05}, "readout"), ({"fps": 0.0}, "fps"), ({"bands": 0}, "bands")):
        with pytest.raises(InputError, match=name):
            FilmSettings(**changed)
    xml, qpos = default_humanoid().xml, swaying(0.2)
    for settings, name in ((FilmSettings(place="moon"), "place"), (FilmSettings(mount="knee"), "mount")):
        with pytest.raises(InputError, match=name):
            film(xml, qpos, 30.0, tmp_path / "no.mp4", settings)
    with pytest.raises(InputError, match="qpos"):
        film(xml, np.full_like(qpos, np.nan), 30.0, tmp_path / "no.mp4", FilmSettings())
    with pytest.raises(InputError, match="motion_fps"):
        film(xml, qpos, 0.0, tmp_path / "no.mp4", FilmSettings())
    with pytest.raises(InputError, match="duration"):
        still_film(tmp_path / "no.mp4", FilmSettings(), 0.0)
    assert not list(tmp_path.iterdir())
