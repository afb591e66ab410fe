"""A virtual action camera: films of a motion with a lens, a rolling shutter, stabilisation and telemetry.

What a real film of the motion would be is rendered, and what no real film tells is returned: how the camera moved.
The stamp of a frame is the time of its first row. The truth of a frame is at its middle row, half a readout later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import mujoco
import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.camera_tracks import Poses, Track, angular_velocity, turn_between, worn_track
from egopose.vision.mounts import held_sway, mount_of, slow_noise
from egopose.vision.places.place import Way
from egopose.vision.places.scenery import Scenery, draw_scenery, scenery_model
from egopose.vision.shooting import Moment, Move, Optics, Shooter
from egopose.vision.steadying import image_rotations
from egopose.vision.telemetry import write_gpmf_mp4
from egopose.vision.video import VideoWriter
from egopose.vision.virtual_imu import camera_telemetry, inertial_samples

# s over which a mount's play is correlated, as in conf/vision/rendered.yaml.
_SHAKE_TIME = 0.1
# A film longer than this is no test film any more: its frames would take hours.
_MOST_FRAMES = 200_000


@dataclass(frozen=True)
class FilmSettings:
    """A camera, how it is worn, and where.

    Args:
        width, height: pixels.
        fps: frames/s.
        field_of_view: degrees across the width of the picture, whether it is stabilised or not.
        lens: ``pinhole`` (a linear mode) or ``fisheye`` (equidistant).
        pitch_down, yaw, roll: degrees, of the camera on a person standing straight.
        mount: ``head``, ``chest`` or ``held``.
        shake: degrees, standard deviation of the mount's play.
        readout: s from the exposure of the first row to that of the last; 0 exposes all at once.
        bands: of rows that a rolling shutter is drawn in.
        stabilised: the picture is steadied by ``crop``.
        crop: share of the sensor's width and height that a stabilised camera keeps back.
        imu: the MP4 gets a telemetry track.
        gyroscope_noise, gyroscope_bias: rad/s, standard deviations of each sample's and of the constant error.
        place: of :data:`egopose.vision.places.scenery.PLACES`.
        people, table: whether people pass, and a table stands before the wearer where it finds room.
        seed: of the place, the sway and the noise.

    Raises:
        InputError: a setting that cannot be; names it.
    """

    width: int = 256
    height: int = 144
    fps: float = 30.0
    field_of_view: float = 90.0
    lens: str = "pinhole"
    pitch_down: float = 20.0
    yaw: float = 0.0
    roll: float = 0.0
    mount: str = "head"
    shake: float = 0.0
    readout: float = 0.0
    bands: int = 4
    stabilised: bool = False
    crop: float = 0.1
    imu: bool = False
    gyroscope_noise: float = 0.003
    gyroscope_bias: float = 0.005
    place: str = "open_ground"
    people: bool = False
    table: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        bounds = {
            "fps": (1.0, 480.0),
            "pitch_down": (-90.0, 90.0),
            "shake": (0.0, 10.0),
            "readout": (0.0, min(0.1, 1.0 / max(self.fps, 1.0))),
            "bands": (1, 64),
            "gyroscope_noise": (0.0, 1.0),
            "gyroscope_bias": (0.0, 1.0),
        }
        for name, (least, most) in bounds.items():
            if not least <= getattr(self, name) <= most:
                raise InputError("film", name, f"{getattr(self, name)}; {least:g} to {most:g}")

    @property
    def optics(self) -> Optics:
        """The lens and the part of the sensor's picture that is kept. Raises InputError as Optics."""
        crop = self.crop if self.stabilised else 0.0
        return Optics(self.width, self.height, self.field_of_view, self.lens, crop)


@dataclass(frozen=True, eq=False)
class FilmTruth:
    """How the camera of a film really moved, at the middle row of each frame.

    Args:
        times: ``[T]`` s, the frames' stamps.
        positions: ``[T, 3]`` m.
        rotations: ``[T, 3, 3]`` from camera axes (x right, y down, z ahead) to the world.
        angular_velocity: ``[T, 3]`` rad/s about camera axes, the mean from the frame before; the first is zero.
        image_rotations: ``[T, 3, 3]`` from the picture's axes to the camera's: what stabilisation turned it by.
    """

    times: Array
    positions: Array
    rotations: Array
    angular_velocity: Array
    image_rotations: Array

    @property
    def picture_angular_velocity(self) -> Array:
        """rad/s ``[T, 3]`` of the view that the picture shows, about its own axes; the first is zero."""
        return mean_angular_velocity(self.times, self.rotations @ self.image_rotations)


def mean_angular_velocity(times: Array, rotations: Array) -> Array:
    """rad/s ``[T, 3]`` from each frame to the next, written to the later one; the first is zero."""
    turned = np.zeros((len(times), 3))
    turned[1:] = turn_between(rotations[:-1], rotations[1:]) / np.diff(times)[:, None]
    return turned


