"""ASF and AMC text to numbers, in the files' own units and axes."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.motion.io._files import MAX_JOINTS, check_values, excerpt, numbers_apart, read_text
from egopose.motion.rotations import Array

_MAX_VALUE = 1e7
_INCH = 0.0254


@dataclass(frozen=True)
class AsfBone:
    """A bone as written: unit ``direction [3]`` in the world of the zero pose, ``length`` in the file's unit, the
    ``frame`` its angles act in, and its degrees of freedom (``"rx"`` ... ``"tz"``) in the file's order.
    """

    name: str
    direction: Array
    length: float
    frame: Rotation
    dofs: tuple[str, ...]


@dataclass(frozen=True)
class AsfFile:
    """A skeleton: bones, each one's parent, ``metres`` a unit, and how the root's channels are to be read."""

    bones: dict[str, AsfBone]
    parents: dict[str, str]
    metres: float
    degrees: bool
    root_order: tuple[str, ...]
    root_frame: Rotation
    root_position: Array

    def in_unit(self, metres: float) -> AsfFile:
        """The skeleton with another unit than it says."""
        return replace(self, metres=metres, root_position=self.root_position * (metres / self.metres))


def parse_asf(path: Path, encoding: str = "auto") -> AsfFile:
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    current = ""
    for number, line in enumerate(read_text(path, encoding=encoding).split("\n"), 1):
        if len(line) > 4096:
            raise InputError(path, f"line {number}", f"{len(line)} characters long: not a line of a skeleton")
        words = line.split("#")[0].replace("(", " ").replace(")", " ").split()
        if not words:
            continue
        if words[0].startswith(":"):
            current = words[0][1:].lower()
            sections.setdefault(current, [])
            words = words[1:]
        if words and current:
            sections[current].append((number, words))
    for name in ("root", "bonedata", "hierarchy"):
        if not sections.get(name):
            raise InputError(path, f":{name}", "this section is missing or empty: not a whole ASF file")
    metres, degrees = _parse_units(path, sections.get("units", []))
    bones = _parse_bones(path, sections["bonedata"], degrees)
    order, frame, position = _parse_root(path, sections["root"], degrees)
    return AsfFile(
        bones, _parse_hierarchy(path, sections["hierarchy"], bones), metres, degrees, order, frame, position * metres
    )


def _parse_units(path: Path, lines: list[tuple[int, list[str]]]) -> tuple[float, bool]:
    metres, degrees = _INCH, True
    for number, words in lines:
        if words[0].lower() == "length":
            length = _floats(path, number, words[1:], 1)[0]
            if not 1e-6 < length < 1e6:
                raise InputError(path, f"line {number}", f"length {length:g} is not a usable unit")
            metres = _INCH / length
        elif words[0].lower() == "angle":
            degrees = not (len(words) > 1 and words[1].lower().startswith("rad"))
    return metres, degrees


def _parse_bones(path: Path, lines: list[tuple[int, list[str]]], degrees: bool) -> dict[str, AsfBone]:
    bones: dict[str, AsfBone] = {}
    fields: dict[str, tuple[int, list[str]]] | None = None
    for number, words in lines:
        key = words[0].lower()
        if key == "begin":
            if fields is not None:
                raise InputError(path, f"line {number}", "begin inside a bone: an end is missing")
            fields = {}
        elif key == "end":
            if fields is None:
                raise InputError(path, f"line {number}", "end without a begin")
            bone = _bone(path, number, fields, degrees)
            if bone.name in bones or bone.name == "root":
                raise InputError(path, f"line {number}", f"bone {excerpt(bone.name)} stands twice")
            if len(bones) >= MAX_JOINTS:
                raise InputError(path, f"line {number}", f"more than {MAX_JOINTS} bones")
            bones[bone.name], fields = bone, None
        elif fields is not None and re.match(r"[a-z]", key):
            fields[key] = (number, words[1:])
    if fields is not None:
        raise InputError(path, f"line {lines[-1][0]}", "the last bone has no end: cut short")
    if not bones:
        raise InputError(path, ":bonedata", "no bones")
    return bones


def _bone(path: Path, number: int, fields: dict[str, tuple[int, list[str]]], degrees: bool) -> AsfBone:
    for key in ("name", "direction", "length"):
        if key not in fields or not fields[key][1]:
            raise InputError(path, f"line {number}", f"a bone without {key}")
    name = fields["name"][1][0]
    direction = _floats(path, *fields["direction"], 3)
    norm = float(np.linalg.norm(direction))
    length = float(_floats(path, *fields["length"], 1)[0])
    if length < 0 or (length > 0 and norm == 0):
        raise InputError(
            path, f"line {number}", f"bone {excerpt(name)} has length {length:g} and direction {direction}"
        )
    dof_line, dofs = fields.get("dof", (number, []))
    lowered = tuple(d.lower() for d in dofs)
    if any(not re.fullmatch("[tr][xyz]", d) for d in lowered) or len(set(lowered)) != len(lowered):
        raise InputError(path, f"line {dof_line}", f"dof {excerpt(' '.join(dofs))}: want rx ry rz tx ty tz, each once")
    frame = _axis_frame(path, *fields["axis"], degrees) if "axis" in fields else Rotation.identity()
    return AsfBone(name, direction / norm if norm else direction, length, frame, lowered)


def _parse_root(
    path: Path, lines: list[tuple[int, list[str]]], degrees: bool
) -> tuple[tuple[str, ...], Rotation, Array]:
    order: tuple[str, ...] = ("tx", "ty", "tz", "rx", "ry", "rz")
    axis, number_axis = "XYZ", lines[0][0]
    position, orientation = np.zeros(3), ["0", "0", "0"]
    for number, words in lines:
        key = words[0].lower()
        if key == "order":
            order = tuple(w.lower() for w in words[1:])
            if any(not re.fullmatch("[tr][xyz]", o) for o in order) or len(set(order)) != len(order) or not order:
                raise InputError(
                    path, f"line {number}", f"root order {excerpt(' '.join(words[1:]))}: want TX TY TZ RX RY RZ"
                )
        elif key == "axis":
            axis, number_axis = "".join(words[1:]), number
        elif key == "position":
            position = _floats(path, number, words[1:], 3)
        elif key == "orientation":
            orientation = words[1:]
    return order, _axis_frame(path, number_axis, [*orientation, axis], degrees), position


def _axis_frame(path: Path, number: int, words: list[str], degrees: bool) -> Rotation:
    """C of ``axis a b c XYZ``: turns about fixed axes in the order named."""
    angles = _floats(path, number, words[:3], 3)
    order = (words[3] if len(words) > 3 else "XYZ").lower()
    if sorted(order) != ["x", "y", "z"]:
        raise InputError(path, f"line {number}", f"axis order {excerpt(order)} is not three different axes")
    return Rotation.from_euler(order, angles, degrees=degrees)


def _parse_hierarchy(path: Path, lines: list[tuple[int, list[str]]], bones: dict[str, AsfBone]) -> dict[str, str]:
    parents: dict[str, str] = {}
    for number, words in lines:
        if words[0].lower() in ("begin", "end"):
            continue
        for name in words:
            if name != "root" and name not in bones:
                raise InputError(path, f"line {number}", f"bone {excerpt(name)} is not among the bone data")
        for child in words[1:]:
            if child in parents or child == "root":
                raise InputError(path, f"line {number}", f"bone {excerpt(child)} has two parents")
            parents[child] = words[0]
    if not parents:
        raise InputError(path, ":hierarchy", "no bones hang on the root")
    return parents


def parse_amc(path: Path, asf: AsfFile, encoding: str = "auto") -> tuple[Array, dict[str, int], bool]:
    """Frames ``[T, C]`` (root first, then bones with degrees of freedom), each bone's first column, degrees or not.

    Frames are numbered from any number on: a piece of a longer recording keeps its own.
    """
    moving = [asf.bones[name] for name in asf.parents if asf.bones[name].dofs]
    columns, width = {"root": 0}, len(asf.root_order)
    counts = {"root": width}
    for bone in moving:
        columns[bone.name], counts[bone.name] = width, len(bone.dofs)
        width += len(bone.dofs)
    rows: list[Array] = []
    degrees, row, seen, number, first = asf.degrees, np.empty(0), set(counts), 0, 1

    def finish() -> None:
        if seen != set(counts):
            missing = sorted(set(counts) - seen)[0]
            raise InputError(path, f"line {number}", f"frame {len(rows)} lacks bone {excerpt(missing)}: cut short")

    for number, line in enumerate(read_text(path, encoding=encoding).split("\n"), 1):
        if len(line) > 4096:
            raise InputError(path, f"line {number}", f"{len(line)} characters long: not a line of motion")
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(words[0].lower(), degrees)
        elif len(words) == 1 and words[0].isdigit():
            finish()
            if not rows and len(words[0]) <= 9:
                first = int(words[0])
            expected = first + len(rows)
            if len(words[0]) > 9 or int(words[0]) != expected:
                raise InputError(path, f"line {number}", f"frame {excerpt(words[0])} where {expected} should be")
            check_values(path, f"line {number}", len(rows) + 1, width + 12)
            row, seen = np.zeros(width), set()
            rows.append(row)
        elif words[0] in counts:
            if not rows or words[0] in seen:
                cause = "bone before the first frame" if not rows else f"bone {words[0]!r} twice in frame {len(rows)}"
                raise InputError(path, f"line {number}", cause)
            at, count = columns[words[0]], counts[words[0]]
            row[at : at + count] = _floats(path, number, words[1:], count)
            seen.add(words[0])
        else:
            raise InputError(path, f"line {number}", f"{excerpt(words[0])} is no moving bone of the skeleton")
    if not rows:
        raise InputError(path, f"line {number}", "no frames")
    finish()
    return np.stack(rows), columns, degrees


def _floats(path: Path, number: int, words: list[str], count: int) -> Array:
    if len(words) < count:
        words = numbers_apart(" ".join(words), count)
    try:
        values = np.array([float(w) for w in words])
    except ValueError:
        raise InputError(path, f"line {number}", f"{excerpt(' '.join(words))} are not numbers") from None
    if len(values) != count:
        raise InputError(path, f"line {number}", f"{count} numbers wanted, {len(values)} found")
    if not (np.abs(values) < _MAX_VALUE).all():
        raise InputError(path, f"line {number}", f"{excerpt(' '.join(words))}: not finite or absurdly large")
    return values
