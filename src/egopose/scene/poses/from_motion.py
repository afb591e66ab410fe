"""3D keypoints from a motion: of BVH, TRC, C3D and SMPL parameters by the readers of :mod:`egopose.motion.io`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io import read_motion
from egopose.motion.mapping import SIDES, identify, sample
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import PoseTrack

#: Keypoint -> part of the body whose joint lies there, see :class:`~egopose.motion.mapping.BodyMap`.
_PARTS = {
    **{"hip": "thigh", "knee": "shin", "ankle": "foot"},
    **{"shoulder": "arm", "elbow": "forearm", "wrist": "hand"},
}


def motion_keypoints(motion: Motion) -> Array:
    """``[T, 25, 3]`` m, world axes: where a motion's joints put the keypoints of ``BODY_25``.

    Hips, knees, ankles, shoulders, elbows and wrists are joints. Neck and middle of the hips are means, as OpenPose
    has them. A toe is the toe's joint, or the foot's tip where there is none. Face and heels have no joint: NaN.

    Raises:
        InputError: the skeleton is not a person's.
    """
    skeleton = motion.skeleton
    positions, quats = motion.forward_kinematics()
    body = identify(skeleton, positions=sample(positions))
    out = np.full((len(motion), len(BODY_25), 3), np.nan)
    for side in SIDES:
        for keypoint, part in _PARTS.items():
            out[:, BODY_25.index(f"{side}_{keypoint}")] = positions[:, body.parts[f"{side}_{part}"]]
        foot, toe = body.parts[f"{side}_foot"], body.parts.get(f"{side}_toe")
        tips = skeleton.joints[foot].tips
        if toe is not None:
            out[:, BODY_25.index(f"{side}_big_toe")] = positions[:, toe]
        elif tips:
            # The tips of a sole are its corners: the middle of the front ones.
            ahead = np.array(sorted(tips, key=lambda tip: -float(np.linalg.norm(tip)))[:2]).mean(axis=0)
            out[:, BODY_25.index(f"{side}_big_toe")] = positions[:, foot] + rot.rotate(quats[:, foot], ahead[None])
    for keypoint, part in (("neck", "shoulder"), ("mid_hip", "hip")):
        out[:, BODY_25.index(keypoint)] = out[:, [BODY_25.index(f"{side}_{part}") for side in SIDES]].mean(axis=1)
    return out


def read_motion_poses(path: str | Path, **options: Any) -> PoseTrack:
    """3D keypoints (world axes, m) of a motion file; there are no 2D ones, so those are NaN.

    Args:
        path: any file that :func:`egopose.motion.io.read_motion` reads.
        options: of that reader (``unit``, ``up``, ``fps``, ``points`` ...).

    Raises:
        InputError: as :func:`~egopose.motion.io.read_motion`, or the skeleton is not a person's.
    """
    motion = read_motion(path, **options)
    positions = motion_keypoints(motion)
    known = np.isfinite(positions).all(axis=-1)
    return PoseTrack(
        BODY_25,
        np.full((*known.shape, 2), np.nan),
        np.asarray(known, dtype=np.float64),
        motion.fps,
        positions=positions,
        axes="world",
        notes=tuple(str(note) for note in motion.meta.get("notes", ())),
    )
