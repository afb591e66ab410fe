"""What the feet stood on: the floor's height, boxes where supports lie above it, and the scene filled in with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.boxes import DEPTH
from egopose.motion.rotations import Array
from egopose.scene.contacts import FEET
from egopose.scene.root import Support
from egopose.scene.scene_file import FLOOR, Box, Contact, Scene

#: m: a support this much above the floor is on something. One camera's depths put feet on one floor 0.1 m apart.
_STEP = 0.15
#: m: supports on one box lie no further from the nearest of them, and no further from each other in height.
_REACH, _ALIKE = 1.2, 0.25
#: m: a foot this far beside a box counts as one that is wrong in height by as much as levels may differ.
_BESIDE = 0.2
#: m: likewise, of the way out of a box for a foot that should stand on the floor: places are known better than heights.
_INSIDE = 0.1
#: m around the feet that stood on a box that nobody described, and its least side.
_MARGIN, _LEAST_SIDE = 0.2, 0.5


@dataclass(frozen=True)
class Level:
    """Supports on one thing.

    Args:
        supports: indices, in order of time.
        place: ``[2]`` m, the middle of where feet stood. size: ``[2]`` m along and across the heading.
        height: m over the floor.
        yaw: rad, the body's heading when it came.
        box: the name of the box that the scene says, or None.
    """

    supports: tuple[int, ...]
    place: Array
    size: Array
    height: float
    yaw: float
    box: str | None


def contacts_of(touching: NDArray[np.bool_]) -> tuple[tuple[str, int, int], ...]:
    """End effector, first and last frame of every contact in ``touching [T, 2]`` (right, left foot), by time."""
    out = []
    for foot, side in enumerate(FEET):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], touching[:, foot].astype(np.int8), [0]])))
        out += [(f"{side}_foot", int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return tuple(sorted(out, key=lambda one: (one[1], one[0])))


def told_contacts(scene: Scene, frames: int) -> NDArray[np.bool_] | None:
    """``[T, 2]`` by the scene's contacts of the feet; None where it has none."""
    rows = [contact for contact in scene.contacts if contact.effector.endswith("_foot")]
    if not rows:
        return None
    out = np.zeros((frames, len(FEET)), dtype=bool)
    for contact in rows:
        out[contact.first : contact.last + 1, FEET.index(contact.effector.removesuffix("_foot"))] = True
    return out


def floor_height(supports: Sequence[Support], touches: Sequence[str | None]) -> float:
    """m: of the supports that are said to be the floor, else of the lowest; the most common where they differ."""
    said = [support for support, what in zip(supports, touches, strict=True) if what == FLOOR]
    if not said:
        free = [support for support, what in zip(supports, touches, strict=True) if what is None] or list(supports)
        lowest = min(support.height for support in free)
        said = [support for support in free if support.height < lowest + 0.5 * _STEP]
    lengths = [support.stop - support.start for support in said]
    order = np.argsort([support.height for support in said])
    half = np.cumsum(np.array(lengths)[order]) >= 0.5 * sum(lengths)
    return said[int(order[int(np.argmax(half))])].height


def touched(scene: Scene, supports: Sequence[Support]) -> list[str | None]:
    """What each support is, by the scene's contacts; None where it does not say."""
    out: list[str | None] = []
    for support in supports:
        effector = f"{FEET[support.foot]}_foot"
        shared = {
            c.touches: min(c.last + 1, support.stop) - max(c.first, support.start)
            for c in scene.contacts
            if c.effector == effector and c.first < support.stop and c.last >= support.start
        }
        out.append(max(shared, key=lambda name: shared[name]) if shared else None)
    return out


def matched(
    scene: Scene, supports: Sequence[Support], touches: Sequence[str | None], floor: float, feet: Array
) -> list[str | None]:
    """What each support is on where a scene tells all boxes there are: one of them, or the floor.

    A box is as far away as its upper face from where the foot stood, and as its height from the support's. The floor
    is as far away as the foot's height over it, and as the way out of the boxes that stand there. Where a box has no
    place yet, supports above the floor that are on no other are left open (None): it may be theirs.

    Args:
        scene: with its boxes.
        supports: of the kinematic root.
        touches: of :func:`touched`: what is said stays.
        floor: m, of :func:`floor_height`.
        feet: ``[T, 2, 2]`` m, where the right and the left foot are.
    """
    out: list[str | None] = []
    waits = any(box.place is None for box in scene.boxes)
    for support, said in zip(supports, touches, strict=True):
        height, place = support.height - floor, _place(support, feet)
        away = {FLOOR: abs(height) / _STEP}
        for box in scene.boxes:
            if box.place is not None:
                past = np.abs(_in_box(box, place)) - 0.5 * np.array(box.size)
                off = 0.0 if box.height is None else abs(height - box.height)
                away[box.name] = float(np.linalg.norm(np.maximum(past, 0.0))) / _BESIDE + off / _ALIKE
                away[FLOOR] += max(-float(past.max()), 0.0) / _INSIDE
        nearest = min(away, key=lambda name: away[name])
        out.append(said or (None if waits and nearest == FLOOR and height >= _STEP else nearest))
    return out


def level_heights(supports: Sequence[Support], floor: float, on: Sequence[Level]) -> list[float]:
    """The height (m) of what each support is on, one for the floor and one for each thing.

    Args:
        supports: of the kinematic root.
        floor: m, of :func:`floor_height`.
        on: of :func:`levels`: supports on one thing.
    """
    out = [floor] * len(supports)
    for level in on:
        for k in level.supports:
            out[k] = floor + level.height
    return out


