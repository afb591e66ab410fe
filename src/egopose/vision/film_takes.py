"""Rendered takes as many cameras would film them in many places: what a take draws, and its frames.

The stored picture stays the square that flow needs: the middle of what a camera of any aspect ratio sees.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from egopose.core.config import convert, from_mapping
from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.corruption import Corruption
from egopose.vision.lens import LENSES
from egopose.vision.mounts import MOUNTS, camera_poses, held_sway, mount_of
from egopose.vision.places.place import Way
from egopose.vision.places.plain_room import draw_plain_room
from egopose.vision.places.scenery import PLACES, Scenery, draw_scenery, scenery_model, scenery_of
from egopose.vision.rendering import CameraConfig, WearerCamera
from egopose.vision.rooms import RoomConfig
from egopose.vision.shooting import Moment, Optics, Shooter
from egopose.vision.video import Frame

PLAIN_ROOM = "room"
_SOURCE = "conf/vision"
_ASPECTS = {"1:1": 1.0, "4:3": 4 / 3, "16:9": 16 / 9}


@dataclass(frozen=True)
class _Numbers:
    """Those of a film's settings that are plain numbers."""

    pinhole_widest: float
    people: float
    table: float


@dataclass(frozen=True)
class FilmRanges:
    """What a take draws beside ``camera`` and ``room`` (``conf/vision/film.yaml``).

    Args:
        places, mounts, lenses, aspects: how often each is drawn, in any unit.
        pinhole_widest: degrees across the width; a pinhole drawn wider is narrowed to it.
        people, table: the share of takes in which people pass, and a table stands before the wearer.
    """

    places: dict[str, float]
    mounts: dict[str, float]
    lenses: dict[str, float]
    aspects: dict[str, float]
    pinhole_widest: float
    people: float
    table: float

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> FilmRanges:
        """From ``vision.film``.

        Raises:
            InputError: a setting is missing, unknown or out of range; names it.
        """
        known = {"places": (PLAIN_ROOM, *PLACES), "mounts": MOUNTS, "lenses": LENSES, "aspects": tuple(_ASPECTS)}
        shares = {name: _shares(name, values.get(name), allowed) for name, allowed in known.items()}
        numbers = from_mapping(_Numbers, {k: v for k, v in values.items() if k not in known}, f"{_SOURCE}: film")
        places, mounts, lenses, aspects = shares.values()
        result = cls(places, mounts, lenses, aspects, numbers.pinhole_widest, numbers.people, numbers.table)
        for name in ("people", "table"):
            if not 0.0 <= getattr(result, name) <= 1.0:
                raise InputError(_SOURCE, f"film.{name}", f"{getattr(result, name)}; a share from 0 to 1")
        if not 10.0 <= result.pinhole_widest <= 125.0:
            raise InputError(_SOURCE, "film.pinhole_widest", f"{result.pinhole_widest}; 10 to 125 degrees")
        return result


def _shares(name: str, values: Any, allowed: tuple[str, ...]) -> dict[str, float]:
    if not isinstance(values, Mapping) or not values:
        raise InputError(_SOURCE, f"film.{name}", f"must give a share of each of {', '.join(allowed)}")
    if unknown := set(values) - set(allowed):
        raise InputError(_SOURCE, f"film.{name}", f"{sorted(unknown)[0]!r}; there are {', '.join(allowed)}")
    shares = {key: convert(value, float, _SOURCE, f"film.{name}.{key}") for key, value in values.items()}
    if not (np.isfinite(list(shares.values())).all() and min(shares.values()) >= 0 and sum(shares.values()) > 0):
        raise InputError(_SOURCE, f"film.{name}", f"{list(shares.values())}; numbers of 0 or more, not all 0")
    return shares


