"""Guess what a file does not say, from the body in it: which way is up, and how long its unit is.

Bones in the zero pose say neither (some exporters lay every bone along its joint's y axis), so the posed body is asked:
the head is above the feet, and a person is about 1.7 m tall.
"""

from __future__ import annotations

import re

import numpy as np

from egopose.motion.io.up_axis import settle_up
from egopose.motion.joint_names import plain_names
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: Stature is about this much of the bones from ankle to head joint; soles and the crown are missing from them.
_STATURE_PER_PATH = 1.08


def stature(skeleton: Skeleton, positions: Array) -> float:
    """Standing height in the skeleton's own unit, whatever the pose: the bones from ankle to head, and a little more.

    Without names to go by, the longest way through the tree (foot to hand in most) is taken for 1.35 of the height.

    Args:
        skeleton: the tree.
        positions: ``[T, J, 3]`` of its joints, any pose.
    """
    lengths = np.zeros(len(skeleton))
    for i, joint in enumerate(skeleton.joints):
        if joint.parent >= 0:
            lengths[i] = np.median(np.linalg.norm(positions[:, i] - positions[:, joint.parent], axis=-1))
    heads, feet = named(skeleton, "head"), named(skeleton, "foot")
    if heads and feet:
        return _STATURE_PER_PATH * max(_path(skeleton, lengths, foot, heads[0]) for foot in feet)
    leaves = sorted(set(range(len(skeleton))) - set(skeleton.parents.tolist()))
    far = max(leaves, key=lambda leaf: _path(skeleton, lengths, 0, leaf))
    return max(_path(skeleton, lengths, far, leaf) for leaf in leaves) / 1.35


def guess_up(skeleton: Skeleton, qpos: Array) -> str:
    """The axis the head is above the feet along, on average over frames; y where the names do not say.

    A body that mostly lies or crawls points nowhere: y, BVH's custom, is kept unless another axis clearly wins. Where
    the rest pose stands along another axis, :func:`egopose.motion.io.up_axis.settle_up` chooses.
    """
    heads, feet = named(skeleton, "head"), named(skeleton, "foot")
    if not heads or not feet:
        return "y"
    positions, _ = forward_kinematics(skeleton, qpos)
    toward_head = (positions[:, heads[0]] - positions[:, feet].mean(axis=1)).mean(axis=0)
    axis = int(np.argmax(np.abs(toward_head)))
    height = stature(skeleton, positions)
    if abs(toward_head[axis]) < max(2.0 * toward_head[1], 0.35 * height):
        posed = "y"
    else:
        posed = ("-" if toward_head[axis] < 0 else "") + "xyz"[axis]
    return settle_up(skeleton, qpos, heads[0], feet, height, posed)


_PATTERNS = {"head": ("head", "neck"), "foot": ("foot|ankle", "toe", "leg|shin|calf|knee")}


def named(skeleton: Skeleton, part: str) -> list[int]:
    """Joints whose names speak of the ``"head"`` or a ``"foot"``: the first in the tree of each branch."""
    for pattern in _PATTERNS[part]:
        found: list[int] = []
        for i, name in enumerate(plain_names(skeleton.names)):
            if re.search(pattern, name.lower()) and not set(_ancestors(skeleton, i)) & set(found):
                found.append(i)
        if found:
            return found
    return []


def _ancestors(skeleton: Skeleton, index: int) -> list[int]:
    """The joint and all above it, the root last."""
    chain = [index]
    while skeleton.joints[chain[-1]].parent >= 0:
        chain.append(skeleton.joints[chain[-1]].parent)
    return chain


def _path(skeleton: Skeleton, lengths: Array, a: int, b: int) -> float:
    """Length of the bones between two joints."""
    return float(sum(lengths[i] for i in set(_ancestors(skeleton, a)) ^ set(_ancestors(skeleton, b))))
