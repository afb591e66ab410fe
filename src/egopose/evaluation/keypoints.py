"""Twelve body keypoints in a side view: for E_key, without a 3D reference (Yuan & Kitani 2019, section 4.3).

A motion is seen by a camera that stays on the person's right, a fixed distance from the root, looking across; what is
compared is then free of where the person went. Reference keypoints come from the reference's own side view, or from a
person's footage as the JSON files OpenPose writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.metrics import keypoint_error
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: Joints of the humanoid in the order of the keypoints: shoulder, elbow, wrist, hip, knee, ankle; right, then left.
KEYPOINTS = (
    *("RightArm", "RightForeArm", "RightHand", "RightUpLeg", "RightLeg", "RightFoot"),
    *("LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot"),
)
SHOULDERS, HIPS = (0, 6), (3, 9)
#: m between camera and root; beyond arm's reach, as a person is filmed.
DISTANCE = 4.0
#: Rows of OpenPose's keypoints in the order above, by how many it writes.
OPENPOSE = {25: (2, 3, 4, 9, 10, 11, 5, 6, 7, 12, 13, 14), 18: (2, 3, 4, 8, 9, 10, 5, 6, 7, 11, 12, 13)}
#: A trunk seen shorter than this share of its length is lying or bent over: the scale of E_key means nothing there.
UPRIGHT = 0.5
_MOST_FRAMES = 1_000_000


def side_view(positions: Array, root_quaternion: Array, distance: float = DISTANCE) -> Array:
    """Image coordinates ``[T, K, 2]`` (x forward, y down; in focal lengths) of points seen from the person's right.

    Args:
        positions: ``[T, K, 3]`` m in the world, relative to the root.
        root_quaternion: ``[T, 4]``; only its heading counts.
        distance: m between camera and root.

    Raises:
        ValueError: a point lies behind the camera.
    """
    turn = rot.conjugate(rot.heading(root_quaternion))[:, None]
    local = rot.rotate(np.broadcast_to(turn, (*positions.shape[:2], 4)), positions)
    depth = local[..., 1] + distance
    if (depth <= 0).any():
        raise ValueError(f"a point lies {-float(depth.min()):.2f} m behind the camera")
    return np.stack([local[..., 0], -local[..., 2]], axis=-1) / depth[..., None]


def motion_keypoints(skeleton: Skeleton, positions: Array, qpos: Array, distance: float = DISTANCE) -> Array:
    """:func:`side_view` ``[T, 12, 2]`` of a motion's joint positions ``[T, 21, 3]`` and ``qpos [T, nq]``.

    Raises:
        ValueError: the skeleton lacks one of :data:`KEYPOINTS`.
    """
    names = list(skeleton.names)
    if missing := [name for name in KEYPOINTS if name not in names]:
        raise ValueError(f"the skeleton has no joint {missing[0]}")
    joints = [names.index(name) for name in KEYPOINTS]
    return side_view(positions[:, joints] - qpos[:, None, :3], qpos[:, 3:7], distance)


def upright(points: Array) -> np.ndarray:
    """Frames ``[T]`` in which all keypoints ``[T, 12, 2]`` are known and the trunk is seen :data:`UPRIGHT`."""
    trunk = points[:, list(SHOULDERS)].mean(axis=1) - points[:, list(HIPS)].mean(axis=1)
    with np.errstate(invalid="ignore"):
        stands = -trunk[:, 1] > UPRIGHT * np.linalg.norm(trunk, axis=1)
    return stands & np.isfinite(points).all(axis=(1, 2))


def side_view_error(estimate: Array, reference: Array) -> tuple[float, int]:
    """E_key: mean of :func:`egopose.evaluation.metrics.keypoint_error` over the frames in which both trunks stand.

    Args:
        estimate, reference: ``[T, 12, 2]``, y down; NaN where a keypoint was not found.

    Returns:
        The error (NaN where no frame counts) and how many frames it is of.
    """
    counts = upright(estimate) & upright(reference)
    if not counts.any():
        return float("nan"), 0
    return float(keypoint_error(estimate[counts], reference[counts], HIPS, SHOULDERS).mean()), int(counts.sum())


def read_openpose(folder: str | Path, confidence: float) -> Array:
    """Keypoints ``[T, 12, 2]`` (pixels, y down) of a folder of OpenPose's ``*_keypoints.json``, one a frame by name.

    Of several people in a frame, the one found with the most confidence; NaN where a keypoint was found with less than
    ``confidence``, or nobody was.

    Args:
        folder: of one video (``--write_json``); models BODY_25 and COCO.
        confidence: 0..1.

    Raises:
        InputError: no such files, or one that OpenPose did not write; names file and field.
    """
    files = sorted(Path(folder).glob("*_keypoints.json"))
    if not files or len(files) > _MOST_FRAMES:
        raise InputError(folder, "*_keypoints.json", f"there are {len(files)}, expected one for each frame")
    out = np.full((len(files), len(KEYPOINTS), 2), np.nan)
    for t, file in enumerate(files):
        card = read_json(file, "people")
        people = card.get("people") if isinstance(card, dict) else None
        if not isinstance(people, list):
            raise InputError(file, "people", "is missing: this is no keypoint file of OpenPose")
        result = [_person(file, person) for person in people]
        if result:
            best = max(result, key=lambda rows: float(rows[:, 2].mean()))
            seen = best[:, 2] >= max(confidence, 1e-9)
            out[t, seen] = best[seen, :2]
    return out


def _person(file: Path, person: object) -> Array:
    """``[12, 3]``: x, y and confidence of each keypoint."""
    values: Sequence[object] | None = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    if not isinstance(values, list) or len(values) not in {3 * n for n in OPENPOSE}:
        raise InputError(file, "pose_keypoints_2d", f"must be 3 numbers for each of {' or '.join(map(str, OPENPOSE))}")
    try:
        rows = np.array(values, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError):
        raise InputError(file, "pose_keypoints_2d", "holds something that is no number") from None
    if not np.isfinite(rows).all():
        raise InputError(file, "pose_keypoints_2d", "holds a number that is not finite")
    return rows[list(OPENPOSE[len(rows)])]
