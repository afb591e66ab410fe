"""Inverse kinematics on points alone: of mocap with noise, and of lifted poses of real film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets, solve_in_time
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton
from egopose.motion.smooth_inverse_kinematics import solve_smooth

#: The points that lead: joints that keypoints lie at, and the toes' tips.
JOINTS = tuple(f"{s}{part}" for part in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot") for s in ("Left", "Right"))
TOES = ("LeftFoot", "RightFoot")
WAYS = ("frame by frame", "in time, one pass", "frame by frame, then in time")


def targets(skeleton: Skeleton, points: Array, weight: Array | None = None) -> Targets:
    """Targets for ``points [T, 16, 3]``: :data:`JOINTS`, toes, neck and head; z up, m."""
    names = (*JOINTS, *TOES, "Neck", "Head")
    offsets = np.zeros((len(names), 3))
    for k, name in enumerate(TOES):
        offsets[len(JOINTS) + k] = skeleton.joints[skeleton.index(name)].tips[0]
    known = np.isfinite(points).all(axis=-1)
    weight = known.astype(np.float64) if weight is None else weight * known
    rows = np.array([skeleton.index(name) for name in names])
    none = np.zeros((len(points), 0, 4))
    return Targets(rows, offsets, np.nan_to_num(points), weight, np.zeros(0, dtype=int), none, np.zeros(0))


def points_of(skeleton: Skeleton, qpos: Array) -> Array:
    """``[T, 16, 3]``: where a pose has the points of :func:`targets`."""
    aims = targets(skeleton, np.zeros((len(qpos), 16, 3)))
    positions, quats = forward_kinematics(skeleton, qpos)
    turned = rot.rotate(quats[:, aims.point_joint], aims.point_offset[None])
    return np.asarray(positions[:, aims.point_joint] + turned)


def first_guess(skeleton: Skeleton, points: Array) -> Array:
    """``[T, nq]``: upright limbs, the root turned as hips and shoulders lie. Frames without points repeat others."""
    held = points.copy()
    for column in held.reshape(len(held), -1).T:
        known = np.isfinite(column)
        if known.any():
            column[~known] = np.interp(np.flatnonzero(~known), np.flatnonzero(known), column[known])
    left, right = (held[:, [JOINTS.index(side + part) for part in ("UpLeg", "Arm")]] for side in ("Left", "Right"))
    middle = 0.5 * (left + right)
    up, across = middle[:, 1] - middle[:, 0], (left - right).mean(axis=1)
    z = up / np.linalg.norm(up, axis=1, keepdims=True)
    x = np.cross(across, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    qpos = np.tile(skeleton.rest_qpos(), (len(points), 1))
    qpos[:, :3] = middle[:, 0]
    qpos[:, 3:7] = rot.continuous(
        Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2)).as_quat(scalar_first=True)
    )
    return qpos


def solved(
    humanoid: HumanoidModel, skeleton: Skeleton, points: Array, fps: float, ways: Sequence[str] = WAYS
) -> dict[str, Array]:
    """``{way: [T, nq]}`` for each of ``ways``."""
    aims, start, limits = targets(skeleton, points), first_guess(skeleton, points), humanoid.joint_range
    out = {}
    if WAYS[1] in ways:
        out[WAYS[1]] = solve_smooth(skeleton, start, aims, fps, limits=limits, stay=0.0, iterations=30)
    if WAYS[0] in ways or WAYS[2] in ways:
        single = solve_in_time(skeleton, start, aims, limits)
        single[:, 3:7] = rot.continuous(single[:, 3:7])
        # Frames that show nothing start where their neighbours ended.
        seen = np.flatnonzero(aims.position_weight.any(axis=1))
        out[WAYS[0]] = single[seen[np.abs(seen - np.arange(len(points))[:, None]).argmin(axis=1)]]
        out[WAYS[2]] = solve_smooth(skeleton, out[WAYS[0]], aims, fps, limits=limits, stay=0.0)
    return {way: out[way] for way in ways}


def acceleration(qpos: Array, fps: float) -> float:
    """Mean size of the hinges' acceleration, rad/s^2."""
    return float(np.abs(np.diff(qpos[:, 7:], n=2, axis=0)).mean() * fps**2)


def persons_skeleton(skeleton: Skeleton, points: Array) -> Skeleton:
    """The skeleton with limbs and trunk as long as ``points [T, 16, 3]`` have them: medians, either side alike."""

    def length(a: str, b: str) -> float:
        return float(np.nanmedian(np.linalg.norm(points[:, JOINTS.index(a)] - points[:, JOINTS.index(b)], axis=-1)))

    def of_sides(a: str, b: str) -> float:
        return 0.5 * (length("Left" + a, "Left" + b) + length("Right" + a, "Right" + b))

    wanted = {"Leg": of_sides("UpLeg", "Leg"), "Foot": of_sides("Leg", "Foot")}
    wanted |= {"ForeArm": of_sides("Arm", "ForeArm"), "Hand": of_sides("ForeArm", "Hand")}
    middle = [
        points[:, [JOINTS.index(side + part) for side in ("Left", "Right")]].mean(axis=1) for part in ("Arm", "UpLeg")
    ]
    rest = points_of(skeleton, skeleton.rest_qpos()[None])[0]
    heights = [rest[[JOINTS.index(side + part) for side in ("Left", "Right")], 2].mean() for part in ("Arm", "UpLeg")]
    trunk = float(np.nanmedian(np.linalg.norm(middle[0] - middle[1], axis=-1))) / (heights[0] - heights[1])
    hips = length("LeftUpLeg", "RightUpLeg") / np.linalg.norm(
        rest[JOINTS.index("LeftUpLeg")] - rest[JOINTS.index("RightUpLeg")]
    )
    shoulders = length("LeftArm", "RightArm") / np.linalg.norm(
        rest[JOINTS.index("LeftArm")] - rest[JOINTS.index("RightArm")]
    )
    joints = []
    for joint in skeleton.joints:
        offset, part = np.array(joint.offset), joint.name.removeprefix("Left").removeprefix("Right")
        if part in wanted:
            offset *= wanted[part] / np.linalg.norm(offset)
        else:
            offset *= [trunk, hips if part == "UpLeg" else shoulders, trunk]
        scale = wanted["Foot"] / 0.246 / 1.75 if part == "Foot" else trunk
        joints.append(
            replace(joint, offset=tuple(offset), tips=tuple(tuple(scale * v for v in tip) for tip in joint.tips))
        )
    return replace(skeleton, joints=tuple(joints))
