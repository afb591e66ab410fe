"""The scene of a clip as a YAML file: boxes, contacts, and what is known of the camera.

Units are m, rad and s. The world has z up, and its floor is at z = 0. Its x is the first picture's right, its y points
away from the camera, and the pelvis starts at x = y = 0. What a user leaves out is filled in from the film.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import yaml

from egopose.core.atomic_write import write_text_whole
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.safe_io import read_yaml
from egopose.humanoid.boxes import DEPTH

FLOOR = "floor"
EFFECTORS = ("right_foot", "left_foot", "right_hand", "left_hand")
CAMERA_MOTIONS = ("fixed", "pan", "zoom", "track")
#: What of a box may be free: its place along its own x (the way the body comes) and y, its height, its yaw.
FREE = ("along", "across", "height", "yaw")
#: m: what Yu, Park & Lee 2021, section 5, leave free of each object.
USUAL_RANGE = (-0.3, 0.3)
_MOST = 1000  # boxes or notes; contacts of an hour are some 10,000
_MOST_CONTACTS = 20_000
_FURTHEST = 1e4  # m
_NAME = re.compile(r"[A-Za-z][\w-]{0,39}")
_HEAD = """\
# A scene: boxes, contacts and the camera. m, rad, s; z up; x is the picture's right, y points away.
# What is left out (place, height, yaw, contacts) `egopose reconstruct prepare` fills in; what is given it keeps.
"""

Range = tuple[float, float]
T = TypeVar("T")


@dataclass(frozen=True)
class Box:
    """A box that bodies stand on or hold.

    Args:
        name: letters, digits, ``_`` and ``-``.
        size: m, of the upper face: its length along the box's own x and its width.
        place: m, x and y of the upper face's middle; None to be filled in.
        height: m, of the upper face over the floor; None to be filled in.
        yaw: rad, of the box's own x about the vertical; None to be filled in.
        free: what fitting may change, each of :data:`FREE` with the least and the largest change (m, rad).

    Raises:
        InputError: a value cannot be; names the field.
    """

    name: str
    size: tuple[float, float]
    place: tuple[float, float] | None = None
    height: float | None = None
    yaw: float | None = None
    free: dict[str, Range] = field(default_factory=lambda: {"along": USUAL_RANGE, "height": USUAL_RANGE})

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name) or self.name == FLOOR:
            raise _fault("name", f"{self.name!r:.60} must begin with a letter, and cannot be {FLOOR!r}")
        if not all(0 < side <= _FURTHEST for side in self.size):
            raise _fault("size", f"{list(self.size)} must be positive lengths, m")
        if self.place is not None and not all(abs(value) <= _FURTHEST for value in self.place):
            raise _fault("place", f"{list(self.place)} must be two finite numbers, m")
        if self.height is not None and not 0 <= self.height <= DEPTH:
            raise _fault("height", f"{self.height} must be from 0 to {DEPTH:g} m over the floor")
        if self.yaw is not None and not abs(self.yaw) <= _FURTHEST:
            raise _fault("yaw", f"{self.yaw} must be finite, rad")
        for name, (low, high) in self.free.items():
            if name not in FREE:
                raise _fault(f"free.{name}", f"is none of {', '.join(FREE)}")
            if not (isfinite(low) and isfinite(high) and low <= 0 <= high):
                raise _fault(f"free.{name}", f"[{low}, {high}] must hold 0: changes are against the first guess")

    @property
    def known(self) -> bool:
        """Whether place, height and yaw are all there."""
        return self.place is not None and self.height is not None and self.yaw is not None


@dataclass(frozen=True)
class Contact:
    """An end effector that touches something, from frame ``first`` to frame ``last``, both included.

    Raises:
        InputError: a value cannot be; names the field.
    """

    effector: str
    touches: str
    first: int
    last: int

    def __post_init__(self) -> None:
        if self.effector not in EFFECTORS:
            raise _fault("effector", f"{self.effector!r:.60} is none of {', '.join(EFFECTORS)}")
        if self.touches != FLOOR and not _NAME.fullmatch(self.touches):
            raise _fault("touches", f"{self.touches!r:.60} is no name of a box, nor {FLOOR!r}")
        if self.first < 0:
            raise _fault("first", f"{self.first} must not be negative")
        if self.last < self.first:
            raise _fault("last", f"{self.last} lies before the first frame, {self.first}")


@dataclass(frozen=True)
class CameraNotes:
    """What is known of the camera; None is to be found or taken for usual.

    Args:
        motion: one of :data:`CAMERA_MOTIONS`: whether it stands, turns, turns and zooms, or moves along.
        field_of_view: rad, over the longer side of the first picture.
        pitch: rad, how far it looks below the horizon in the first frame.
        roll: rad, how far the first picture's right side hangs below its left.

    Raises:
        InputError: a value cannot be; names the field.
    """

    motion: str | None = None
    field_of_view: float | None = None
    pitch: float | None = None
    roll: float | None = None

    def __post_init__(self) -> None:
        if self.motion is not None and self.motion not in CAMERA_MOTIONS:
            raise _fault("motion", f"{self.motion!r:.60} is none of {', '.join(CAMERA_MOTIONS)}")
        if self.field_of_view is not None and not 0 < self.field_of_view < 3.1:
            raise _fault("field_of_view", f"{self.field_of_view} must be an angle between 0 and 3.1 rad")
        for name in ("pitch", "roll"):
            value = getattr(self, name)
            if value is not None and not abs(value) <= 3.2:
                raise _fault(name, f"{value} must be an angle, rad")


@dataclass(frozen=True)
class Scene:
    """What a clip's body moves among.

    Args:
        fps: frames per second in which contacts count their frames.
        begin: s, where in the film frame 0 lies.
        camera: see :class:`CameraNotes`.
        boxes: no name twice.
        contacts: empty to be filled in. Each names the floor or one of the boxes.
        notes: a sentence each.

    Raises:
        InputError: a value cannot be; names the field.
    """

    fps: float = 30.0
    begin: float = 0.0
    camera: CameraNotes = CameraNotes()
    boxes: tuple[Box, ...] = ()
    contacts: tuple[Contact, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 < self.fps <= 1000:
            raise _fault("fps", f"{self.fps} must be a rate of up to 1000")
        if not 0 <= self.begin <= 1e6:
            raise _fault("begin", f"{self.begin} must be seconds from 0 on")
        for name, most in (("boxes", _MOST), ("contacts", _MOST_CONTACTS), ("notes", _MOST)):
            if len(getattr(self, name)) > most:
                raise _fault(name, f"there are {len(getattr(self, name))}; at most {most} are read")
        names = [box.name for box in self.boxes]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise _fault(f"boxes[{k}].name", f"{name!r} is there twice")
        for k, contact in enumerate(self.contacts):
            if contact.touches not in (FLOOR, *names):
                there = ", ".join([FLOOR, *names])
                raise _fault(f"contacts[{k}].touches", f"there is no box {contact.touches!r}; there are {there}"[:200])

    def box(self, name: str) -> Box:
        """The box of that name. Raises KeyError."""
        return {box.name: box for box in self.boxes}[name]


def read_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Raises:
        InputError: no such file, no YAML, a field missing, unknown or of another kind (``boxes[1].size``).
    """
    return read_told_scene(path)[0]


