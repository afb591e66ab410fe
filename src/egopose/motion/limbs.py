"""Which joints of a limb are its hip and knee, or shoulder and elbow, however many bones it is made of.

Rigs split long bones (MakeHuman's ``upperleg01 upperleg02``, Daz's ``Bend`` and ``Twist``) and put joints before them
(a clavicle, a hip joint in the pelvis). Names seldom tell; a knee bends, and has two bones of like length on its sides.
"""

from __future__ import annotations

import re
from itertools import combinations, pairwise

import numpy as np

from egopose.motion.joint_names import plain_names
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: Helper bones that stand in a limb's chain in some rigs and carry no joint of their own.
HELPER = re.compile(r"twist|share|roll|helper|nub|(?:^|[_.:])ik[_.]|(?-i:(?<=\w)IK(?![a-z]))", re.IGNORECASE)
#: A joint bends if the angle of its bones ranges over more than this in the clip, or is larger than that, rad.
_BENDING, _BENT = np.deg2rad(8.0), np.deg2rad(25.0)
#: A limb's longer bone is at most this many times the shorter one; people's are within 1.3, cartoons' within 2.
_UNEQUAL = 2.5
#: Costs, beside the log of the two bones' ratio: a bone that bends inside; a knee that does not bend though another
#: joint does; a limb that begins within a straight run of joints.
_BROKEN, _STIFF, _WITHIN = 2.0, 1.0, 0.2


def limb_joints(
    skeleton: Skeleton,
    chain: list[int],
    end: int,
    positions: Array,
    known: tuple[int | None, int | None] = (None, None),
) -> tuple[int, int] | None:
    """The limb's first joint and its hinge.

    Args:
        skeleton: for the joints' names.
        chain: joint indices from the trunk (exclusive) to ``end`` (exclusive), from above.
        end: the ankle or wrist.
        positions: ``[T, J, 3]`` m, of a sample of the clip's frames or of the rest pose alone.
        known: either of the two joints, where somebody has said it.

    Returns:
        Joint indices (hip, knee) or (shoulder, elbow); None if the chain is too short.
    """
    names = plain_names(skeleton.names)
    able = [k for k, joint in enumerate(chain) if joint in known or not HELPER.search(names[joint])]
    pairs = [
        pair
        for pair in combinations(able, 2)
        if all(joint not in chain or chain[k] == joint for k, joint in zip(pair, known, strict=True))
    ]
    if not pairs:
        return None
    points = positions[:, [*chain, end]]
    bends = _bends(points)
    lengths = np.median(np.linalg.norm(np.diff(points, axis=1), axis=2), axis=0)

    def cost(pair: tuple[int, int]) -> float:
        top, hinge = pair
        upper, lower = lengths[top:hinge].sum(), lengths[hinge:].sum()
        ratio = abs(np.log(max(upper, 1e-9) / max(lower, 1e-9)))
        inside = bends[top + 1 : hinge].sum() + bends[hinge + 1 :].sum()
        stiff = bends[top + 1 :].any() and not bends[hinge]
        # Where nothing bends, a clavicle in line with its arm is likelier than an arm without one.
        within = (top > 0 and not bends[top]) if bends[1:].any() else 0.5 * (top == 0 and len(able) > 2)
        uneven = _BROKEN * 2 if ratio > np.log(_UNEQUAL) else 0.0
        left_out = np.log(lengths[able[0] :].sum() / max(upper + lower, 1e-9))
        return float(ratio + left_out + uneven + _BROKEN * inside + _STIFF * stiff + _WITHIN * within)

    # Of equals the pair nearest the limb's end.
    best = min(reversed(pairs), key=cost)
    return chain[best[0]], chain[best[1]]


def _bends(points: Array) -> np.ndarray:
    """``[K]`` booleans of a chain of points ``[T, K + 1, 3]``: do the bones before and after point k make an angle?

    Joints in one place are one joint: the last of them bends.
    """
    bones = np.diff(points, axis=1)
    length = np.linalg.norm(bones, axis=2)
    real = np.flatnonzero(np.median(length, axis=0) > 1e-3 * length.sum(axis=1).mean())
    out = np.zeros(points.shape[1] - 1, dtype=bool)
    for before, after in pairwise(real):
        cosine = np.sum(bones[:, before] * bones[:, after], axis=1) / (length[:, before] * length[:, after])
        low, middle, high = np.quantile(np.arccos(np.clip(cosine, -1.0, 1.0)), (0.02, 0.5, 0.98))
        out[after] = high - low > _BENDING or middle > _BENT
    return out
