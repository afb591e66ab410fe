"""A skeleton: a tree of joints, each with its offset from the parent and its own degrees of freedom.

The coordinates are MuJoCo's: ``qpos = [root position 3, root quaternion 4 (wxyz), one value per degree of freedom]``;
a joint's degrees of freedom act in the order they are listed, each in the frame left by the ones before it. Three
hinges about z, y, x are therefore exactly a BVH joint with the channels ``Zrotation Yrotation Xrotation``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Dof:
    """One degree of freedom: a ``hinge`` (rad) or ``slide`` (m) along a unit axis in the joint's own frame."""

    kind: str
    axis: tuple[float, float, float]


@dataclass(frozen=True)
class Joint:
    """A joint and the rigid body it moves.

    Args:
        name: unique in the skeleton.
        parent: index of the parent joint, -1 for the root; parents stand before their children.
        offset: from the parent's origin in the parent's frame, metres. The root's is ignored: qpos places it.
        dofs: the joint's degrees of freedom; empty for the root (it is free) and for a welded joint.
        tips: end sites in this joint's frame, metres (BVH ``End Site``).
    """

    name: str
    parent: int
    offset: tuple[float, float, float]
    dofs: tuple[Dof, ...] = ()
    tips: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Skeleton:
    """A tree of :class:`Joint`; the first is the root.

    Raises:
        ValueError: no joints, a second root, a parent after its child, a name twice.
    """

    joints: tuple[Joint, ...]
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not self.joints:
            raise ValueError("a skeleton needs at least one joint")
        names = [j.name for j in self.joints]
        if len(set(names)) != len(names):
            twice = sorted({n for n in names if names.count(n) > 1})
            raise ValueError(f"joint names stand twice: {', '.join(twice)}")
        for i, joint in enumerate(self.joints):
            if (joint.parent == -1) != (i == 0) or joint.parent >= i:
                raise ValueError(f"joint {joint.name!r}: its parent {joint.parent} must stand before it")
        if self.joints[0].dofs:
            raise ValueError("the root is free; it takes no further degrees of freedom")

    def __len__(self) -> int:
        return len(self.joints)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(j.name for j in self.joints)

    @cached_property
    def parents(self) -> NDArray[np.int64]:
        """``[J]`` parent indices, -1 for the root."""
        return np.array([j.parent for j in self.joints], dtype=np.int64)

    @cached_property
    def offsets(self) -> Array:
        """``[J, 3]`` metres in the parent's frame."""
        return np.array([j.offset for j in self.joints], dtype=np.float64)

    @cached_property
    def dof_joint(self) -> NDArray[np.int64]:
        """``[D]`` index of the joint each degree of freedom belongs to."""
        return np.array([i for i, j in enumerate(self.joints) for _ in j.dofs], dtype=np.int64)

    @cached_property
    def dof_slices(self) -> tuple[slice, ...]:
        """For each joint, its columns among the degrees of freedom (add 7 for qpos, 6 for qvel)."""
        ends = np.cumsum([len(j.dofs) for j in self.joints])
        return tuple(slice(int(e) - len(j.dofs), int(e)) for e, j in zip(ends, self.joints, strict=True))

    @property
    def n_dofs(self) -> int:
        return sum(len(j.dofs) for j in self.joints)

    @property
    def nq(self) -> int:
        """Length of qpos: 7 + degrees of freedom."""
        return 7 + self.n_dofs

    @property
    def nv(self) -> int:
        """Length of qvel: 6 + degrees of freedom."""
        return 6 + self.n_dofs

    def index(self, name: str) -> int:
        """Index of the joint called ``name``. Raises KeyError naming the joints there are."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no joint {name!r}; the skeleton has {', '.join(self.names)}") from None

    def children(self, index: int) -> list[int]:
        return [i for i, j in enumerate(self.joints) if j.parent == index]

    def rest_qpos(self) -> Array:
        """``[nq]``: everything zero, the root quaternion the identity."""
        qpos = np.zeros(self.nq)
        qpos[3] = 1.0
        return qpos


_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def hinges(axes: Sequence[str] | str) -> tuple[Dof, ...]:
    """Hinges about coordinate axes, in order: ``hinges("zyx")``."""
    return tuple(Dof("hinge", _AXES[a]) for a in axes)


def slides(axes: Sequence[str] | str) -> tuple[Dof, ...]:
    """Slides along coordinate axes, in order."""
    return tuple(Dof("slide", _AXES[a]) for a in axes)