def read_told_scene(path: str | Path) -> tuple[Scene, bool]:
    """A scene file, and whether it says which boxes there are, and be it none (``boxes: []``).

    Raises as :func:`read_scene`.
    """
    path = Path(path)
    values = read_yaml(path, "scene")
    if not isinstance(values, dict):
        raise InputError(path, "scene", "must be a mapping of boxes, contacts, camera, fps, begin, notes")
    values = {str(key): value for key, value in values.items() if value is not None}
    parts: dict[str, Any] = {
        "boxes": tuple(_each(Box, values, "boxes", path)),
        "contacts": tuple(_each(Contact, values, "contacts", path)),
    }
    if "camera" in values:
        parts["camera"] = _part(CameraNotes, values["camera"], path, "camera")
    plain = {key: value for key, value in values.items() if key not in ("boxes", "contacts", "camera")}
    known = {one.name for one in fields(Scene)}
    if unknown := set(plain) - known:
        raise InputError(path, sorted(unknown)[0][:60], f"is no field; there are {', '.join(sorted(known))}")
    try:
        plain = vars(from_mapping(_Plain, plain, str(path)))
        return Scene(**plain, **parts), "boxes" in values
    except InputError as error:
        raise InputError(path, error.field, error.cause) from None


def write_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene file that :func:`read_scene` reads, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    values = _plain(asdict(scene))
    for box in values["boxes"]:
        for key in ("place", "height", "yaw"):
            if box[key] is None:
                del box[key]
    values["camera"] = {key: value for key, value in values["camera"].items() if value is not None}
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
    write_text_whole(Path(path), _HEAD + text)


@dataclass(frozen=True)
class _Plain:
    """The fields of a scene that are no parts."""

    fps: float = 30.0
    begin: float = 0.0
    notes: tuple[str, ...] = ()


def _each(kind: type[T], values: Mapping[str, Any], name: str, path: Path) -> list[T]:
    rows = values.get(name, [])
    if not isinstance(rows, list):
        raise InputError(path, name, f"must be a list, not {rows!r:.60}")
    return [_part(kind, row, path, f"{name}[{k}]") for k, row in enumerate(rows)]


def _part(kind: type[T], values: Any, path: Path, name: str) -> T:
    if not isinstance(values, Mapping):
        raise InputError(path, name, f"must be a mapping, not {values!r:.60}")
    try:
        return from_mapping(kind, {str(key): value for key, value in values.items()}, str(path))
    except InputError as error:
        raise InputError(path, f"{name}.{error.field}", error.cause) from None


def _plain(value: Any) -> Any:
    """Lists for tuples: what YAML knows."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, list | tuple) else value


def _fault(name: str, cause: str) -> InputError:
    return InputError("scene", name, cause)
