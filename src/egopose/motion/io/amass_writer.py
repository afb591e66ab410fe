"""A motion as AMASS-style ``.npz``: axis-angle poses of SMPL-H's body joints and the root's way.

Bodies whose rest frames are known can be said exactly: the project's humanoid and SMPL's own skeleton. What SMPL has no
place for is left out: bone lengths (``betas`` are zero: the body model's plain person), contacts, torques, forces; of
the humanoid's four spine joints SMPL has three, so the second turns together with the third.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from egopose.motion import rotations as rot
from egopose.motion.io.amass import BODY_JOINTS, BODY_PARENTS, rest_positions
from egopose.motion.motion import Motion

_WIDTH = 156  # SMPL-H: 52 joints of 3
_BETAS = 16

#: The humanoid's joint that turns as each SMPL joint does; its toes do not move against its feet.
_HUMANOID = {
    "pelvis": "Hips",
    "spine1": "Spine",
    "spine2": "Spine2",
    "spine3": "Spine3",
    "neck": "Neck",
    "head": "Head",
    **{
        f"{side}_{smpl}": side.capitalize() + own
        for side in ("left", "right")
        for smpl, own in (
            ("hip", "UpLeg"),
            ("knee", "Leg"),
            ("ankle", "Foot"),
            ("foot", "Foot"),
            ("collar", "Shoulder"),
            ("shoulder", "Arm"),
            ("elbow", "ForeArm"),
            ("wrist", "Hand"),
        )
    },
}

#: SMPL's rest axes (x left, y up, z forward) in the humanoid's (x forward, y left, z up).
_SMPL_IN_HUMANOID = np.array([0.5, 0.5, 0.5, 0.5])


def write_amass(motion: Motion, path: str | Path, *, joints: ArrayLike | None = None) -> None:
    """Write ``poses [T, 156]`` (rad; hands zero), ``trans [T, 3]`` (m, z up), ``mocap_framerate``, betas and gender.

    Args:
        motion: on the project's humanoid or on SMPL's skeleton.
        path: the file; its folder must exist.
        joints: ``[22, 3]`` rest positions of the body the file is meant for, see :func:`amass.read_amass`; ``trans``
            puts that body's pelvis where the root is.

    Raises:
        ValueError: another skeleton.
    """
    there = set(motion.skeleton.names)
    if there >= set(BODY_JOINTS):
        source, axes = {name: name for name in BODY_JOINTS}, np.array([1.0, 0.0, 0.0, 0.0])
    elif there >= set(_HUMANOID.values()):
        source, axes = _HUMANOID, _SMPL_IN_HUMANOID
    else:
        raise ValueError(
            "AMASS takes the program's humanoid or SMPL's skeleton; `egopose prepare` retargets to the first"
        )
    rest = rest_positions() if joints is None else np.asarray(joints, dtype=np.float64)
    positions, quats = motion.forward_kinematics()
    world = rot.multiply(quats[:, [motion.skeleton.index(source[name]) for name in BODY_JOINTS]], axes)
    local = world.copy()
    for k, parent in enumerate(BODY_PARENTS):
        if parent >= 0:
            local[:, k] = rot.multiply(rot.conjugate(world[:, parent]), world[:, k])
    poses = np.zeros((len(motion), _WIDTH))
    poses[:, : 3 * len(BODY_JOINTS)] = rot.to_rotvec(local).reshape(len(motion), -1)
    with Path(path).open("wb") as stream:
        np.savez_compressed(
            stream,
            poses=poses,
            trans=positions[:, 0] - rest[0],
            mocap_framerate=np.array(motion.fps),
            betas=np.zeros(_BETAS),
            gender=np.array("neutral"),
        )
