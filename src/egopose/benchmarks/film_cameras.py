"""The cameras of ``egopose bench film``: what the command's words choose, films of a clip, and how they are read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from egopose.benchmarks.film_clips import CLIPS
from egopose.checkpoint.head_signal import load_head_signal_regressor
from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.inference.film_states import FilmReading, read_states
from egopose.models.head_path import camera_height, path_of_signal, states_on_path
from egopose.models.head_signal_input import signal_features
from egopose.models.pose_regression import pose_regression
from egopose.motion.rotations import Array
from egopose.vision.containers import boxes, inside_box
from egopose.vision.head_film import WornCamera, film_camera, head_rows, telemetry_of
from egopose.vision.head_signal import signal_of_motion
from egopose.vision.lens import Camera
from egopose.vision.mounts import camera_poses, mount_of
from egopose.vision.telemetry.track import is_telemetry
from egopose.vision.virtual_gopro import FilmSettings, film

PARTS = ("cameras", "clips", "confidence", "body")
PLACES = ("open_ground", "street", "furnished_room")
_SWITCH = {"true": True, "yes": True, "false": False, "no": False}
#: s from a picture's first row to its last, and degrees of the mount's play.
READOUT, SHAKE = 0.012, 0.3
#: Degrees; wider lenses are fisheyes.
_WIDEST_PINHOLE = 100.0


@dataclass(frozen=True)
class Chosen:
    """What the words of the command choose: each a list, ``key=one,two``.

    Args:
        pitch: degrees that the camera looks down.
        width: degrees across the picture.
        stabilised, imu: no, yes or both.
        place: of :data:`PLACES`.
        clip: of :data:`egopose.benchmarks.film_clips.CLIPS`, for the table by clips.
        part: of :data:`PARTS`: which tables.
        body: also let the whole ``egopose estimate`` move its body along a few films.
        pixels: of a picture's width.
        seconds: of a film, at most.
    """

    pitch: tuple[float, ...] = (0.0, 20.0, 45.0)
    width: tuple[float, ...] = (60.0, 90.0, 120.0)
    stabilised: tuple[bool, ...] = (False, True)
    imu: tuple[bool, ...] = (True, False)
    place: tuple[str, ...] = PLACES
    clip: tuple[str, ...] = CLIPS
    part: tuple[str, ...] = ("cameras", "clips", "confidence")
    body: bool = False
    pixels: int = 320
    seconds: float = 60.0

    @staticmethod
    def of(words: Sequence[str]) -> Chosen:
        """Of the command's words.

        Raises:
            InputError: an unknown key, or a value that cannot be; names it.
        """
        given: dict[str, object] = {}
        for word in words:
            key, _, text = word.partition("=")
            given[key] = _value(key, text.split(","))
        chosen = Chosen(**given)  # type: ignore[arg-type]
        allowed = {"place": PLACES, "clip": CLIPS, "part": PARTS}
        for key, names in allowed.items():
            for one in getattr(chosen, key):
                if one not in names:
                    raise InputError("bench film", key, f"{one!r}; there are {', '.join(names)}")
        if not 64 <= chosen.pixels <= 4096 or not 1.0 <= chosen.seconds <= 3600.0:
            raise InputError("bench film", "pixels or seconds", "64 to 4096 pixels and 1 to 3600 s")
        return chosen


def _value(key: str, parts: list[str]) -> object:
    """The value of a key of :class:`Chosen`."""
    if key not in {field.name for field in fields(Chosen)}:
        raise InputError("bench film", key, f"is no setting; there are {', '.join(f.name for f in fields(Chosen))}")
    try:
        if key in ("pitch", "width"):
            return tuple(float(part) for part in parts)
        if key in ("stabilised", "imu"):
            return tuple(_SWITCH[part] for part in parts)
        if key == "body":
            return _SWITCH[parts[0]]
        if key in ("pixels", "seconds"):
            return int(parts[0]) if key == "pixels" else float(parts[0])
    except (ValueError, KeyError):
        raise InputError("bench film", key, f"{','.join(parts)!r} is no value of it") from None
    return tuple(parts)


@dataclass(frozen=True)
class Shot:
    """A camera and the place it films in: how one film is taken. ``seed`` is the place's and the noise's."""

    pitch: float
    width: float
    stabilised: bool
    place: str
    seed: int
    pixels: int

    def settings(self) -> FilmSettings:
        """Of the virtual camera, with telemetry."""
        return FilmSettings(
            width=self.pixels,
            height=round(self.pixels * 9 / 16),
            field_of_view=self.width,
            lens=self.lens,
            pitch_down=self.pitch,
            shake=SHAKE,
            readout=READOUT,
            stabilised=self.stabilised,
            imu=True,
            place=self.place,
            people=self.place != "open_ground",
            seed=self.seed,
        )

    @property
    def lens(self) -> str:
        """What a lens of that width is."""
        return "fisheye" if self.width > _WIDEST_PINHOLE else "pinhole"

    def about(self, clip: str, imu: bool) -> dict[str, Any]:
        """What a row of a table says of the film."""
        said = {name: getattr(self, name) for name in ("pitch", "width", "stabilised", "place", "seed")}
        return {"clip": clip, **said, "imu": imu}

    def camera(self, imu: bool) -> Camera:
        """What ``egopose estimate`` is told of it: with telemetry nothing, without all that its maker tells."""
        return Camera() if imu else Camera(self.width, self.lens, readout=READOUT)


def shots(chosen: Chosen, seeds: Iterable[int]) -> list[Shot]:
    """Every camera of the choice in every place, with every seed."""
    every = product(chosen.pitch, chosen.width, chosen.stabilised, chosen.place, seeds)
    return [Shot(*one, chosen.pixels) for one in every]


def take(humanoid: HumanoidModel, qpos: Array, shot: Shot, folder: Path) -> Path:
    """Film a motion ``[T, nq]``; gives the MP4 with telemetry."""
    path = folder / "film.mp4"
    film(humanoid.xml, qpos, 1.0 / humanoid.control_dt, path, shot.settings())
    return path


def read_film(humanoid: HumanoidModel, path: Path, camera: Camera) -> FilmReading:
    """What a film tells of its wearer. Raises InputError as :func:`egopose.inference.film_states.read_states`."""
    worn = WornCamera()
    telemetry = telemetry_of(path, worn)
    known, _ = film_camera(path, camera, telemetry)
    rows = list(head_rows(path, 1.0 / humanoid.control_dt, 0.0, known, telemetry))
    return read_states(humanoid, rows, path, camera, worn)


@torch.no_grad()
def read_exactly(humanoid: HumanoidModel, qpos: Array, pitch: float) -> FilmReading:
    """What a film of a motion ``[T, nq]`` would tell if the camera's motion were known without error.

    ``pitch`` is in degrees. What is wrong with the result is no fault of film.
    """
    fps, worn = 1.0 / humanoid.control_dt, WornCamera()
    mount = mount_of(worn.mount, 0.0, float(np.deg2rad(pitch)), 0.0)
    signal = signal_of_motion(*camera_poses(humanoid.mj_model, qpos, mount), fps)
    height = camera_height(humanoid, worn.mount)
    told = load_head_signal_regressor(humanoid).from_features(signal_features(signal, worn.mount)[None])
    states = told["humanoid_state"][0].numpy()
    placed = states_on_path(states, path_of_signal(signal, states, height, fps), fps)
    return FilmReading(signal, torch.from_numpy(placed).float(), height, ())


def motion_of(humanoid: HumanoidModel, reading: FilmReading) -> Array:
    """``[T, nq]`` of the kinematic motion that the body follows, from the origin along x."""
    start, ahead = np.zeros(2), np.array([1.0, 0.0, 0.0, 0.0])
    states = reading.states.numpy()
    return pose_regression(states, humanoid.skeleton, start, ahead, 1.0 / humanoid.control_dt).qpos


def without_telemetry(path: Path) -> Path:
    """A copy of an MP4 of the bench whose telemetry, track and settings, is free space, which readers skip."""
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        index = inside_box(stream, 0, len(data), b"moov")
        assert index is not None  # the bench wrote the film
        for kind, start, end in boxes(stream, *index):
            if kind == b"udta" or (kind == b"trak" and is_telemetry(stream, (start, end))):
                data[start - 4 : start] = b"free"
    bare = path.with_name(f"{path.stem}_bare.mp4")
    bare.write_bytes(data)
    return bare
