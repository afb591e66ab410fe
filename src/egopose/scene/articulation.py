"""From 3D keypoints to the humanoid's joint angles: a skeleton fitted to them, retargeted, and smoothed in time.

Keypoints that were not seen well pull less. The pelvis stays at the origin: where it is in the world is found later.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.io.point_body import motion_of_points
from egopose.motion.motion import Motion
from egopose.motion.retarget import RetargetReport, retarget
from egopose.motion.rotations import Array
from egopose.motion.scaling import MODEL_PARTS, ik_targets, model_points
from egopose.motion.smooth_inverse_kinematics import Smoothness, solve_smooth
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.mending import MADE_UP

#: Part of the body -> keypoints whose confidence counts for it. Other parts count as sure as the shoulders and hips.
_SEEN_BY = {
    f"{side}_{part}": f"{side}_{keypoint}"
    for side in ("left", "right")
    for part, keypoint in {
        "thigh": "hip",
        "shin": "knee",
        "foot": "ankle",
        "toe": "big_toe",
        "arm": "shoulder",
        "forearm": "elbow",
        "hand": "wrist",
    }.items()
}
#: For 10 mm of noise from frame to frame: BlazePose's on two films, across the picture, was 4 to 12 mm an axis.
_SMOOTHNESS = Smoothness(hinges=0.0003, root=0.001)
#: s: hinges are filtered this much before the clip is solved at once, as single frames can jump from branch to branch.
_START = 0.07
_ITERATIONS = 16
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


def articulated(
    source: Path, positions: Array, confidence: Array, humanoid: HumanoidModel, fps: float
) -> tuple[Motion, RetargetReport]:
    """The humanoid in the keypoints' poses.

    Args:
        source: the film or folder they come from, for errors.
        positions: ``[T, 25, 3]`` m, ``BODY_25``, z up, relative to the middle of the hips; finite but for keypoints
            that are never known.
        confidence: ``[T, 25]`` from 0 to 1.
        humanoid: whose skeleton it is put on.
        fps: frames per second.

    Returns:
        The motion, with the hips' middle at the origin, and how far retargeting was off.

    Raises:
        InputError: the keypoints make no person.
    """
    rows = [k for k in range(len(BODY_25)) if np.isfinite(positions[:, k]).all()]
    names = [BODY_25.names[k] for k in rows]
    # Feet that stand on one spot tell retargeting how soles lie.
    walked = positions[:, rows] + _carried(positions)[:, None]
    body = motion_of_points(
        source, names, walked, fps, declared_unit="m", declared_up="z", unit="m", up="z", given=None, meta={}
    )
    motion, report = retarget(body, humanoid.skeleton, humanoid.joint_range)
    qpos = motion.qpos.copy()
    qpos[:, :3] -= _middle_of_hips(motion)
    return replace(motion, qpos=_smoothed(humanoid, qpos, confidence, fps), meta={}), report


def _carried(positions: Array) -> Array:
    """``[T, 3]`` m: a way of the pelvis on which the lower foot stands still and at height 0."""
    feet = positions[:, [BODY_25.index(f"{side}_ankle") for side in ("left", "right")]]
    lower = feet[..., 2].argmin(axis=1)
    frames = np.arange(len(feet) - 1)
    steps = -(feet[1:] - feet[:-1])[frames, lower[1:]]
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    way[:, 2] = -feet[np.arange(len(feet)), lower, 2]
    return way


def _middle_of_hips(motion: Motion) -> Array:
    positions, _ = motion.forward_kinematics()
    return positions[:, [motion.skeleton.index(f"{side}UpLeg") for side in ("Left", "Right")]].mean(axis=1)


def _smoothed(humanoid: HumanoidModel, qpos: Array, confidence: Array, fps: float) -> Array:
    """``[T, nq]``: near the poses frame by frame, in proportion to how surely they were seen, and smooth."""
    skeleton = humanoid.skeleton
    points = model_points(skeleton, qpos)
    _, quats = Motion(skeleton, qpos, fps).forward_kinematics()
    targets = ik_targets(skeleton, points, {name: quats[:, skeleton.index(name)] for name in MODEL_PARTS.values()})
    trunk = confidence[:, [BODY_25.index(name) for name in _TRUNK]].mean(axis=1)
    sure = np.stack(
        [confidence[:, BODY_25.index(_SEEN_BY[part])] if part in _SEEN_BY else trunk for part in points], axis=1
    )
    # Squared, a weight is what a keypoint tells.
    weights = targets.position_weight * np.sqrt(np.maximum(sure, MADE_UP))
    start = qpos.copy()
    start[:, 7:] = gaussian_filter1d(qpos[:, 7:], _START * fps, axis=0, mode="nearest")
    out = solve_smooth(
        skeleton,
        start,
        replace(targets, position_weight=weights),
        fps,
        _SMOOTHNESS,
        limits=humanoid.joint_range,
        stay=0.0,
        iterations=_ITERATIONS,
    )
    out[:, 3:7] = rot.continuous(out[:, 3:7])
    return out
