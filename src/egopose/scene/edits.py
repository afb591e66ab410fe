"""Changes to a scene, each a new scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from egopose.motion.rotations import Array
from egopose.scene.scene_file import FLOOR, Box, Contact, Scene

_NEW_SIZE, _NEW_HEIGHT = (0.6, 0.6), 0.3  # m: a step that a person takes easily


def with_box(scene: Scene, name: str, **changes: Any) -> Scene:
    """The scene with other values of one box. Raises InputError where they cannot be, KeyError of an unknown name."""
    changed = replace(scene.box(name), **changes)
    return replace(scene, boxes=tuple(changed if box.name == name else box for box in scene.boxes))


def add_box(scene: Scene, place: Array) -> tuple[Scene, str]:
    """The scene with one more box at ``place [2]`` (m), and its name."""
    taken = {box.name for box in scene.boxes}
    name = next(one for k in range(1, len(taken) + 2) if (one := f"box{k}") not in taken)
    box = Box(name, _NEW_SIZE, (round(float(place[0]), 3), round(float(place[1]), 3)), _NEW_HEIGHT, 0.0)
    return replace(scene, boxes=(*scene.boxes, box)), name


def remove_box(scene: Scene, name: str) -> Scene:
    """The scene without a box; what touched it touches the floor."""
    contacts = tuple(replace(c, touches=FLOOR) if c.touches == name else c for c in scene.contacts)
    return replace(scene, contacts=contacts, boxes=tuple(box for box in scene.boxes if box.name != name))


def with_contact(scene: Scene, row: int, contact: Contact) -> Scene:
    """The scene with another contact in a row; the row behind the last adds one."""
    rows = [*scene.contacts]
    rows[row : row + 1] = [contact]
    return replace(scene, contacts=tuple(rows))


def remove_contact(scene: Scene, row: int) -> Scene:
    """The scene without the contact in a row."""
    return replace(scene, contacts=(*scene.contacts[:row], *scene.contacts[row + 1 :]))
