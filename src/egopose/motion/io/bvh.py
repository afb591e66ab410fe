"""BVH: any skeleton, any channel order, 3 or 6 channels a joint, any up axis and unit.

A joint's rotation channels become hinges in the file's order; of equal triples of angles the continuous ones are taken.
Position channels replace the joint's OFFSET, as most exporters mean them, or are added to it, as the values say; where
they stay constant they become the offset, else slides before the hinges. Some files give the places of joints in the
world there, as the values say too: they are turned into the parent's axes.
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io.body_size import guess_up, named, stature
from egopose.motion.io.body_unit import STATURE_RANGE, guess_unit
from egopose.motion.io.bvh_syntax import BvhFile, BvhJoint, parse_bvh
from egopose.motion.io.frames import (
    continuous_euler,
    frame_rate,
    given_rate,
    given_unit,
    given_up,
    up_rotation,
)
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Joint, Skeleton, hinges, slides

#: Translations that stay within this of their middle (m) are a bone's length, not a movement.
_STILL = 5e-5
_GUESS_FRAMES = 60

#: Share of the misfit that is left where positions are added to OFFSET; bones that stretch leave a twentieth.
_CLEARLY = 0.2

#: m; what a unit that was asked for may make of a body: puppets and giants too, but not what is a wrong unit.
_ANY_STATURE = (0.1, 20.0)


def read_bvh(
    path: str | Path,
    *,
    unit: str | float = "auto",
    up: str = "auto",
    fps: float | None = None,
    encoding: str = "auto",
) -> Motion:
    """Read a BVH file.

    Args:
        path: the file.
        unit: of its lengths: ``"auto"`` (the likeliest, see :mod:`egopose.motion.io.body_unit`), ``"m"``, ``"dm"``,
            ``"cm"``, ``"mm"``, ``"inch"``, ``"asf"`` (CMU's own, 0.0564 m), or metres a unit as a number.
        up: ``"auto"`` (head above feet, on average), or ``"x"``, ``"-x"``, ``"y"``, ``"-y"``, ``"z"``, ``"-z"``.
        fps: frames per second, in place of the file's frame time.
        encoding: of the text, see :func:`egopose.motion.io._files.read_text`.

    Returns:
        z up, metres. The up axis turns the root only. ``meta`` records format, source, unit, up axis, stature, the
        names of roots above the body that were folded into its first joint (``folded_roots``), and in ``notes`` what
        was read otherwise than it is written.

    Raises:
        InputError: names the file, line and cause; also when the unit makes the body no person's size.
    """
    path = Path(path)
    given_up(path, up)
    given = given_unit(path, unit)
    raw = parse_bvh(path, encoding, timed=fps is None)
    notes = list(raw.notes)
    rate = frame_rate(raw.frame_time) if fps is None else given_rate(path, fps)
    if fps is None and abs(rate * float(raw.frame_time) - 1.0) > 5e-4:
        notes.append(f"the frame time {raw.frame_time} s is taken for {rate:g} frames/s; reader.fps says otherwise")
    poses = _local_poses(raw, notes)
    folded = _fold_carriers(raw.joints, poses)

    sample = np.unique(np.linspace(0, len(raw.values) - 1, _GUESS_FRAMES).astype(int))
    skeleton, qpos = _assemble(raw.joints, [p.at(sample) for p in poses], folded, 1.0, up_rotation("z"), still=-1.0)
    height = stature(skeleton, forward_kinematics(skeleton, qpos)[0])
    travel = np.sum([p.translation for p in poses[: folded + 1]], axis=0)
    unit_name, metres = given or _guessed_unit(path, height, travel, rate, notes)
    low, high = _ANY_STATURE
    if not low <= height * metres <= high and named(skeleton, "head") and named(skeleton, "foot"):
        cause = f"makes the body {height * metres:.3g} m tall ({height:.4g} units); {low} to {high} m are read"
        raise InputError(path, "option unit", cause)
    up = guess_up(skeleton, qpos) if up == "auto" else up

    skeleton, qpos = _assemble(raw.joints, poses, folded, metres, up_rotation(up), still=_STILL)
    meta = {
        "format": "bvh",
        "source": path.name,
        "unit": unit_name,
        "unit_metres": metres,
        "up": up,
        "stature": round(height * metres, 4),
        "folded_roots": [j.name for j in raw.joints[:folded]],
        "notes": notes,
    }
    return Motion(skeleton, qpos, rate, name=path.stem, meta=meta)


@dataclass(frozen=True)
class _LocalPose:
    """One joint in its parent: ``translation [T, 3]``, whether channels drive it, and Euler ``angles [T, h]`` (rad)."""

    translation: Array
    driven: bool
    axes: str
    angles: Array

    def at(self, frames: np.ndarray) -> _LocalPose:
        return _LocalPose(self.translation[frames], self.driven, self.axes, self.angles[frames])

    def quat(self) -> Array:
        """``[T, 4]``: the angles applied in order."""
        out = np.tile([1.0, 0.0, 0.0, 0.0], (len(self.translation), 1))
        for k, axis in enumerate(self.axes):
            out = rot.multiply(out, rot.from_axis_angle(np.eye(3)["xyz".index(axis)], self.angles[:, k]))
        return out


def _local_poses(raw: BvhFile, notes: list[str]) -> list[_LocalPose]:
    poses, columns, added, in_world = [], _columns(raw.joints), _added_to_offset(raw), _places_in_the_world(raw)
    if in_world:
        notes.append("positions of joints below the root are places in the world, as their values say")
    elif any(added):
        notes.append("positions of joints below the root are added to OFFSET, as their values say")
    for joint, column, adds in zip(raw.joints, columns, added, strict=True):
        channels = joint.channels or ()
        values = raw.values[:, column : column + len(channels)]
        offset = np.array(joint.offset)
        translation = np.tile(offset, (len(values), 1))
        turning = [k for k, c in enumerate(channels) if c.endswith("rotation")]
        for k, channel in enumerate(channels):
            if channel.endswith("position"):
                axis = "xyz".index(channel[0])
                translation[:, axis] = values[:, k] + (offset[axis] if adds else 0.0)
        axes = "".join(channels[k][0] for k in turning)
        angles = np.deg2rad(values[:, turning])
        angles = continuous_euler(angles) if len(set(axes)) == 3 else np.unwrap(angles, axis=0)
        poses.append(_LocalPose(translation, len(turning) < len(channels), axes, angles))
    return _in_parents(raw.joints, poses) if in_world else poses


def _in_parents(joints: list[BvhJoint], poses: list[_LocalPose]) -> list[_LocalPose]:
    """The poses with driven joints' translations, which are places in the world, turned into their parents' axes."""
    out: list[_LocalPose] = []
    places: list[Array] = []
    turns: list[Array] = []
    for joint, pose in zip(joints, poses, strict=True):
        place, turn = pose.translation, pose.quat()
        if joint.parent >= 0:
            parent, axes = places[joint.parent], turns[joint.parent]
            if pose.driven:
                pose = replace(pose, translation=rot.rotate(rot.conjugate(axes), place - parent))
            else:
                place = parent + rot.rotate(axes, place)
            turn = rot.multiply(axes, turn)
        out.append(pose)
        places.append(place)
        turns.append(turn)
    return out


def _columns(joints: list[BvhJoint]) -> list[int]:
    """The first column of each joint's channels."""
    return [0, *itertools.accumulate(len(joint.channels or ()) for joint in joints)][:-1]


def _added_to_offset(raw: BvhFile) -> list[bool]:
    """For each joint, whether its position channels say what is added to OFFSET, rather than what replaces it.

    Bones hardly change their length: over all joints the values stay near the OFFSETs where they replace them, and near
    nothing where they are added. What is neither is taken for the usual, which is to replace. The body's first joint
    and those above it have their place in the world: they do not vote, and where the others' are added each is taken
    for what fits its own values.
    """
    misfits = np.zeros((len(raw.joints), 2))  # were they added; did they replace
    for i, (joint, column) in enumerate(zip(raw.joints, _columns(raw.joints), strict=True)):
        for k, channel in enumerate(joint.channels or ()):
            if channel.endswith("position"):
                values, offset = raw.values[:, column + k], np.array(joint.offset)["xyz".index(channel[0])]
                misfits[i] += np.percentile(np.abs(values), 90), np.percentile(np.abs(values - offset), 90)
    body = _first_branching(raw.joints)
    added, replaced = misfits[body + 1 :].sum(axis=0)
    own = misfits[:, 0] < misfits[:, 1]
    return [bool(added < _CLEARLY * replaced and (i > body or own[i])) for i in range(len(raw.joints))]


def _places_in_the_world(raw: BvhFile) -> bool:
    """Whether the position channels below the root say where joints are in the world, rather than in their parents.

    Then a joint keeps an OFFSET's length from where its parent is. Joints vote whose parents' places are known too, but
    for the body's first joint and those above it: their place is in the world anyway.
    """
    places: dict[int, Array] = {}
    for i, (joint, column) in enumerate(zip(raw.joints, _columns(raw.joints), strict=True)):
        at = {c[0]: column + k for k, c in enumerate(joint.channels or ()) if c.endswith("position")}
        if set(at) == set("xyz"):
            places[i] = raw.values[:, [at[axis] for axis in "xyz"]]
    misfits, body = np.zeros(3), _first_branching(raw.joints)  # were they in the world, added, replacing
    for i, place in places.items():
        joint = raw.joints[i]
        if i <= body or joint.parent not in places:
            continue
        offset = np.array(joint.offset)
        length = float(np.linalg.norm(offset))
        found = (place - places[joint.parent], place, place - offset)
        wanted = (length, 0.0, 0.0)
        for k in range(3):
            misfits[k] += np.percentile(np.abs(np.linalg.norm(found[k], axis=1) - wanted[k]), 90)
    return bool(misfits[0] < _CLEARLY * misfits[1:].min())


def _first_branching(joints: list[BvhJoint]) -> int:
    """The first joint that carries another number of joints than one."""
    carried = Counter(joint.parent for joint in joints)
    return next(i for i in range(len(joints)) if carried[i] != 1)


def _fold_carriers(joints: list[BvhJoint], poses: list[_LocalPose]) -> int:
    """How many joints at the top are no part of the body.

    Such a one carries a single child, driven by position channels, and either stays at the world's origin or sees the
    child move freely against it, as no bone does. Leaving it out is exact for all others.
    """
    count = 0
    while (
        count + 1 < len(joints)
        and sum(j.parent == count for j in joints) == 1
        and not joints[count].tips
        and poses[count + 1].driven
        and (_is_still(poses[count]) or _moves_freely(poses[count + 1]))
    ):
        count += 1
    return count


def _is_still(pose: _LocalPose) -> bool:
    return bool(np.abs(pose.translation).max() <= 1e-6 and np.abs(pose.angles).max(initial=0.0) <= 1e-6)


def _moves_freely(pose: _LocalPose) -> bool:
    """By more than a hundredth of the distance to its parent."""
    return bool(np.ptp(pose.translation, axis=0).max() > 0.01 * np.linalg.norm(pose.translation.mean(axis=0)))


def _assemble(
    joints: list[BvhJoint], poses: list[_LocalPose], folded: int, metres: float, to_z_up: Array, *, still: float
) -> tuple[Skeleton, Array]:
    """Skeleton and ``qpos [T, nq]`` in metres; translations within ``still`` metres become offsets."""
    position = np.zeros_like(poses[0].translation)
    quat = np.tile(to_z_up, (len(position), 1))
    for pose in poses[: folded + 1]:
        position = position + rot.rotate(quat, metres * pose.translation)
        quat = rot.multiply(quat, pose.quat())
    columns = [position, rot.continuous(quat)]
    out = [Joint(joints[folded].name, -1, (0.0, 0.0, 0.0), (), _scaled(joints[folded].tips, metres))]
    for joint, pose in zip(joints[folded + 1 :], poses[folded + 1 :], strict=True):
        offset, dofs = metres * np.array(joint.offset), hinges(pose.axes)
        if pose.driven:
            translation = metres * pose.translation
            middle = 0.5 * (translation.min(axis=0) + translation.max(axis=0))
            if np.linalg.norm(np.ptp(translation, axis=0)) <= 2 * still:
                offset = middle
            else:
                dofs = slides("xyz") + dofs
                columns.append(translation - offset)
        columns.append(pose.angles)
        out.append(Joint(joint.name, joint.parent - folded, _triple(offset), dofs, _scaled(joint.tips, metres)))
    return Skeleton(tuple(out)), np.concatenate(columns, axis=1)


def _scaled(tips: list[tuple[float, float, float]], metres: float) -> tuple[tuple[float, float, float], ...]:
    """End Sites in metres; those of no length only close a branch and say nothing."""
    return tuple(_triple(metres * np.array(t)) for t in tips if any(t))


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _guessed_unit(path: Path, height: float, root: Array, fps: float, notes: list[str]) -> tuple[str, float]:
    """Name and metres of the unit that the body's ``height`` in units and its ways speak for."""
    guess = guess_unit(height, root, fps)
    if guess is None:
        low, high = STATURE_RANGE
        cause = (
            f"the body is about {height:.4g} units tall, no known unit makes that {low} to {high} m; "
            "give the option unit (m, cm, mm, inch, asf or metres a unit)"
        )
        raise InputError(path, "OFFSET", cause)
    if guess.doubt:
        notes.append(guess.doubt)
    return guess.name, guess.metres
