"""Motions on any skeleton, drawn by hypothesis."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Dof, Joint, Skeleton


@st.composite
def motions(draw: st.DrawFn) -> Motion:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count, frames = draw(st.integers(1, 8)), draw(st.integers(1, 6))
    joints = [Joint("j0", -1, (0, 0, 0), (), ((0.0, 0.0, 0.1),))]
    for i in range(1, count):
        dofs = []
        for _ in range(draw(st.integers(0, 4))):
            axis = rng.normal(size=3)
            kind = draw(st.sampled_from(["hinge", "hinge", "hinge", "slide"]))
            dofs.append(Dof(kind, tuple(axis / np.linalg.norm(axis))))
        tips = tuple(tuple(rng.normal(size=3) * 0.1) for _ in range(draw(st.integers(0, 2))))
        joints.append(Joint(f"j{i}", draw(st.integers(0, i - 1)), tuple(rng.normal(size=3)), tuple(dofs), tips))
    skeleton = Skeleton(tuple(joints))
    qpos = rng.normal(size=(frames, skeleton.nq)) * draw(st.sampled_from([0.01, 1.0, 3.0]))
    qpos[:, 3:7] = rot.normalize(rng.normal(size=(frames, 4)))
    return Motion(skeleton, qpos, draw(st.sampled_from([24.0, 29.97, 30.0, 60.0, 120.0])))
