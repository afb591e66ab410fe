"""CSV for spreadsheets and scripts: all that a motion holds, a row a frame, units in the column names."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import up_rotation
from egopose.motion.io.markers import dof_names, markers, plain_names
from egopose.motion.io.native import skeleton_to_json
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def write_csv(motion: Motion, path: str | Path, *, up: str = "z") -> None:
    """Write coordinates, joint positions, contacts, torques, forces of the ground and an estimate's confidence.

    The lines before the header begin with ``#`` (``pandas.read_csv(path, comment="#")``): name, frame rate, axes and
    the skeleton as JSON (offsets in m, each joint's degrees of freedom with their axes), which makes the table whole.

    Args:
        motion: z up, metres.
        path: the file; its folder must exist.
        up: the file's up axis, of the root, of positions and of forces.

    Raises:
        KeyError: an unknown up axis.
    """
    world = rot.conjugate(up_rotation(up))
    columns: dict[str, np.ndarray] = {"frame": np.arange(len(motion)), "time [s]": np.arange(len(motion)) / motion.fps}
    root = rot.continuous(rot.multiply(world, rot.normalize(motion.qpos[:, 3:7])))
    columns |= _named("root {} [m]", "xyz", rot.rotate(world, motion.qpos[:, :3]))
    columns |= _named("root q{}", "wxyz", root)
    units = ["rad" if d.kind == "hinge" else "m" for j in motion.skeleton.joints for d in j.dofs]
    dofs = dof_names(motion)
    columns |= {f"{n} [{u}]": motion.qpos[:, 7 + k] for k, (n, u) in enumerate(zip(dofs, units, strict=True))}
    names, positions = markers(motion)
    for k, name in enumerate(names):
        columns |= _named(f"{name} {{}} [m]", "xyz", rot.rotate(world, positions[:, k]))
    if motion.contacts is not None:
        labels = motion.contact_names or tuple(f"point{k}" for k in range(motion.contacts.shape[1]))
        columns |= {f"{n} contact": motion.contacts[:, k] for k, n in enumerate(plain_names(list(labels)))}
    if motion.torques is not None:
        kinds = ["N m" if unit == "rad" else "N" for unit in units]
        columns |= {f"{n} torque [{u}]": motion.torques[:, k] for k, (n, u) in enumerate(zip(dofs, kinds, strict=True))}
    if motion.ground_reaction is not None:
        ground = motion.ground_reaction.turned(world)
        for k, body in enumerate(plain_names(list(ground.bodies))):
            columns |= _named(f"{body} ground force {{}} [N]", "xyz", ground.force[:, k])
            columns |= _named(f"{body} ground point {{}} [m]", "xyz", ground.point[:, k])
            columns |= _named(f"{body} ground moment {{}} [N m]", "xyz", ground.moment[:, k])
    if motion.confidence is not None:
        columns["confidence"] = motion.confidence
    head = [
        f"# name: {' '.join(motion.name.split())}",
        f"# fps: {motion.fps!r}",
        f"# axes: right-handed, {up} up; metres, radians, quaternions wxyz; forces act on the body",
        f"# skeleton: {json.dumps(skeleton_to_json(motion.skeleton))}",
        ",".join(columns),
    ]
    table = np.stack([np.asarray(v, dtype=np.float64) for v in columns.values()], axis=1)
    row_format = ",".join(["%.9g"] * table.shape[1])
    text = [*head, *(row_format % tuple(row) for row in table.tolist())]
    Path(path).write_text("\n".join(text) + "\n", encoding="utf-8")


def _named(pattern: str, parts: str, values: Array) -> dict[str, np.ndarray]:
    return {pattern.format(part): values[:, k] for k, part in enumerate(parts)}
