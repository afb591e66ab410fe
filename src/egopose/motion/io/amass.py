"""AMASS-style ``.npz``: root translation and axis-angle poses of an SMPL, SMPL-H or SMPL-X body, metres.

The 22 joints all three share are read; fingers, jaw and eyes are left out and counted in ``meta``. The files hold no
bone lengths (the body models that do are under licence), so a plain adult's of round figures are used unless given.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io.frames import euler_angles, given_rate, given_up, up_rotation
from egopose.motion.io.smpl_arrays import read_smpl_arrays
from egopose.motion.io.smpl_up import guess_up
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Joint, Skeleton, hinges

# name, parent, offset in the T-pose (x left, y up, z forward; m), hinge order. The middle hinge is the twist, which
# stays furthest from a quarter turn: about y for what stands or hangs along it, about x for arms.
_BODY = (
    ("pelvis", "", (0.0, -0.22, 0.03), ""),
    ("left_hip", "pelvis", (0.07, -0.09, -0.01), "zyx"),
    ("right_hip", "pelvis", (-0.07, -0.09, -0.01), "zyx"),
    ("spine1", "pelvis", (0.0, 0.12, -0.03), "zyx"),
    ("left_knee", "left_hip", (0.03, -0.39, 0.0), "zyx"),
    ("right_knee", "right_hip", (-0.03, -0.39, 0.0), "zyx"),
    ("spine2", "spine1", (0.0, 0.13, 0.0), "zyx"),
    ("left_ankle", "left_knee", (-0.01, -0.40, -0.04), "zyx"),
    ("right_ankle", "right_knee", (0.01, -0.40, -0.04), "zyx"),
    ("spine3", "spine2", (0.0, 0.06, 0.02), "zyx"),
    ("left_foot", "left_ankle", (0.03, -0.06, 0.12), "zyx"),
    ("right_foot", "right_ankle", (-0.03, -0.06, 0.12), "zyx"),
    ("neck", "spine3", (0.0, 0.21, -0.04), "zyx"),
    ("left_collar", "spine3", (0.08, 0.12, -0.03), "zxy"),
    ("right_collar", "spine3", (-0.08, 0.12, -0.03), "zxy"),
    ("head", "neck", (0.0, 0.09, 0.05), "zyx"),
    ("left_shoulder", "left_collar", (0.10, 0.04, -0.01), "zxy"),
    ("right_shoulder", "right_collar", (-0.10, 0.04, -0.01), "zxy"),
    ("left_elbow", "left_shoulder", (0.26, -0.01, -0.03), "zxy"),
    ("right_elbow", "right_shoulder", (-0.26, -0.01, -0.03), "zxy"),
    ("left_wrist", "left_elbow", (0.25, 0.01, 0.0), "zxy"),
    ("right_wrist", "right_elbow", (-0.25, 0.01, 0.0), "zxy"),
)
_NAMES = [row[0] for row in _BODY]

#: The 22 joints in the files' order, and each one's parent among them (-1 for the pelvis).
BODY_JOINTS = tuple(_NAMES)
BODY_PARENTS = tuple(_NAMES.index(row[1]) if row[1] else -1 for row in _BODY)

_TIPS = {
    "head": ((0.0, 0.16, 0.02),),
    "left_foot": ((0.0, 0.0, 0.07),),
    "right_foot": ((0.0, 0.0, 0.07),),
    "left_wrist": ((0.18, 0.0, 0.0),),
    "right_wrist": ((-0.18, 0.0, 0.0),),
}
#: m; no recording begins this near to the origin in all three directions.
_MOVED = 0.02


def read_amass(
    path: str | Path,
    *,
    joints: ArrayLike | None = None,
    up: str = "auto",
    fps: float | None = None,
) -> Motion:
    """Read an AMASS-style file, or one of a tool that writes SMPL's parameters under other names.

    ``poses [T, 66 | 72 | 156 | 165]`` (rad; also ``[T, J, 3]``), ``trans [T, 3]`` (m), ``mocap_framerate``; other names
    see :mod:`egopose.motion.io.smpl_arrays`.

    Args:
        path: the file.
        joints: ``[22, 3]`` positions of the body's joints in its T-pose (m, y up, as SMPL's regressor gives them for
            the subject's shape); by default a plain adult's.
        up: the file's up axis; ``"auto"``: AMASS's z, unless the body stands along another.
        fps: frames per second, in place of what the file says.

    Raises:
        InputError: an array missing, of another shape, not finite, or of absurd size; a frame rate neither in the file
            nor given.
    """
    path = Path(path)
    given_up(path, up)
    given = None if fps is None else given_rate(path, fps)
    arrays = read_smpl_arrays(path)
    rate = given if given is not None else arrays.fps
    if rate is None:
        raise InputError(path, "mocap_framerate", "missing: the frame rate is not said; give the option fps")
    rest = rest_positions() if joints is None else np.asarray(joints, dtype=np.float64)
    if rest.shape != (len(_BODY), 3) or not np.isfinite(rest).all():
        raise InputError(path, "option joints", f"must be [{len(_BODY)}, 3] finite positions, got {rest.shape}")
    skeleton = _skeleton(rest)
    quats = rot.from_rotvec(arrays.turns)
    columns = [arrays.place + rest[0], rot.continuous(quats[:, 0])]
    columns += [euler_angles(quats[:, i], _BODY[i][3]) for i in range(1, len(_BODY))]
    qpos = np.concatenate(columns, axis=1)
    notes = []
    if up == "auto":
        ankles = (skeleton.index("left_ankle"), skeleton.index("right_ankle"))
        moved = bool(np.abs(arrays.place[0]).max() < _MOVED)
        usual = forward_kinematics(_skeleton(rest_positions()), qpos)[0]  # given joints may be of anything
        up = guess_up(usual, skeleton.index("head"), ankles, moved)
        if up != "z":
            notes.append(f"{up} is taken for up: the body stands along it; reader.up says otherwise")
    to_z_up = up_rotation(up)
    qpos[:, :3], qpos[:, 3:7] = rot.rotate(to_z_up, qpos[:, :3]), rot.multiply(to_z_up, qpos[:, 3:7])
    meta = {
        "format": "amass",
        "source": path.name,
        "unit": "m",
        "unit_metres": 1.0,
        "up": up,
        "body_model": arrays.model,
        "dropped_columns": arrays.dropped,
        "bone_lengths": "plain adult" if joints is None else "given",
        "notes": notes,
    }
    return Motion(skeleton, qpos, rate, name=path.stem, meta=meta)


def rest_positions() -> Array:
    """``[22, 3]`` m: the plain adult's joints in the T-pose, y up."""
    positions = np.zeros((len(_BODY), 3))
    for i, (_, parent, offset, _) in enumerate(_BODY):
        positions[i] = np.array(offset) + (positions[_NAMES.index(parent)] if parent else 0.0)
    return positions


def _skeleton(rest: Array) -> Skeleton:
    joints = []
    for i, (name, parent, _, axes) in enumerate(_BODY):
        up = _NAMES.index(parent) if parent else -1
        x, y, z = rest[i] - rest[up] if parent else np.zeros(3)
        joints.append(Joint(name, up, (float(x), float(y), float(z)), hinges(axes), _TIPS.get(name, ())))
    return Skeleton(tuple(joints), name="smpl")
