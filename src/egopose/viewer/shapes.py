"""The surface of a body as triangles, each vertex carried by one joint."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from egopose.core.config import compose_config
from egopose.humanoid.config import HumanoidConfig
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

_ROUNDING = 1e-4  # m
_THICKEST, _SLENDER = 0.05, 0.2  # m and share of the length: bones of skeletons that have no body of their own


@dataclass(frozen=True, eq=False)
class Surface:
    """``vertices [V, 3]`` m in the frame of joint ``joint [V]``, ``faces [F, 3]``."""

    vertices: Array
    joint: NDArray[np.int64]
    faces: NDArray[np.int64]

    def posed(self, positions: Array, quats: Array) -> NDArray[np.float32]:
        """World vertices ``[V, 3]`` for joints at ``positions [J, 3]`` and ``quats [J, 4]``."""
        return (positions[self.joint] + rot.rotate(quats[self.joint], self.vertices)).astype(np.float32)


def surface_of(skeleton: Skeleton) -> Surface:
    """The simulated humanoid's geoms where the joints are the default one's, else a capsule along each bone.

    Read back from BVH, the joints are the same to its rounding while their hinges are other ones.
    """
    humanoid = _default_humanoid()
    own = humanoid.skeleton
    same = skeleton.names == own.names and np.allclose(skeleton.offsets[1:], own.offsets[1:], atol=_ROUNDING)
    return _geoms(humanoid) if same else _bones(skeleton)


@cache
def _default_humanoid() -> HumanoidModel:
    return build_humanoid(HumanoidConfig.from_mapping(compose_config("prepare")["humanoid"]))


def _geoms(humanoid: HumanoidModel) -> Surface:
    model, parts = humanoid.mj_model, []
    for joint, body in enumerate(humanoid.body_ids):
        for geom in np.flatnonzero(model.geom_bodyid == body):
            size = model.geom_size[geom]
            mesh = _solid(int(model.geom_type[geom]), size)
            parts.append((rot.rotate(model.geom_quat[geom], mesh.vertices) + model.geom_pos[geom], mesh.faces, joint))
    return _joined(parts)


def _solid(kind: int, size: Array) -> trimesh.Trimesh:
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return _capsule(size[0], 2 * size[1])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    ball = trimesh.creation.icosphere(2)
    return ball.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0])


def _capsule(radius: float, length: float) -> trimesh.Trimesh:
    """Along z, centred."""
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[8, 10])
    return mesh.apply_translation(-mesh.bounds.mean(axis=0))


def _bones(skeleton: Skeleton) -> Surface:
    parts = []
    ends = [(skeleton.parents[j], skeleton.offsets[j]) for j in range(1, len(skeleton))]
    ends += [(j, np.array(tip)) for j, joint in enumerate(skeleton.joints) for tip in joint.tips]
    for joint, end in ends:
        length = float(np.linalg.norm(end))
        if length < 0.01:
            continue
        mesh = _capsule(min(_THICKEST, _SLENDER * length), length)
        mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], end / length))
        parts.append((mesh.vertices + end / 2, mesh.faces, int(joint)))
    middle = trimesh.creation.icosphere(1, radius=_THICKEST)
    parts.append((middle.vertices, middle.faces, 0))
    return _joined(parts)


def _joined(parts: list[Any]) -> Surface:
    """Of ``(vertices [V, 3], faces [F, 3], joint)``."""
    starts = np.cumsum([0, *(len(v) for v, _, _ in parts)])
    return Surface(
        np.concatenate([v for v, _, _ in parts]),
        np.concatenate([np.full(len(v), joint) for v, _, joint in parts]),
        np.concatenate([f + start for (_, f, _), start in zip(parts, starts, strict=False)]),
    )
