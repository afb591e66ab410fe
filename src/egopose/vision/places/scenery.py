"""A place with what may be added to any: passing people, and a table before the camera; and the model of it all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from egopose.core.errors import InputError
from egopose.vision.mounts import WEARER_CAMERA
from egopose.vision.places import things
from egopose.vision.places.furnished_room import draw_furnished_room
from egopose.vision.places.open_ground import draw_open_ground
from egopose.vision.places.people import Passer, add_people, draw_passers, place_people
from egopose.vision.places.place import Builder, Place, Way, clear, pattern_materials
from egopose.vision.places.street import draw_street
from egopose.vision.surfaces import ROOM_BASE, dress

DrawPlace = Callable[[int, Way], Place]
PLACES: dict[str, DrawPlace] = {
    "furnished_room": draw_furnished_room,
    "open_ground": draw_open_ground,
    "street": draw_street,
}
# The camera of the world that films; a humanoid's own is called otherwise.
FILM_CAMERA = "film"
_PEOPLE = 4
# From the wearer to the middle of a table before him, m, and what a table reaches from its middle.
_TABLE_AHEAD, _TABLE_REACH = 0.85, 0.5


@dataclass(frozen=True, eq=False)
class Scenery:
    """A drawn place, the people who pass, and the table before the camera (x, y, turn; m, rad) if there is one."""

    place: Place
    passers: tuple[Passer, ...]
    table: tuple[float, float, float] | None
    seed: int

    def move(self, model: mujoco.MjModel, data: mujoco.MjData, time: float) -> None:
        """Put the people where they are at a time (s)."""
        place_people(model, data, self.passers, time)


def draw_scenery(kind: str, seed: int, way: Way, people: bool = False, table: bool = False) -> Scenery:
    """A place of a kind of :data:`PLACES` about a way, with what is asked for where the way leaves room for it.

    Raises:
        InputError: an unknown kind.
    """
    if kind not in PLACES:
        raise InputError("film", "place", f"{kind!r}; there are {', '.join(PLACES)}")
    return scenery_of(PLACES[kind](seed, way), seed, way, people, table)


def scenery_of(place: Place, seed: int, way: Way, people: bool = False, table: bool = False) -> Scenery:
    """A drawn place with people and a table; neither changes the place itself."""
    passers = draw_passers(np.random.default_rng([seed, 2]), way, place, _PEOPLE) if people else ()
    return Scenery(place, passers, _table_before(np.random.default_rng([seed, 3]), way) if table else None, seed)


def _table_before(rng: np.random.Generator, way: Way) -> tuple[float, float, float] | None:
    """Where a table can stand before the wearer at some time and never in his way; None where nowhere."""
    for t in rng.permutation(len(way.path))[:50]:
        ahead = np.array([np.cos(way.heading[t]), np.sin(way.heading[t])])
        place = way.path[t] + _TABLE_AHEAD * ahead
        if way.distance(place) > _TABLE_REACH + 0.2:
            return float(place[0]), float(place[1]), float(way.heading[t])
    return None


def scenery_model(scenery: Scenery, model_xml: str | None = None) -> mujoco.MjModel:
    """The place with the humanoid in it as its wearer's camera sees it (dressed, the own head out of sight), or empty.

    Its camera ``film`` belongs to the world: who films moves it.

    Raises:
        InputError: the humanoid has no camera ``head``.
    """
    spec = mujoco.MjSpec() if model_xml is None else mujoco.MjSpec.from_string(model_xml)
    clear(spec)
    # Half of MuJoCo's edges around a capsule: a place has hundreds, and pixels are few.
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 14, 8
    if model_xml is not None:
        mount = spec.camera(WEARER_CAMERA)
        if mount is None:
            raise InputError("humanoid", "camera", f"the model has no camera {WEARER_CAMERA!r}")
        dress(spec, np.random.default_rng([scenery.seed, 4]), 128)
        for geom in mount.parent.geoms:
            # Seen from inside, one's own head is nothing but an obstacle.
            geom.material, geom.rgba = "", [0, 0, 0, 0]
    scenery.place.furnish(spec)
    rng = np.random.default_rng([scenery.seed, 5])
    if scenery.table is not None:
        x, y, turn = scenery.table
        wood = pattern_materials(spec, "table_wood", rng, 4, (15.0, 40.0), ROOM_BASE)
        things.table(Builder(spec, "table", (x, y), turn), rng, wood)
    add_people(spec, rng, scenery.passers)
    spec.worldbody.add_camera(name=FILM_CAMERA)
    return spec.compile()
