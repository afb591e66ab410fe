"""OpenSim's motion and storage files: joint angles, forces of the ground, joint torques.

OpenSim's ground is y up: x stays, our z is its y, our -y its z (for a body that faces x: forward, up, right).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import euler_angles, up_rotation
from egopose.motion.io.markers import dof_names, plain_names
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: From z up to OpenSim's y up.
_TO_OPENSIM = rot.conjugate(up_rotation("y"))

_ROOT = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")


def write_mot(motion: Motion, path: str | Path) -> None:
    """Write joint angles: degrees, slides and the root's place in metres, ``inDegrees=yes``.

    The root's columns are those of OpenSim's gait models: ``pelvis_tilt`` (about z), ``pelvis_list`` (x) and
    ``pelvis_rotation`` (y), applied in this order, then ``pelvis_tx ty tz``. The others are the skeleton's own degrees
    of freedom, ``JOINT_0 JOINT_1 ...``: a model with coordinates of these names plays them.
    """
    quat = rot.multiply(rot.multiply(_TO_OPENSIM, rot.normalize(motion.qpos[:, 3:7])), rot.conjugate(_TO_OPENSIM))
    angles = np.rad2deg(euler_angles(quat, "zxy"))
    place = rot.rotate(_TO_OPENSIM, motion.qpos[:, :3])
    hinge = np.array([d.kind == "hinge" for j in motion.skeleton.joints for d in j.dofs], dtype=bool)
    joints = motion.qpos[:, 7:] * np.where(hinge, 180.0 / np.pi, 1.0)
    _write(motion, Path(path), [*_ROOT, *dof_names(motion)], np.concatenate([angles, place, joints], axis=1), True)


def write_forces_mot(motion: Motion, path: str | Path) -> None:
    """Write forces of the ground for OpenSim's ExternalLoads: ``BODY_ground_force_vx .. px .. , BODY_ground_torque_x``.

    N, m and N m in the ground frame; the force acts on the body. With ``BODY_ground_force_v`` as force identifier,
    ``..._p`` as point and ``BODY_ground_torque_`` as torque identifier.

    Raises:
        ValueError: the motion has no ground reaction.
    """
    ground = motion.ground_reaction
    if ground is None:
        raise ValueError("this motion has no ground reaction")
    turned = ground.turned(_TO_OPENSIM)
    names = [
        f"{body}_ground_{part}{axis}"
        for body in plain_names(list(ground.bodies))
        for part in ("force_v", "force_p", "torque_")
        for axis in "xyz"
    ]
    values = np.stack([turned.force, turned.point, turned.moment], axis=2).reshape(len(motion), -1)
    _write(motion, Path(path), names, values, True)


def write_torques_sto(motion: Motion, path: str | Path) -> None:
    """Write joint torques as OpenSim's inverse dynamics does: ``JOINT_0_moment`` in N m (``_force`` in N for slides).

    Raises:
        ValueError: the motion has no torques.
    """
    if motion.torques is None:
        raise ValueError("this motion has no joint torques")
    kinds = [d.kind for j in motion.skeleton.joints for d in j.dofs]
    names = [f"{n}_{'moment' if k == 'hinge' else 'force'}" for n, k in zip(dof_names(motion), kinds, strict=True)]
    _write(motion, Path(path), names, motion.torques, False)


def _write(motion: Motion, path: Path, names: list[str], values: Array, degrees: bool) -> None:
    lines = [
        path.stem,
        "version=1",
        f"nRows={len(values)}",
        f"nColumns={values.shape[1] + 1}",
        f"inDegrees={'yes' if degrees else 'no'}",
        "endheader",
        "\t".join(["time", *names]),
    ]
    row_format = "\t".join(["%.9g"] * values.shape[1])
    lines += [f"{t / motion.fps:.9g}\t" + row_format % tuple(row) for t, row in enumerate(values.tolist())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
