"""A motion as points, for formats that hold nothing else: its joints and the ends of its limbs."""

from __future__ import annotations

import re

import numpy as np

from egopose.motion.kinematics import tip_positions
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


def markers(motion: Motion) -> tuple[list[str], Array]:
    """Names and world positions ``[T, M, 3]`` (m, z up) of all joints, then of all tips (``Head_tip``, ``Foot_tip2``).

    Letters, digits and underscores stay in the names; names stay different.
    """
    positions, quats = motion.forward_kinematics()
    owners, tips = tip_positions(motion.skeleton, positions, quats)
    numbers = [owners[: k + 1].count(name) for k, name in enumerate(owners)]
    names = [*motion.skeleton.names, *(f"{o}_tip{n if n > 1 else ''}" for o, n in zip(owners, numbers, strict=True))]
    return plain_names(names), np.concatenate([positions, tips], axis=1)


def dof_names(motion: Motion) -> list[str]:
    """``joint_0 joint_1 ...`` for every degree of freedom, in qpos's order, as the humanoid's hinges are called."""
    return plain_names([f"{j.name}_{k}" for j in motion.skeleton.joints for k in range(len(j.dofs))])


def plain_names(names: list[str]) -> list[str]:
    """Names of letters, digits and underscores only, made different by a number where they fall together."""
    out: list[str] = []
    for name in names:
        plain = re.sub(r"\W+", "_", name).strip("_") or "joint"
        number, wanted = 2, plain
        while plain in out:
            plain, number = f"{wanted}_{number}", number + 1
        out.append(plain)
    return out
