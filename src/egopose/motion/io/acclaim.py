"""Acclaim: a skeleton (ASF) and its motion (AMC), as CMU's mocap library has them.

A bone's angles act in its own axis frame C: local rotation = C Rz Ry Rx C^-1 for ``dof rx ry rz``. Turning the hinge
axes into C e_k says the same, so a value of the file is a coordinate of qpos (of equal triples of angles the continuous
one). A bone starts where its parent ends; its joint stands at the start.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io._files import MAX_JOINTS, excerpt, read_text
from egopose.motion.io.frames import continuous_euler, up_rotation
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Dof, Joint, Skeleton

_MAX_VALUE = 1e7
_INCH = 0.0254


@dataclass(frozen=True)
class _Bone:
    name: str
    direction: Array
    length: float
    frame: Rotation
    dofs: tuple[str, ...]


@dataclass(frozen=True)
class _Asf:
    bones: dict[str, _Bone]
    parents: dict[str, str]
    metres: float
    degrees: bool
    root_order: tuple[str, ...]
    root_frame: Rotation
    root_position: Array


def read_amc(path: str | Path, *, asf: str | Path | None = None, fps: float = 120.0) -> Motion:
    """Read an AMC file and the ASF skeleton it belongs to.

    Args:
        path: the ``.amc`` file.
        asf: the skeleton; by default the ``.asf`` beside it called like the file or like the part of its name before
            the first ``_`` (``05_06.amc``: ``05.asf``), or the only ``.asf`` there.
        fps: the format does not say; CMU recorded at 120.

    Returns:
        z up, metres. Names of joints are the bones'; ``root`` comes first.

    Raises:
        InputError: names the file, line and cause.
    """
    path = Path(path)
    if not (np.isfinite(fps) and 0 < fps <= 1e5):
        raise InputError(path, "option fps", f"{fps} is not a frame rate")
    asf_path = _find_asf(path) if asf is None else Path(asf)
    skeleton_file = _parse_asf(asf_path)
    frames, columns, degrees = _parse_amc(path, skeleton_file)
    skeleton, dof_columns = _skeleton(asf_path, skeleton_file, columns)

    scale = np.pi / 180.0 if degrees else 1.0
    root = frames[:, : len(skeleton_file.root_order)]
    position, quat = _root_pose(skeleton_file, root, scale)
    factors = np.array([skeleton_file.metres if is_length else scale for _, is_length in dof_columns])
    values = frames[:, [column for column, _ in dof_columns]] * factors
    for joint, columns_of_joint in zip(skeleton.joints, skeleton.dof_slices, strict=True):
        if [d.kind for d in joint.dofs] == ["hinge"] * 3:
            values[:, columns_of_joint] = continuous_euler(values[:, columns_of_joint])
    qpos = np.concatenate([position, rot.continuous(quat), values], axis=1)
    meta = {
        "format": "amc",
        "source": path.name,
        "skeleton": asf_path.name,
        "unit": "asf",
        "unit_metres": skeleton_file.metres,
        "up": "y",
    }
    return Motion(skeleton, qpos, float(fps), name=path.stem, meta=meta)


def _find_asf(path: Path) -> Path:
    there = sorted(p for p in path.parent.glob("*") if p.suffix.lower() == ".asf") if path.parent.is_dir() else []
    for stem in (path.stem, path.stem.split("_")[0]):
        for candidate in there:
            if candidate.stem.lower() == stem.lower():
                return candidate
    if len(there) == 1:
        return there[0]
    if not path.is_file():
        raise InputError(path, "path", "no such file")
    found = f"{len(there)} others are there" if there else "none is there"
    raise InputError(path, "option asf", f"no skeleton {path.stem.split('_')[0]}.asf beside it ({found}); name one")


def _root_pose(asf: _Asf, values: Array, scale: float) -> tuple[Array, Array]:
    position = np.tile(asf.root_position, (len(values), 1))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(values), 1))
    frame = rot.from_scipy(asf.root_frame, ())
    for k, name in enumerate(asf.root_order):
        axis = "xyz".index(name[1])
        if name[0] == "t":
            position[:, axis] += values[:, k] * asf.metres
        else:  # the first angle listed turns last, about axes that stay
            quat = rot.multiply(rot.from_axis_angle(np.eye(3)[axis], values[:, k] * scale), quat)
    quat = rot.multiply(rot.multiply(frame, quat), rot.conjugate(frame))
    to_z_up = up_rotation("y")
    return rot.rotate(to_z_up, position), rot.multiply(to_z_up, quat)


def _skeleton(path: Path, asf: _Asf, columns: dict[str, int]) -> tuple[Skeleton, list[tuple[int, bool]]]:
    """The skeleton, and for each degree of freedom its column in the AMC and whether it is a length."""
    joints = [Joint("root", -1, (0.0, 0.0, 0.0))]
    index = {"root": 0}
    dof_columns: list[tuple[int, bool]] = []
    waiting = [name for name in asf.parents if asf.parents[name] == "root"]
    carriers = set(asf.parents.values())
    while waiting:
        bone = asf.bones[waiting.pop(0)]
        parent = asf.parents[bone.name]
        start = np.zeros(3) if parent == "root" else asf.bones[parent].direction * asf.bones[parent].length * asf.metres
        end = bone.direction * bone.length * asf.metres
        dofs: list[Dof] = []
        # Lengthening degrees of freedom (l) belong to the bone's end, translations to its start; both are rare.
        for kind in ("t", "r"):
            for k in reversed([k for k, d in enumerate(bone.dofs) if d[0] == kind]):
                axis = bone.frame.as_matrix()[:, "xyz".index(bone.dofs[k][1])]
                dofs.append(Dof("slide" if kind == "t" else "hinge", (float(axis[0]), float(axis[1]), float(axis[2]))))
                dof_columns.append((columns[bone.name] + k, kind == "t"))
        tips = () if bone.name in carriers else ((float(end[0]), float(end[1]), float(end[2])),)
        offset = (float(start[0]), float(start[1]), float(start[2]))
        index[bone.name] = len(joints)
        joints.append(Joint(bone.name, index[parent], offset, tuple(dofs), tips))
        children = [name for name in asf.parents if asf.parents[name] == bone.name]
        waiting = children + waiting
    lost = sorted(set(asf.parents) - set(index))
    if lost:
        raise InputError(path, ":hierarchy", f"bone {excerpt(lost[0])} hangs on no chain from the root")
    return Skeleton(tuple(joints)), dof_columns


def _parse_asf(path: Path) -> _Asf:
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    current = ""
    for number, line in enumerate(read_text(path).split("\n"), 1):
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
    return _Asf(
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


def _parse_bones(path: Path, lines: list[tuple[int, list[str]]], degrees: bool) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
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


def _bone(path: Path, number: int, fields: dict[str, tuple[int, list[str]]], degrees: bool) -> _Bone:
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
    if any(not re.fullmatch("[tr][xyz]|l", d) for d in lowered) or len(set(lowered)) != len(lowered):
        raise InputError(
            path, f"line {dof_line}", f"dof {excerpt(' '.join(dofs))}: want rx ry rz tx ty tz l, each once"
        )
    frame = _axis_frame(path, *fields["axis"], degrees) if "axis" in fields else Rotation.identity()
    return _Bone(name, direction / norm if norm else direction, length, frame, lowered)


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


def _parse_hierarchy(path: Path, lines: list[tuple[int, list[str]]], bones: dict[str, _Bone]) -> dict[str, str]:
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


def _parse_amc(path: Path, asf: _Asf) -> tuple[Array, dict[str, int], bool]:
    """Frames ``[T, C]`` (root first, then bones with degrees of freedom), each bone's first column, degrees or not."""
    moving = [asf.bones[name] for name in asf.parents if asf.bones[name].dofs]
    columns, width = {"root": 0}, len(asf.root_order)
    counts = {"root": width}
    for bone in moving:
        columns[bone.name], counts[bone.name] = width, len(bone.dofs)
        width += len(bone.dofs)
    rows: list[Array] = []
    degrees, row, seen, number = asf.degrees, np.empty(0), set(counts), 0

    def finish() -> None:
        if seen != set(counts):
            missing = sorted(set(counts) - seen)[0]
            raise InputError(path, f"line {number}", f"frame {len(rows)} lacks bone {excerpt(missing)}: cut short")

    for number, line in enumerate(read_text(path).split("\n"), 1):
        if len(line) > 4096:
            raise InputError(path, f"line {number}", f"{len(line)} characters long: not a line of motion")
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(words[0].lower(), degrees)
        elif len(words) == 1 and words[0].isdigit():
            finish()
            if len(words[0]) > 9 or int(words[0]) != len(rows) + 1:
                raise InputError(path, f"line {number}", f"frame {excerpt(words[0])} where {len(rows) + 1} should be")
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
    try:
        values = np.array([float(w) for w in words])
    except ValueError:
        raise InputError(path, f"line {number}", f"{excerpt(' '.join(words))} are not numbers") from None
    if len(values) != count:
        raise InputError(path, f"line {number}", f"{count} numbers wanted, {len(values)} found")
    if not (np.abs(values) < _MAX_VALUE).all():
        raise InputError(path, f"line {number}", f"{excerpt(' '.join(words))}: not finite or absurdly large")
    return values