def film(
    model_xml: str, qpos: Array, motion_fps: float, path: str | PathLike[str], settings: FilmSettings
) -> FilmTruth:
    """Film a motion with a camera that its person wears; write the MP4, whole or not at all.

    Args:
        model_xml: the humanoid's MJCF with a camera ``head``.
        qpos: ``[T, nq]`` at ``motion_fps``.
        motion_fps: frames/s.
        path: the MP4.
        settings: of camera and place.

    Raises:
        InputError: a motion or a setting that cannot be, or no place to write to.
        RuntimeError: no OpenGL here.
    """
    poses = Poses(qpos, motion_fps)
    scenery = draw_scenery(settings.place, settings.seed, Way.of(qpos), settings.people, settings.table)
    model = scenery_model(scenery, model_xml)
    return film_worn(model_xml, poses, path, settings, model, scenery.place.far, scenery.move)


def film_worn(
    model_xml: str,
    poses: Poses,
    path: str | PathLike[str],
    settings: FilmSettings,
    model: mujoco.MjModel,
    far: float,
    move: Move,
) -> FilmTruth:
    """Film a motion in a scene of one's own: a model with the humanoid and a camera ``film``. See :func:`film`."""
    angles = np.deg2rad([settings.yaw, settings.pitch_down, settings.roll])
    mount = mount_of(settings.mount, *(float(angle) for angle in angles))
    count = max(int(np.ceil(poses.duration * settings.fps)) + 1, 2)
    rng = np.random.default_rng([settings.seed, 10])
    play = np.deg2rad(settings.shake) * slow_noise(rng, count, 3, _SHAKE_TIME, settings.fps)
    shifts = np.zeros((count, 3))
    if settings.mount == "held":
        sway, shifts = held_sway(rng, count, settings.fps)
        play = play + sway
    track = worn_track(mujoco.MjModel.from_xml_string(model_xml), poses, mount, play, shifts)
    return record(path, settings, model, far, move, track, poses)


def film_scene(
    scenery: Scenery, path: str | PathLike[str], settings: FilmSettings, track: Track, duration: float
) -> FilmTruth:
    """Film a place that no wearer is in, along any track. See :func:`film`."""
    model = scenery_model(scenery)
    nobody = Poses(np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]] * 2), 1.0 / max(duration, 1e-3))
    return record(path, settings, model, scenery.place.far, scenery.move, track, nobody)


def record(
    path: str | PathLike[str],
    settings: FilmSettings,
    model: mujoco.MjModel,
    far: float,
    move: Move,
    track: Track,
    poses: Poses,
) -> FilmTruth:
    """Film a model's scene along a track while its ``poses`` last. Raises as :func:`film`."""
    # The last row of the last frame is still of the motion.
    count = max(int(np.floor((poses.duration - settings.readout) * settings.fps + 1e-6)) + 1, 1)
    if count > _MOST_FRAMES:
        raise InputError("film", "frames", f"{count}; at most {_MOST_FRAMES}")
    optics, times = settings.optics, np.arange(count) / settings.fps
    positions, rotations = track(times + 0.5 * settings.readout)
    image = np.repeat(np.eye(3)[None], count, axis=0)
    if settings.stabilised:
        image = image_rotations(rotations, settings.fps, optics)
    bands = settings.bands if settings.readout > 0 else 1
    delays = (np.arange(bands) + 0.5) / bands * settings.readout
    moments = _moments(model, poses, track, (times[:, None] + delays).ravel())
    with Shooter(model, optics, far, move) as shooter, VideoWriter(path, settings.fps) as writer:
        for k in range(count):
            turned = image[k] if settings.stabilised else None
            writer.write(shooter.shoot(moments[k * bands : (k + 1) * bands], settings.readout, turned))
    if settings.imu:
        _write_telemetry(Path(path), settings, track, poses.duration, times, rotations, image)
    return FilmTruth(times, positions, rotations, mean_angular_velocity(times, rotations), image)


def _moments(model: mujoco.MjModel, poses: Poses, track: Track, times: Array) -> list[Moment]:
    qpos = poses.at(times) if model.nq else np.zeros((len(times), 0))
    if qpos.shape[1] != model.nq:
        raise InputError("film", "qpos", f"has {qpos.shape[1]} coordinates, the model {model.nq}")
    positions, rotations = track(times)
    velocities = angular_velocity(track, times)
    rows = zip(times, qpos, positions, rotations, velocities, strict=True)
    return [Moment(float(time), *row) for time, *row in rows]


def _write_telemetry(
    path: Path, settings: FilmSettings, track: Track, duration: float, times: Array, rotations: Array, image: Array
) -> None:
    rng = np.random.default_rng([settings.seed, 11])
    inertial = inertial_samples(track, duration, rng, settings.gyroscope_noise, settings.gyroscope_bias)
    told = replace(
        camera_telemetry(times, rotations, image, *inertial),
        field_of_view=settings.field_of_view,
        lens="linear" if settings.lens == "pinhole" else "wide",
        readout=settings.readout,
        stabilised=settings.stabilised,
    )
    write_gpmf_mp4(path, path, told, settings.fps)
