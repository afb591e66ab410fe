"""BVH: any skeleton, any channel order, 3 or 6 channels a joint, any up axis and unit.

A joint's rotation channels become hinges in the file's order; of equal triples of angles the continuous ones are taken.
Position channels replace the joint's OFFSET, as exporters mean them; where they stay constant they become the offset,
else slides before the hinges.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io.body_size import STATURE_RANGE, guess_unit, guess_up, stature
from egopose.motion.io.bvh_syntax import BvhFile, BvhJoint, parse_bvh
from egopose.motion.io.frames import UNITS, UP_AXES, continuous_euler, frame_rate, up_rotation
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Joint, Skeleton, hinges, slides

#: Translations that stay within this of their middle (m) are a bone's length, not a movement.
_STILL = 5e-5
_GUESS_FRAMES = 60


def read_bvh(path: str | Path, *, unit: str | float = "auto", up: str = "auto") -> Motion:
    """Read a BVH file.

    Args:
        path: the file.
        unit: of its lengths: ``"auto"`` (the one that makes the body nearest to 1.7 m), ``"m"``, ``"cm"``, ``"mm"``,
            ``"inch"``, ``"asf"`` (CMU's own, 0.0564 m), or metres a unit as a number.
        up: ``"auto"`` (head above feet, on average), or ``"x"``, ``"-x"``, ``"y"``, ``"-y"``, ``"z"``, ``"-z"``.

    Returns:
        z up, metres. The up axis turns the root only. ``meta`` records format, source, unit, up axis, stature and the
        names of roots above the body that were folded into its first joint (``folded_roots``).

    Raises:
        InputError: names the file, line and cause; also when no unit makes the body a person's size.
    """
    path = Path(path)
    if up != "auto" and up not in UP_AXES:
        raise InputError(path, "option up", f"{up!r} is none of auto, {', '.join(UP_AXES)}")
    raw = parse_bvh(path)
    poses = _local_poses(raw)
    folded = _fold_carriers(raw.joints, poses)

    sample = np.unique(np.linspace(0, len(raw.values) - 1, _GUESS_FRAMES).astype(int))
    skeleton, qpos = _assemble(raw.joints, [p.at(sample) for p in poses], folded, 1.0, up_rotation("z"), still=-1.0)
    height = stature(skeleton, forward_kinematics(skeleton, qpos)[0])
    unit_name, metres = _unit(path, unit, height)
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
    }
    return Motion(skeleton, qpos, frame_rate(raw.frame_time), name=path.stem, meta=meta)


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


def _local_poses(raw: BvhFile) -> list[_LocalPose]:
    poses, column = [], 0
    for joint in raw.joints:
        channels = joint.channels or ()
        values = raw.values[:, column : column + len(channels)]
        column += len(channels)
        translation = np.tile(np.array(joint.offset), (len(values), 1))
        turning = [k for k, c in enumerate(channels) if c.endswith("rotation")]
        for k, channel in enumerate(channels):
            if channel.endswith("position"):
                translation[:, "xyz".index(channel[0])] = values[:, k]
        axes = "".join(channels[k][0] for k in turning)
        angles = np.deg2rad(values[:, turning])
        angles = continuous_euler(angles) if len(set(axes)) == 3 else np.unwrap(angles, axis=0)
        poses.append(_LocalPose(translation, len(turning) < len(channels), axes, angles))
    return poses


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


def _unit(path: Path, unit: str | float, height: float) -> tuple[str, float]:
    """Name and metres of the unit asked for, or guessed from the body's ``height`` in units."""
    if isinstance(unit, str) and unit in UNITS:
        return unit, UNITS[unit]
    if isinstance(unit, int | float) and np.isfinite(unit) and unit > 0:
        return f"{float(unit):g} m", float(unit)
    if unit != "auto":
        raise InputError(path, "option unit", f"{unit!r} is none of auto, {', '.join(UNITS)} or metres a unit")
    guess = guess_unit(height)
    if guess is None:
        low, high = STATURE_RANGE
        cause = (
            f"the body is about {height:.4g} units tall, no known unit makes that {low} to {high} m; "
            "give the option unit (m, cm, mm, inch, asf or metres a unit)"
        )
        raise InputError(path, "OFFSET", cause)
    return guess, UNITS[guess]
