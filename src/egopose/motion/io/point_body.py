"""A skeleton fitted to points: joint centres of a marker file without orientations become a :class:`Motion`.

Bones take their median length over the clip. The pelvis lies along the hip joints, the chest along trunk and
shoulders; thighs and arms are turned so that knee and elbow bend about one axis of theirs. What points leave open
(the twist of a straight arm) follows the moments around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io.body_unit import STATURE_RANGE
from egopose.motion.io.frames import UNITS, UP_AXES, up_rotation
from egopose.motion.io.point_frames import bend_axis, carried, frame
from egopose.motion.io.point_names import find_parts
from egopose.motion.io.segments import (
    ARM_AXES,
    ELBOW_AXES,
    KNEE_AXES,
    LEG_AXES,
    TRUNK_AXES,
    Segment,
    Vector,
    median_bone,
    skeleton_of,
)
from egopose.motion.mapping import SIDES
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: The most numbers of points that are read: 40 points for twenty minutes at 120 frames/s. Fitting holds ten copies.
_MAX_NUMBERS = 2**24

#: A point that is missing in more of the frames than this share is not used.
_MISSING = 0.5
#: Stature over the way from ankle to neck.
_STATURE_PER_PATH = 1.22
#: The line from the ears to the nose falls by about this angle while the head looks straight ahead, rad.
_NOSE_DROP = np.deg2rad(15.0)
#: The floor is taken to be at zero where the lowest point of the clip lies this near it, m.
_FLOOR = 0.3


def check_points(path: Path, field: str, frames: int, count: int) -> None:
    """Raises InputError where a file holds more than can be fitted."""
    if 3 * frames * count > _MAX_NUMBERS:
        cause = f"{frames} frames of {count} points; at most {_MAX_NUMBERS} numbers are read: cut the motion into parts"
        raise InputError(path, field, cause)


def motion_of_points(
    path: Path,
    names: Sequence[str],
    points: Array,
    fps: float,
    *,
    declared_unit: str,
    declared_up: str,
    unit: str | None,
    up: str | None,
    given: Mapping[str, str | Sequence[str]] | None,
    meta: dict[str, Any],
) -> Motion:
    """Fit a skeleton.

    Args:
        path: of the file, for errors.
        names: of the points.
        points: ``[T, P, 3]`` in the file's unit and axes; a gap is NaN, or zero in all three numbers.
        fps: frames per second.
        declared_unit, declared_up: what the file says of itself or its format's custom.
        unit, up: what the user says; None believes the file's unit, and looks for the up axis in the motion.
        given: part of the body -> names of points, see :func:`point_names.find_parts`.
        meta: of the motion, added to: ``notes`` says where gaps were filled, ``unused_points`` are names that play no
            part, ``fit_mm`` is how far joints of constant bones lie from the points on average.

    Raises:
        InputError: parts missing, a unit that makes no person, points that coincide.
    """
    if up is not None and up not in UP_AXES:
        raise InputError(path, "option up", f"{up!r:.40} is none of {', '.join(UP_AXES)}")
    if unit is not None and unit not in UNITS:
        raise InputError(path, "option unit", f"{unit!r:.40} is none of {', '.join(UNITS)}")
    columns = find_parts(path, names, given)
    metres = UNITS[unit or declared_unit]
    scaled = np.where((points == 0.0).all(axis=2, keepdims=True), np.nan, points) * metres
    for side in SIDES:
        if f"{side}_toe" in set(columns) - set(given or ()):
            columns[f"{side}_toe"] = _furthest(scaled, columns[f"{side}_toe"], columns[f"{side}_ankle"])
    parts, filled = _filled(path, {part: scaled[:, k].mean(axis=1) for part, k in columns.items()})
    _check_size(path, parts, unit or declared_unit)
    axis = up or _up_axis(parts, declared_up)
    turn = up_rotation(axis)
    body = _Body({part: rot.rotate(turn, p) for part, p in parts.items()}, fps)
    skeleton, qpos, left = body.skeleton()
    used = {column for k in columns.values() for column in k}
    if filled:
        gaps = ", ".join(f"{part} in {count}" for part, count in sorted(filled.items(), key=lambda item: -item[1])[:8])
        more = f" and {len(filled) - 8} parts more" if len(filled) > 8 else ""
        note = f"gaps were filled by interpolation: {gaps}{more} of {len(points)} frames"
        meta = {**meta, "notes": [*meta.get("notes", ()), note]}
    meta = {
        **meta,
        "source": path.name,
        "unit": unit or declared_unit,
        "unit_metres": metres,
        "up": axis,
        "unused_points": [name for k, name in enumerate(names) if k not in used][:200],
        "fit_mm": round(1000 * left, 3),
    }
    return Motion(skeleton, qpos, fps, name=path.stem, meta=meta)


def _furthest(points: Array, columns: list[int], ankle: list[int]) -> list[int]:
    """Of a sole's corners the front ones: those that lie furthest from the ankle."""
    if len(columns) < 2:
        return columns
    away = np.linalg.norm(points[:, columns] - points[:, ankle].mean(axis=1)[:, None], axis=2)
    reach = np.nanmedian(np.where(np.isfinite(away).any(axis=0), away, 0.0), axis=0)
    return [c for c, r in zip(columns, reach, strict=True) if r >= 0.9 * reach.max()]


