"""Any Motion as BVH: three rotation channels a joint (ZYX), six for the root and for joints that slide."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import UNITS, euler_angles, up_rotation
from egopose.motion.kinematics import joint_transforms
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

_ROTATION = "Zrotation Yrotation Xrotation"
_POSITION = "Xposition Yposition Zposition"


def write_bvh(motion: Motion, path: str | Path, *, unit: str = "cm", up: str = "y") -> None:
    """Write a BVH file.

    Whatever its degrees of freedom, a joint's local rotation becomes Z, Y, X angles in degrees. Joints are written
    depth first, as the format wants; blanks and braces in names become ``_``; a leaf without tips gets an End Site of
    no length.

    Args:
        motion: z up, metres.
        path: the file to write; its folder must exist.
        unit: of lengths in the file, one of :data:`frames.UNITS`.
        up: the file's up axis (``"y"``, ``"z"`` ...).

    Raises:
        KeyError: an unknown unit or up axis.
        ValueError: two joints have one name once blanks are replaced.
    """
    scale, world = 1.0 / UNITS[unit], rot.conjugate(up_rotation(up))
    skeleton = motion.skeleton
    names = ["".join("_" if c.isspace() or c in "{}" else c for c in name) or "_" for name in skeleton.names]
    if len(set(names)) != len(names):
        raise ValueError("two joints have one name once blanks and braces are replaced")
    order = _depth_first(skeleton)
    columns: list[Array] = []
    for i in order:
        if i == 0:
            position = rot.rotate(world, motion.qpos[:, :3])
            quat = rot.multiply(world, rot.normalize(motion.qpos[:, 3:7]))
        else:
            dofs = skeleton.dof_slices[i]
            position, quat = joint_transforms(skeleton, i, motion.qpos[:, 7 + dofs.start : 7 + dofs.stop])
            position = position + np.array(skeleton.joints[i].offset)
        if _moves(skeleton, i):
            columns.append(position * scale)
        columns.append(np.rad2deg(euler_angles(quat, "zyx")))
    rows = np.concatenate(columns, axis=1)
    text = _hierarchy(skeleton, names, order, scale)
    text += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1.0 / motion.fps:.12g}"]
    row_format = " ".join(["%.6f"] * rows.shape[1])
    text += [row_format % tuple(row) for row in rows.tolist()]
    Path(path).write_text("\n".join(text) + "\n", encoding="utf-8")


def _depth_first(skeleton: Skeleton) -> list[int]:
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting += reversed(skeleton.children(order[-1]))
    return order


def _moves(skeleton: Skeleton, index: int) -> bool:
    """Whether the joint's origin moves in its parent."""
    return index == 0 or any(d.kind == "slide" for d in skeleton.joints[index].dofs)


def _hierarchy(skeleton: Skeleton, names: list[str], order: list[int], scale: float) -> list[str]:
    def offset(vector: tuple[float, float, float]) -> str:
        return "OFFSET " + " ".join(f"{scale * v:.8g}" for v in vector)

    lines, depth = ["HIERARCHY"], {-1: -1}
    for place, i in enumerate(order):
        joint, level = skeleton.joints[i], depth[skeleton.joints[i].parent] + 1
        depth[i] = level
        pad = "\t" * level
        lines += [f"{pad}{'JOINT' if i else 'ROOT'} {names[i]}", f"{pad}{{"]
        lines.append(f"{pad}\t{offset(joint.offset if i else (0.0, 0.0, 0.0))}")
        moves = _moves(skeleton, i)
        lines.append(f"{pad}\tCHANNELS {'6 ' + _POSITION if moves else '3'} {_ROTATION}")
        for tip in joint.tips or (() if skeleton.children(i) else ((0.0, 0.0, 0.0),)):
            lines += [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\t{offset(tip)}", f"{pad}\t}}"]
        following = order[place + 1] if place + 1 < len(order) else None
        next_level = depth[skeleton.joints[following].parent] + 1 if following is not None else 0
        lines += ["\t" * closing + "}" for closing in range(level, next_level - 1, -1)]
    return lines
