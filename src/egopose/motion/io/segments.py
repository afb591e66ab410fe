"""A skeleton from segments whose place and orientation in the world are known: measured, or fitted to points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import euler_angles
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Joint, Skeleton, hinges

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Segment:
    """One segment: its frame is x forward, y left, z up while the person stands in the T-pose.

    Args:
        name: of the joint at the segment's origin.
        parent: name of the parent segment, ``""`` for the root.
        axes: three axes of its hinges, the outermost first. The middle one may turn by a quarter only: it should be
            the axis about which the joint turns least.
        tips: end sites in the segment's frame, metres.
    """

    name: str
    parent: str
    axes: str = "zyx"
    tips: tuple[Vector, ...] = ()


#: Axes for each kind of joint, for segments as :class:`Segment` describes them.
TRUNK_AXES, LEG_AXES, KNEE_AXES, ARM_AXES, ELBOW_AXES = "yxz", "yxz", "yxz", "zxy", "zxy"


def skeleton_of(
    segments: Sequence[Segment], positions: Array, quats: Array, name: str = ""
) -> tuple[Skeleton, Array, float]:
    """The tree with the median offset of every joint, its coordinates, and how well it fits.

    Args:
        segments: parents before children, the root first.
        positions: ``[T, J, 3]`` of the segments' origins, metres.
        quats: ``[T, J, 4]`` of the segments' frames.
        name: of the skeleton.

    Returns:
        The skeleton, ``qpos [T, nq]``, and the mean distance (m) of its joints' origins from the given ones along
        the bones: what constant lengths cannot follow.
    """
    order = [s.name for s in segments]
    joints, columns = [], [positions[:, 0], rot.continuous(rot.normalize(quats[:, 0]))]
    left = np.zeros((len(positions), len(segments)))
    for i, segment in enumerate(segments):
        if not segment.parent:
            joints.append(Joint(segment.name, -1, (0.0, 0.0, 0.0), (), segment.tips))
            continue
        parent = order.index(segment.parent)
        back = rot.conjugate(quats[:, parent])
        local = rot.rotate(back, positions[:, i] - positions[:, parent])
        offset = median_bone(local)
        left[:, i] = np.linalg.norm(local - offset, axis=1)
        joints.append(Joint(segment.name, parent, _vector(offset), hinges(segment.axes), segment.tips))
        columns.append(euler_angles(rot.multiply(back, quats[:, i]), segment.axes))
    return Skeleton(tuple(joints), name=name), np.concatenate(columns, axis=1), float(left[:, 1:].mean())


def median_bone(local: Array) -> Array:
    """Mean direction times median length ``[3]`` of a bone's vectors ``[T, 3]`` in its parent's frame."""
    mean = np.median(local, axis=0)
    length = np.linalg.norm(mean)
    if length < 1e-9:
        return mean
    return mean / length * np.median(np.linalg.norm(local, axis=1))


def _vector(value: Array) -> Vector:
    x, y, z = (float(v) for v in value)
    return x, y, z