def _filled(path: Path, parts: dict[str, Array]) -> tuple[dict[str, Array], dict[str, int]]:
    """Gaps interpolated in time, held at the ends; and the number of frames of each part that had none."""
    out, filled = {}, {}
    for part, values in parts.items():
        seen = np.isfinite(values).all(axis=1)
        missing = int((~seen).sum())
        if missing > _MISSING * len(values):
            if part.partition("_")[2] in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"):
                cause = f"seen in {len(values) - missing} of {len(values)} frames: too few to fill the gaps"
                raise InputError(path, f"points.{part}", cause)
            continue
        frames = np.arange(len(values))
        if missing:
            filled[part] = missing
            values = np.stack([np.interp(frames, frames[seen], v[seen]) for v in values.T], axis=1)
        out[part] = values
    return out, filled


def _check_size(path: Path, parts: dict[str, Array], unit: str) -> None:
    def length(a: str, b: str) -> float:
        return float(np.median(np.linalg.norm(parts[a] - parts[b], axis=1)))

    for side in SIDES:
        for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
            if length(f"{side}_{a}", f"{side}_{b}") < 1e-6:
                raise InputError(path, "points", f"{side}_{a} and {side}_{b} lie in one place: no body")
    for part in ("hip", "shoulder"):
        if length(f"left_{part}", f"right_{part}") < 1e-6:
            raise InputError(path, "points", f"left_{part} and right_{part} lie in one place: no body")
    legs = [length(f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    trunk = np.linalg.norm(_neck(parts) - _middle(parts, "hip"), axis=1)
    height = _STATURE_PER_PATH * (sum(legs) / 2 + float(np.median(trunk)))
    low, high = STATURE_RANGE
    if not low <= height <= high:
        cause = f"in {unit} the person would be {height:.3g} m tall; say what the numbers are, such as unit=mm"
        raise InputError(path, "unit", cause)


def _up_axis(parts: dict[str, Array], declared: str) -> str:
    """The axis that neck and hips are above the feet along, on average; the declared one unless another clearly wins.

    Upside down against the declared axis the file is believed if its floor is at zero: that is a handstand.
    """
    body = (_neck(parts) + _middle(parts, "hip")) / 2 - _middle(parts, "ankle")
    toward = body.mean(axis=0)
    k = "xyz".index(declared[-1])
    sign = -1.0 if declared.startswith("-") else 1.0
    axis = int(np.argmax(np.abs(toward)))
    size = float(np.median(np.linalg.norm(body, axis=1)))
    if abs(toward[axis]) < max(2.0 * abs(toward[k]) if axis != k else 0.0, 0.35 * size):
        return declared
    found = ("-" if toward[axis] < 0 else "") + "xyz"[axis]
    lowest = min(float((sign * p[:, k]).min()) for p in parts.values())
    if axis == k and found != declared and abs(lowest) < _FLOOR:
        return declared
    return found


def _middle(parts: dict[str, Array], part: str) -> Array:
    return (parts[f"left_{part}"] + parts[f"right_{part}"]) / 2


def _neck(parts: dict[str, Array]) -> Array:
    return parts["neck"] if "neck" in parts else _middle(parts, "shoulder")


class _Body:
    """Segments put together from the trunk outwards; ``parts`` are world points ``[T, 3]``, z up, metres."""

    def __init__(self, parts: dict[str, Array], fps: float) -> None:
        self._parts, self._fps = parts, fps
        self._segments: list[Segment] = []
        self._places: list[Array] = []
        self._frames: dict[str, Array] = {}
        self._trunk()
        self._head()
        for side in SIDES:
            self._arm(side)
            self._leg(side)

    def skeleton(self) -> tuple[Any, Array, float]:
        quats = np.stack([self._frames[s.name] for s in self._segments], axis=1)
        return skeleton_of(self._segments, np.stack(self._places, axis=1), quats, "points")

    def _add(self, name: str, parent: str, axes: str, place: Array, quats: Array, tip: Array | None = None) -> None:
        tips: tuple[Vector, ...] = ()
        if tip is not None:
            x, y, z = median_bone(rot.rotate(rot.conjugate(quats), tip - place)).tolist()
            tips = ((x, y, z),)
        self._segments.append(Segment(name, parent, axes, tips))
        self._places.append(place)
        self._frames[name] = quats

    def _across(self, part: str) -> Array:
        return self._parts[f"left_{part}"] - self._parts[f"right_{part}"]

    def _trunk(self) -> None:
        middle = _middle(self._parts, "hip")
        trunk = _neck(self._parts) - middle
        self._add("Hips", "", TRUNK_AXES, middle, frame(("y", self._across("hip")), ("z", trunk)))
        self._add("Spine", "Hips", TRUNK_AXES, middle, frame(("z", trunk), ("y", self._across("shoulder"))))

    def _head(self) -> None:
        """Neck and head; where only the crown or the face is known, one joint carries both."""
        p, neck, chest = self._parts, _neck(self._parts), self._frames["Spine"]
        base, crown = p.get("head"), p.get("crown")
        if base is not None and crown is None and "nose" in p:
            base, crown = None, base  # beside a nose, networks' "Head" is the top of the head
        if base is None and {"left_ear", "right_ear"} <= set(p):
            base = _middle(p, "ear")
        above = crown if crown is not None else base
        bone = above - (base if crown is not None and base is not None else neck) if above is not None else None
        turned = self._face(chest if bone is None else carried(chest, "z", bone), bone)
        if base is None:
            self._add("Neck", "Spine", TRUNK_AXES, neck, turned, crown)
            return
        self._add("Neck", "Spine", TRUNK_AXES, neck, _hanging_as_usual(chest, base - neck))
        self._add("Head", "Neck", TRUNK_AXES, base, turned, crown)

    def _face(self, plain: Array, up: Array | None) -> Array:
        """The head's frame from ears or eyes and nose, so far as they are there; ``plain`` looks as the chest does."""
        p = self._parts
        pair = next((k for k in ("ear", "eye") if {f"left_{k}", f"right_{k}"} <= set(p)), None)
        if pair == "ear" and "nose" in p:
            level = frame(("y", self._across("ear")), ("x", p["nose"] - _middle(p, "ear")))
            raised = rot.from_axis_angle(np.array([0.0, 1.0, 0.0]), np.array(-_NOSE_DROP))
            return rot.multiply(level, raised[None])
        if up is None:
            return plain
        if pair is not None:
            return frame(("z", up), ("y", self._across(pair)))
        if "nose" in p:
            return frame(("z", up), ("x", p["nose"] - _neck(p)))
        return plain

    def _arm(self, side: str) -> None:
        p, name, chest = self._parts, side.capitalize(), self._frames["Spine"]
        out, palm = ("y", "-z") if side == "left" else ("-y", "z")
        neck = _neck(p)
        shoulder, elbow, wrist = (p[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist"))
        self._add(f"{name}Shoulder", "Spine", ARM_AXES, neck, _hanging_as_usual(chest, shoulder - neck))
        upper, lower = elbow - shoulder, wrist - elbow
        hanging = _axis_of(carried(chest, out, upper), palm)
        axis = bend_axis(chest, hanging, upper, lower, self._fps, one_way=False)
        self._add(f"{name}Arm", f"{name}Shoulder", ARM_AXES, shoulder, frame((out, upper), (palm, axis)))
        forearm = frame((out, lower), (palm, axis))
        self._add(f"{name}ForeArm", f"{name}Arm", ELBOW_AXES, elbow, forearm)
        fingers = [p[f"{side}_{part}"] for part in ("index", "pinky") if f"{side}_{part}" in p]
        tip: Array | None = np.stack(fingers).mean(axis=0) if fingers else p.get(f"{side}_hand_tip")
        hand = forearm
        if tip is not None:
            hand = carried(forearm, out, tip - wrist)
            if len(fingers) == 2:
                hand = frame((out, tip - wrist), ("x", fingers[0] - fingers[1]))
        self._add(f"{name}Hand", f"{name}ForeArm", ARM_AXES, wrist, hand, tip)

    def _leg(self, side: str) -> None:
        p, name, pelvis = self._parts, side.capitalize(), self._frames["Hips"]
        hip, knee, ankle = (p[f"{side}_{part}"] for part in ("hip", "knee", "ankle"))
        upper, lower = knee - hip, ankle - knee
        hanging = _axis_of(carried(pelvis, "-z", upper), "y")
        axis = bend_axis(pelvis, hanging, upper, lower, self._fps, one_way=True)
        self._add(f"{name}UpLeg", "Hips", LEG_AXES, hip, frame(("-z", upper), ("y", axis)))
        shank = frame(("-z", lower), ("y", axis))
        self._add(f"{name}Leg", f"{name}UpLeg", KNEE_AXES, knee, shank)
        big, small = p.get(f"{side}_toe"), p.get(f"{side}_small_toe")
        toe = big if small is None else small if big is None else (big + small) / 2
        foot = shank
        if toe is not None:
            across = axis
            if big is not None and small is not None:
                across = small - big if side == "left" else big - small
            foot = frame(("x", toe - p.get(f"{side}_heel", ankle)), ("y", across))
        self._add(f"{name}Foot", f"{name}Leg", LEG_AXES, ankle, foot, toe)


def _hanging_as_usual(parent: Array, bone: Array) -> Array:
    """Frames ``[T, 4]`` that are the parent's where the bone lies in it as it does on average."""
    return carried(parent, median_bone(rot.rotate(rot.conjugate(parent), bone)), bone)


def _axis_of(quats: Array, axis: str) -> Array:
    """World direction ``[T, 3]`` of an axis (``"-z"``) of frames ``[T, 4]``."""
    vector = np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
    return rot.rotate(quats, np.broadcast_to(vector, (len(quats), 3)))