def _in_box(box: Box, place: Array) -> Array:
    """``[2]`` m, in the box's own axes from the middle of its upper face."""
    yaw = box.yaw or 0.0
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    return np.stack([ahead, [-ahead[1], ahead[0]]]) @ (place - np.array(box.place))


def levels(
    supports: Sequence[Support], touches: Sequence[str | None], floor: float, feet: Array, headings: Array
) -> list[Level]:
    """Where supports lie above the floor, by what they are said to be on, else by place and height.

    Args:
        supports: of the kinematic root.
        touches: of :func:`touched`.
        floor: m, of :func:`floor_height`.
        feet: ``[T, 2, 2]`` m, where the right and the left foot are.
        headings: ``[T]`` rad, the body's.
    """
    groups: list[list[int]] = []
    for k, support in enumerate(supports):
        what = touches[k]
        if what == FLOOR or (what is None and support.height < floor + _STEP):
            continue
        home = next((g for g in groups if _same(k, g, supports, touches, feet)), None)
        groups.append([k]) if home is None else home.append(k)
    return [_level(group, supports, touches, floor, feet, headings) for group in groups]


def _same(
    k: int, group: Sequence[int], supports: Sequence[Support], touches: Sequence[str | None], feet: Array
) -> bool:
    if touches[k] is not None or touches[group[0]] is not None:
        return touches[k] == touches[group[0]]
    near = min(float(np.linalg.norm(_place(supports[k], feet) - _place(supports[one], feet))) for one in group)
    return near < _REACH and abs(supports[k].height - float(np.mean([supports[one].height for one in group]))) < _ALIKE


def _place(support: Support, feet: Array) -> Array:
    """``[2]`` m where the foot stood."""
    return np.median(feet[support.start : support.stop, support.foot], axis=0)


def _level(
    group: Sequence[int],
    supports: Sequence[Support],
    touches: Sequence[str | None],
    floor: float,
    feet: Array,
    headings: Array,
) -> Level:
    yaw = float(headings[supports[group[0]].start])
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    axes = np.stack([ahead, [-ahead[1], ahead[0]]])
    spots = np.stack([_place(supports[k], feet) for k in group]) @ axes.T
    low, high = spots.min(axis=0), spots.max(axis=0)
    lengths = [supports[k].stop - supports[k].start for k in group]
    height = float(np.average([supports[k].height for k in group], weights=lengths)) - floor
    size = np.maximum(high - low + 2 * _MARGIN, _LEAST_SIDE)
    return Level(tuple(group), 0.5 * (low + high) @ axes, size, height, yaw, touches[group[0]])


def filled_scene(
    scene: Scene, supports: Sequence[Support], touches: Sequence[str | None], on: Sequence[Level]
) -> Scene:
    """The scene with what it left out: boxes' places, heights and yaws, boxes for other levels, and contacts.

    Levels that the scene does not name take its boxes without a place, in the order in which the body comes to them;
    further levels become boxes of their own. A foot's supports become its contacts where the scene has none.
    """
    boxes, notes = {box.name: box for box in scene.boxes}, list(scene.notes)
    waiting = [box.name for box in scene.boxes if box.place is None and box.name not in touches]
    names: dict[int, str] = {}
    for level in on:
        name = level.box or (waiting.pop(0) if waiting else _new_name(boxes))
        if name not in boxes:
            boxes[name] = Box(name, (_rounded(level.size[0]), _rounded(level.size[1])))
            notes.append(f"{name} is proposed: feet stood {level.height:.2f} m over the floor there")
        boxes[name] = _placed(boxes[name], level, notes)
        names |= dict.fromkeys(level.supports, name)
    contacts = list(scene.contacts)
    if not any(contact.effector.endswith("_foot") for contact in contacts):
        contacts += [
            Contact(f"{FEET[s.foot]}_foot", names.get(k, touches[k] or FLOOR), s.start, s.stop - 1)
            for k, s in enumerate(supports)
        ]
        contacts.sort(key=lambda contact: (contact.first, contact.effector))
    return replace(scene, boxes=tuple(boxes.values()), contacts=tuple(contacts), notes=tuple(dict.fromkeys(notes)))


def _placed(box: Box, level: Level, notes: list[str]) -> Box:
    height = min(max(level.height, 0.0), DEPTH)
    if box.height is None and height != level.height:
        notes.append(f"{box.name}: {level.height:.2f} m by the joints; boxes are 0 to {DEPTH:g} m high")
    if box.height is not None and abs(box.height - level.height) > _STEP:
        notes.append(f"{box.name}: {box.height:.2f} m are given, {level.height:.2f} m are read off the joints")
    place = (_rounded(level.place[0]), _rounded(level.place[1])) if box.place is None else box.place
    return replace(
        box,
        place=place,
        height=_rounded(height) if box.height is None else box.height,
        yaw=_rounded(level.yaw) if box.yaw is None else box.yaw,
    )


def _new_name(taken: dict[str, Box]) -> str:
    return next(name for k in range(1, len(taken) + 2) if (name := f"box{k}") not in taken)


def _rounded(value: float) -> float:
    """To a millimetre: a user reads it."""
    return round(float(value), 3)