@dataclass(frozen=True)
class FilmTake:
    """One take's camera and place.

    Args:
        place: its kind.
        people, table: what it has.
        mount, lens, aspect: of the camera.
        across_width: degrees across the whole width of the camera's picture.
        worn: its mounting angles and play; its field of view is across the square that is stored.
        seed: of the take.
    """

    place: str
    people: bool
    table: bool
    mount: str
    lens: str
    aspect: str
    across_width: float
    worn: WearerCamera
    seed: int

    def camera_record(self) -> dict[str, Any]:
        """For the JSON beside the video; ``field_of_view`` is of the stored square, angles are in degrees."""
        worn = self.worn
        angles = {"pitch_down": worn.pitch_down, "yaw": worn.yaw, "roll": worn.roll}
        return {
            "field_of_view": worn.field_of_view,
            **{name: float(np.rad2deg(angle)) for name, angle in angles.items()},
            "mount": self.mount,
            "lens": self.lens,
            "aspect": self.aspect,
            "across_width": self.across_width,
        }

    def place_record(self) -> dict[str, Any]:
        """For the JSON beside the video."""
        return {"kind": self.place, "people": self.people, "table": self.table}


def draw_take(take_seed: int, ranges: FilmRanges, camera: CameraConfig) -> FilmTake:
    """A take's camera and place from its seed."""
    rng = np.random.default_rng([take_seed, 6])
    place, mount, lens, aspect = (
        str(rng.choice(list(shares), p=np.array(list(shares.values())) / sum(shares.values())))
        for shares in (ranges.places, ranges.mounts, ranges.lenses, ranges.aspects)
    )
    people, table = rng.random(2) < (ranges.people, ranges.table)
    drawn = WearerCamera.draw(rng, camera)
    across = drawn.field_of_view if lens == "fisheye" else min(drawn.field_of_view, ranges.pinhole_widest)
    if lens == "fisheye":
        square = across / _ASPECTS[aspect]
    else:
        square = float(np.rad2deg(2 * np.arctan(np.tan(np.deg2rad(0.5 * across)) / _ASPECTS[aspect])))
    worn = WearerCamera(square, drawn.yaw, drawn.pitch_down, drawn.roll, drawn.shake, drawn.shake_time)
    return FilmTake(place, bool(people), bool(table), mount, lens, aspect, across, worn, take_seed)


def film_frames(
    model_xml: str,
    qpos: Array,
    take: FilmTake,
    place_seed: int,
    room: RoomConfig,
    size: int,
    fps: float,
    corruption: Corruption | None = None,
) -> Iterator[Frame]:
    """What a take's camera sees, frame by frame: ``[size, size, 3]``.

    Args:
        model_xml: the humanoid's MJCF with a camera ``head`` on its head.
        qpos: ``[T, nq]`` at ``fps``.
        take: its camera and place.
        place_seed: of the place (:func:`egopose.vision.rooms.room_seed`).
        room: ranges of plain rooms.
        size: side, pixels.
        fps: frames/s.
        corruption: what is wrong with the video.

    Raises:
        InputError: no frames, or the model has no camera ``head`` or another number of coordinates.
        RuntimeError: no OpenGL here.
    """
    if len(qpos) == 0:
        raise InputError("film", "qpos", "a motion without frames cannot be rendered")
    scenery, rng = _scenery(take, place_seed, qpos, room), np.random.default_rng([take.seed, 2])
    angles, shifts = take.worn.angles(rng, len(qpos), fps), np.zeros((len(qpos), 3))
    if take.mount == "held":
        sway, shifts = held_sway(rng, len(qpos), fps)
        angles = angles + sway
    shown = np.arange(len(qpos))
    if corruption is not None:
        wrong = corruption.generator(take.seed)
        angles, shown = angles + corruption.angles(wrong, len(qpos), fps), corruption.shown(wrong, len(qpos))
    wearer = mujoco.MjModel.from_xml_string(model_xml)
    positions, rotations = camera_poses(wearer, qpos, mount_of(take.mount), angles, shifts)
    optics, still = Optics(size, size, take.worn.field_of_view, take.lens), np.zeros(3)
    with Shooter(scenery_model(scenery, model_xml), optics, scenery.place.far, scenery.move) as shooter:
        for k in shown:
            yield shooter.shoot([Moment(float(k) / fps, qpos[k], positions[k], rotations[k], still)])


def _scenery(take: FilmTake, seed: int, qpos: Array, room: RoomConfig) -> Scenery:
    way = Way.of(qpos)
    if take.place == PLAIN_ROOM:
        return scenery_of(draw_plain_room(seed, way, room), seed, way, take.people, take.table)
    return draw_scenery(take.place, seed, way, take.people, take.table)
