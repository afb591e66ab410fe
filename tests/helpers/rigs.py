"""BVH files of one person on a rig of choice: how a foot lies, split bones, straight hinges, tiptoe, names.

The person is 1.75 m tall (centimetres, y up, x left, z forward), squats, turns and swings the arms with soles flat on
y = 0, unless said. Whatever the rig, the motion is the same, so retargeted files can be held against each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array

#: Lengths of a leg's and an arm's two bones, cm; the ankle joint's height over the floor.
THIGH, SHIN, UPPER_ARM, FOREARM, ANKLE = 42.0, 41.0, 28.0, 26.0, 7.0
_MIXAMO = {
    "thigh": "UpLeg",
    "shin": "Leg",
    "foot": "Foot",
    "toe": "ToeBase",
    "clavicle": "Shoulder",
    "arm": "Arm",
    "forearm": "ForeArm",
    "hand": "Hand",
}


@dataclass(frozen=True)
class Rig:
    """A person's rig and motion.

    Args:
        foot_angle: of the line from ankle to toe below level in the rest pose, degrees.
        toe: what ends a foot: a ``"joint"`` with an end site, a ``"bare"`` joint without, or only an ``"end"`` site.
        split: limb part -> shares of its length at which further joints stand, ``{"thigh": (0.5,)}``.
        split_names: of these joints, formatted with the part's name and a number from 2.
        twist: how much of a thigh's, shin's ... twist its later bones add, degrees (moves no other joint).
        names: of the parts, formatted ``{side}{name}``.
        pattern: how a joint's name is made of side and name.
        knee, elbow: the hinge's angle while standing, degrees; below zero it is hyperextended.
        squats: whether the person squats.
        tiptoe: share of the clip, from its end, in which the person stands on the toes.
        rise: how far the foot is turned down then, degrees.
        world: a turn of the whole body about the first hips, a rotation vector in degrees.
        rest_world: the rest pose turned as well (an export for another up axis).
        height: what the whole body is scaled by.
        folded: the rest pose lays every bone along y, and means nothing.
        seconds: of the clip at 30 frames/s.
    """

    foot_angle: float = 19.65
    toe: str = "joint"
    split: dict[str, tuple[float, ...]] = field(default_factory=dict)
    split_names: str = "{name}0{number}"
    twist: float = 0.0
    names: dict[str, str] = field(default_factory=lambda: dict(_MIXAMO))
    pattern: str = "{Side}{name}"
    knee: float = 2.0
    elbow: float = 10.0
    squats: bool = True
    tiptoe: float = 0.0
    rise: float = 40.0
    world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rest_world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height: float = 1.0
    folded: bool = False
    seconds: float = 4.0


@dataclass
class _Bone:
    name: str
    parent: int
    offset: Array
    world: Rotation
    ends: list[Array] = field(default_factory=list)


def write_rig(rig: Rig, path: Path) -> Path:
    """The person on ``rig`` as a BVH file."""
    bones, root = _body(rig)
    frames = len(root)
    world, rest = (Rotation.from_rotvec(r, degrees=True) for r in (rig.world, rig.rest_world))
    # A joint's own axes in the body's rest axes: all as the file's, or its bone along y.
    axes = [_fold(bones, i) if rig.folded else rest.inv() for i in range(len(bones))]
    lines, columns = ["HIERARCHY"], [rig.height * (world.apply(root - root[:1]) + rest.apply(root[:1]))]

    def write(index: int, level: int) -> None:
        bone, pad = bones[index], "  " * level
        turn = world * bone.world * axes[index]
        if index:
            turn = (world * bones[bone.parent].world * axes[bone.parent]).inv() * turn
        offset = axes[bone.parent].inv().apply(bone.offset) if index else np.zeros(3)
        places = "" if index else "Xposition Yposition Zposition "
        lines.extend([f"{pad}{'JOINT' if index else 'ROOT'} {bone.name}", pad + "{", _offset(pad, rig.height * offset)])
        lines.append(f"{pad}  CHANNELS {3 if index else 6} {places}Zrotation Xrotation Yrotation")
        columns.append(turn.as_euler("ZXY", degrees=True))
        children = [k for k, other in enumerate(bones) if other.parent == index]
        for child in children:
            write(child, level + 1)
        for end in bone.ends or ([] if children else [np.zeros(3)]):
            end = rig.height * axes[index].inv().apply(end)
            lines.extend([f"{pad}  End Site", pad + "  {", _offset(pad + "  ", end), pad + "  }"])
        lines.append(pad + "}")

    write(0, 0)
    lines += ["MOTION", f"Frames: {frames}", "Frame Time: 0.0333333"]
    lines += [" ".join(f"{v:.5f}" for v in row) for row in np.concatenate(columns, axis=1)]
    path.write_text("\n".join(lines) + "\n")
    return path


def _offset(pad: str, vector: Array) -> str:
    return f"{pad}  OFFSET " + " ".join(f"{v:.6f}" for v in vector)


def _fold(bones: list[_Bone], index: int) -> Rotation:
    children = [bone.offset for bone in bones if bone.parent == index] + bones[index].ends
    along = next((c for c in children if np.linalg.norm(c) > 1e-6), np.array([0.0, 1.0, 0.0]))
    return Rotation.align_vectors(along[None], [[0.0, 1.0, 0.0]])[0]


def _body(rig: Rig) -> tuple[list[_Bone], Array]:
    """Bones with world orientations ``[T]`` in the body's rest axes, and the root's path ``[T, 3]`` (cm)."""
    frames = round(30 * rig.seconds)
    phase = np.linspace(0.0, 2 * np.pi, frames)
    squat = 30.0 * (1 - np.cos(2 * phase)) / 2 if rig.squats else np.zeros(frames)
    heading = _turn("y", 40.0 * np.sin(phase / 2))
    # The heels rise within a third of a second; a clip wholly on tiptoe begins so.
    since = np.arange(frames) - round((1 - rig.tiptoe) * frames)
    rise = rig.rise * (np.ones(frames) if rig.tiptoe >= 1 else np.clip(since / 10.0, 0.0, 1.0))
    knee = rig.knee + 2 * squat
    spine = heading * _turn("x", 0.3 * squat)
    bones = [_Bone("Hips", -1, np.zeros(3), heading)]
    bones.append(_Bone("Spine", 0, np.array([0.0, 12.0, 0.0]), spine))
    bones.append(_Bone("Chest", 1, np.array([0.0, 18.0, 0.0]), spine))
    bones.append(_Bone("Neck", 2, np.array([0.0, 24.0, 0.0]), spine))
    bones.append(_Bone("Head", 3, np.array([0.0, 10.0, 2.0]), spine, [np.array([0.0, 18.0, 0.0])]))
    for side, left in (("Left", 1.0), ("Right", -1.0)):
        clavicle = _add(bones, rig, side, "clavicle", 2, np.array([5.0 * left, 18.0, 0.0]), spine)
        swing = 25.0 * np.sin(2 * phase)
        arm = spine * _turn("x", left * swing) * _turn("z", np.full(frames, -70.0 * left))
        bent = arm * _turn("y", np.full(frames, -rig.elbow * left) - 15.0 * left * rig.squats * (1 - np.cos(phase)))
        shoulder, whole = np.array([13.0 * left, 0.0, 0.0]), np.array([left, 0.0, 0.0])
        upper, end = _limb(bones, rig, side, "arm", clavicle, shoulder, UPPER_ARM * whole, arm)
        lower, end = _limb(bones, rig, side, "forearm", upper, end, FOREARM * whole, bent)
        hand = _add(bones, rig, side, "hand", lower, end, bent)
        bones[hand].ends.append(np.array([16.0 * left, 0.0, 0.0]))
    for side, left in (("Left", 1.0), ("Right", -1.0)):
        thigh = heading * _turn("x", -knee / 2)
        shin = heading * _turn("x", knee / 2)
        foot = heading * _turn("x", rise)
        hip, down = np.array([9.0 * left, -4.0, 0.0]), np.array([0.0, -1.0, 0.0])
        upper, end = _limb(bones, rig, side, "thigh", 0, hip, THIGH * down, thigh)
        lower, end = _limb(bones, rig, side, "shin", upper, end, SHIN * down, shin)
        ankle = _add(bones, rig, side, "foot", lower, end, foot)
        angle = np.deg2rad(rig.foot_angle)
        toe = 14.0 * np.array([0.0, -np.sin(angle), np.cos(angle)])
        if rig.toe == "end":
            bones[ankle].ends.append(toe)
        else:
            base = _add(bones, rig, side, "toe", ankle, toe, heading)
            if rig.toe == "joint":
                bones[base].ends.append(np.array([0.0, 0.0, 7.0]))
    drop = THIGH * np.cos(np.deg2rad(knee / 2)) + SHIN * np.cos(np.deg2rad(knee / 2))
    back = (THIGH - SHIN) * np.sin(np.deg2rad(knee / 2))
    # The ball of the foot, 13 cm ahead of the ankle on the sole, stays where it is when the heel rises.
    lift = 13.0 * np.sin(np.deg2rad(rise)) + ANKLE * (np.cos(np.deg2rad(rise)) - 1)
    slide = 13.0 * (1 - np.cos(np.deg2rad(rise))) - ANKLE * np.sin(np.deg2rad(rise))
    place = np.stack([np.zeros(frames), np.zeros(frames), slide - back], axis=1)
    root = heading.apply(place) + np.stack([np.zeros(frames), drop + 4.0 + ANKLE + lift, np.zeros(frames)], axis=1)
    return bones, root


def _turn(axis: str, degrees: Array) -> Rotation:
    return Rotation.from_euler(axis, degrees[:, None], degrees=True)


def _add(
    bones: list[_Bone], rig: Rig, side: str, part: str, parent: int, offset: Array, world: Rotation, number: int = 1
) -> int:
    name = rig.names[part]
    if number > 1:
        name = rig.split_names.format(name=name, number=number)
    bones.append(
        _Bone(rig.pattern.format(side=side[0].lower(), Side=side, S=side[0], name=name), parent, offset, world)
    )
    return len(bones) - 1


def _limb(
    bones: list[_Bone], rig: Rig, side: str, part: str, parent: int, start: Array, whole: Array, world: Rotation
) -> tuple[int, Array]:
    """A long bone of one joint or several; its last joint, and where the bone ends from there."""
    shares = (0.0, *rig.split.get(part, ()))
    index, before = parent, 0.0
    for number, share in enumerate(shares, start=1):
        twist = np.deg2rad(rig.twist * share) * whole / np.linalg.norm(whole)
        offset = start if number == 1 else (share - before) * whole
        index = _add(bones, rig, side, part, index, offset, world * Rotation.from_rotvec(twist), number)
        before = share
    return index, (1 - before) * whole


PLAIN = Rig()
STANDING = replace(PLAIN, squats=False, knee=0.0)
