"""How a source joint's frame lies in the model's: one constant rotation a part, found from the motion itself.

Rigs disagree about their zero pose (some fold every bone onto one axis), so no pose is trusted further than it must be:

* limbs: the bone's direction and the axis the elbow or knee bends about (:mod:`egopose.motion.hinges`), both constant
  in the bone's own frame;
* feet: the direction to the toes and the sole's normal (:mod:`egopose.motion.feet`);
* trunk, neck, head: the zero pose if it stands upright, else the mean of the clip's most upright frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion import rotations as rot
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import SIDES, BodyMap
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: The turns that bring +z, -z, +y, -y, +x, -x of a file's zero pose to +z.
_AXIS_TURNS = np.stack(
    [
        rot.between(np.array(a, dtype=float), np.array([0.0, 0.0, 1.0]))
        for a in ((0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0))
    ]
)
_UPRIGHT = 0.97  # of 1: legs and trunk within some 14 degrees of the vertical
_UP = np.array([0.0, 0.0, 1.0])


def part_positions(body_map: BodyMap, positions: Array, quats: Array, skeleton: Skeleton) -> dict[str, Array]:
    """World positions ``[T, 3]`` of every part; a missing toe is the foot's tip, a missing neck the head's joint."""
    points = {part: positions[:, i] for part, i in body_map.parts.items()}

    def tip(joint: int) -> Array | None:
        """The joint's far end: its end site, or the middle of the furthest ones (the front corners of a sole)."""
        tips = np.array(skeleton.joints[joint].tips).reshape(-1, 3)
        reach = np.linalg.norm(tips, axis=1)
        if not len(tips) or reach.max() < 0.02:
            return None
        far = tips[reach > 0.9 * reach.max()].mean(axis=0)
        return positions[:, joint] + rot.rotate(quats[:, joint], far[None])

    if "neck" not in points:
        # The head's joint is where the neck begins; the head is then its tip, if there is one.
        points["neck"] = points.pop("head")
        if (crown := tip(body_map.parts["head"])) is not None:
            points["crown"] = crown
    for side in SIDES:
        if f"{side}_toe" not in points and (toe := tip(body_map.parts[f"{side}_foot"])) is not None:
            points[f"{side}_toe"] = toe
    return points


def facing(points: dict[str, Array]) -> Array:
    """Heading quaternions ``[T, 4]``: x at right angles to hips and shoulders, forward."""
    left = sum(points[f"left_{p}"] - points[f"right_{p}"] for p in ("thigh", "arm"))
    forward = np.cross(left, _UP)
    angle = np.arctan2(forward[..., 1], forward[..., 0])
    return rot.from_axis_angle(_UP, angle)


def uprightness(points: dict[str, Array]) -> Array:
    """``[T]``, at most 1: how nearly legs and trunk stand along z."""

    def along(lower: str, upper: str) -> Array:
        bone = points[upper] - points[lower]
        return bone[:, 2] / np.maximum(np.linalg.norm(bone, axis=1), 1e-9)

    legs = [along(f"{s}_foot", f"{s}_shin") + along(f"{s}_shin", f"{s}_thigh") for s in SIDES]
    return (sum(legs) + 2 * along("hips", "neck")) / 6.0


def mean_rotation(quats: Array) -> Array:
    """Chordal mean ``[4]`` of ``[T, 4]``."""
    return rot.from_scipy(rot.to_scipy(quats).mean(), (1,))[0]


@dataclass(frozen=True)
class Stance:
    """An upright, forward-looking stance in its heading frame.

    Args:
        orientations: ``[J, 4]`` of the source's joints.
        points: part -> position ``[3]`` from the hips, m.
        is_rest: it is the rest pose; else the mean of the clip's most upright frames.
    """

    orientations: Array
    points: dict[str, Array]
    is_rest: bool


def neutral_stance(motion: Motion, body_map: BodyMap, quats: Array, points: dict[str, Array]) -> Stance:
    """The zero pose if it stands, else the mean of the clip's most upright frames."""
    zero = np.tile(motion.skeleton.rest_qpos(), (len(_AXIS_TURNS), 1))
    zero[:, 3:7] = _AXIS_TURNS
    zero_positions, zero_quats = forward_kinematics(motion.skeleton, zero)
    zero_points = part_positions(body_map, zero_positions, zero_quats, motion.skeleton)
    stands = uprightness(zero_points)
    best = int(np.argmax(stands))
    is_rest = bool(stands[best] > _UPRIGHT)
    if is_rest:
        quats, points, frames = zero_quats, zero_points, np.arange(len(stands)) == best
    else:
        upright = uprightness(points)
        frames = upright >= min(np.quantile(upright, 0.8), _UPRIGHT)
    turn = rot.conjugate(facing(points))
    relative = rot.multiply(turn[:, None], quats)[frames]
    orientations = np.stack([mean_rotation(relative[:, j]) for j in range(relative.shape[1])])
    stance = {part: rot.rotate(turn, p - points["hips"])[frames].mean(axis=0) for part, p in points.items()}
    return Stance(orientations, stance, is_rest)


def frame_from(first: Array, second: Array) -> Rotation:
    """The frame whose x lies along ``first`` and whose y lies nearest ``second`` (vectors ``[3]``)."""
    x = first / np.linalg.norm(first)
    y = second - np.dot(second, x) * x
    y = y / np.linalg.norm(y)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1))


def align(source: tuple[Array, Array], model: tuple[Array, Array]) -> Array:
    """The constant quaternion ``[4]`` c with ``model orientation = source orientation * c``.

    Both pairs are (first, second) directions in their own frames; the first are brought together exactly.
    """
    return rot.from_scipy(frame_from(*source) * frame_from(*model).inv(), (1,))[0]


def angle_between(a: Array, b: Array) -> float:
    """Angle of two vectors ``[3]``, rad."""
    return float(np.arccos(np.clip(np.dot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0)))


def bone_direction(quats: Array, bone: Array) -> Array:
    """Mean direction ``[3]`` of a bone, world vectors ``[T, 3]``, in its own frame ``[T, 4]``."""
    local = rot.rotate(rot.conjugate(quats), bone)
    return local.mean(axis=0)
