"""Acclaim: a skeleton (ASF) and its motion (AMC), as CMU's mocap library has them.

A bone's angles act in its own axis frame C: local rotation = C Rz Ry Rx C^-1 for ``dof rx ry rz``. Turning the hinge
axes into C e_k says the same, so a value of the file is a coordinate of qpos (of equal triples of angles the continuous
one). A bone starts where its parent ends; its joint stands at the start.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io._files import excerpt
from egopose.motion.io.acclaim_syntax import AsfFile, parse_amc, parse_asf
from egopose.motion.io.body_size import stature
from egopose.motion.io.body_unit import STATURE_RANGE, guess_unit
from egopose.motion.io.frames import continuous_euler, given_rate, given_unit, given_up, up_rotation
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Dof, Joint, Skeleton


def read_amc(
    path: str | Path,
    *,
    asf: str | Path | None = None,
    fps: float = 120.0,
    unit: str | float = "auto",
    up: str = "auto",
    encoding: str = "auto",
) -> Motion:
    """Read an AMC file and the ASF skeleton it belongs to.

    Args:
        path: the ``.amc`` file.
        asf: the skeleton; by default the ``.asf`` beside it called like the file or like the part of its name before
            the first ``_`` (``05_06.amc``: ``05.asf``), or the only ``.asf`` there.
        fps: the format does not say; CMU recorded at 120.
        unit: of lengths, see :func:`egopose.motion.io.bvh.read_bvh`; ``"auto"``: what the skeleton says.
        up: the files' up axis; ``"auto"``: y, as the format has it.
        encoding: of both texts, see :func:`egopose.motion.io._files.read_text`.

    Returns:
        z up, metres. Names of joints are the bones'; ``root`` comes first.

    Raises:
        InputError: names the file, line and cause.
    """
    path = Path(path)
    rate, given = given_rate(path, fps), given_unit(path, unit)
    up = "y" if given_up(path, up) == "auto" else up
    asf_path = _find_asf(path) if asf is None else Path(asf)
    skeleton_file = parse_asf(asf_path, encoding)
    frames, columns, degrees = parse_amc(path, skeleton_file, encoding)
    skeleton, dof_columns = _skeleton(asf_path, skeleton_file, columns)
    notes: list[str] = []
    given = given or _other_unit(skeleton_file, skeleton, notes)
    if given is not None:
        skeleton_file = skeleton_file.in_unit(given[1])
        skeleton, dof_columns = _skeleton(asf_path, skeleton_file, columns)

    scale = np.pi / 180.0 if degrees else 1.0
    root = frames[:, : len(skeleton_file.root_order)]
    position, quat = _root_pose(skeleton_file, root, scale, up_rotation(up))
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
        "unit": "asf" if given is None else given[0],
        "unit_metres": skeleton_file.metres,
        "up": up,
        "notes": notes,
    }
    return Motion(skeleton, qpos, rate, name=path.stem, meta=meta)


def _other_unit(asf: AsfFile, skeleton: Skeleton, notes: list[str]) -> tuple[str, float] | None:
    """The likeliest unit where the one that the skeleton states makes it no person's; else None."""
    height = stature(skeleton, forward_kinematics(skeleton, skeleton.rest_qpos()[None])[0])
    low, high = STATURE_RANGE
    if low <= height <= high:
        return None
    guess = guess_unit(height / asf.metres, np.zeros((1, 3)), 1.0)
    if guess is None:
        return None
    notes.append(
        f"the skeleton states a unit that makes it {height:.2f} m tall; {guess.name} is taken: "
        f"{height / asf.metres * guess.metres:.2f} m; reader.unit says otherwise"
    )
    return guess.name, guess.metres


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
    result = f"{len(there)} others are there" if there else "none is there"
    raise InputError(path, "option asf", f"no skeleton {path.stem.split('_')[0]}.asf beside it ({result}); name one")


def _root_pose(asf: AsfFile, values: Array, scale: float, to_z_up: Array) -> tuple[Array, Array]:
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
    return rot.rotate(to_z_up, position), rot.multiply(to_z_up, quat)


def _skeleton(path: Path, asf: AsfFile, columns: dict[str, int]) -> tuple[Skeleton, list[tuple[int, bool]]]:
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
