"""A body in the scene, and what acts on it: contacts, torques, forces of the ground."""

from __future__ import annotations

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.viewer.shapes import surface_of

Color = tuple[int, int, int]

_TOUCH: Color = (220, 60, 40)
_PUSH: Color = (40, 160, 90)
_NEWTONS_A_METRE = 700.0  # an arrow of one metre is an adult's weight
_SMALL, _LARGE, _STRONG = 0.02, 0.09, 150.0  # m, m, N m: radius of a ball on a joint without torque, and with this much


class Figure:
    """One motion in the scene; ``name`` is its place in the scene's tree.

    Args:
        opacity: below 1 for overlays. marks: contacts, torques and forces are shown where the motion holds them.
    """

    def __init__(
        self, scene: viser.SceneApi, name: str, motion: Motion, color: Color, opacity: float = 1.0, marks: bool = False
    ) -> None:
        self.motion = motion
        self._positions, self._quats = motion.forward_kinematics()
        self._surface = surface_of(motion.skeleton)
        self._mesh = scene.add_mesh_simple(
            name,
            self._posed(0),
            self._surface.faces,
            color=color,
            opacity=None if opacity >= 1 else opacity,
            cast_shadow=opacity >= 1,
        )
        self._torques = _Torques(scene, f"{name}/torques", motion) if marks and motion.torques is not None else None
        self._touch = _Touch(scene, f"{name}/contacts", motion) if marks and motion.contacts is not None else None
        forces = motion.ground_reaction if marks else None
        self._forces = None if forces is None else _Forces(scene, f"{name}/forces", forces)

    def _posed(self, frame: int) -> NDArray[np.float32]:
        return self._surface.posed(self._positions[frame], self._quats[frame])

    def root(self, frame: int) -> Array:
        """Where the root is, ``[3]``."""
        return np.asarray(self._positions[min(frame, len(self.motion) - 1), 0])

    def show(self, frame: int, visible: bool = True, marks: bool = True) -> None:
        """Take the pose of a frame; beyond the motion's end the figure is not there."""
        visible = visible and frame < len(self.motion)
        if self._mesh.visible != visible:
            self._mesh.visible = visible
        if not visible:
            return
        self._mesh.vertices = self._posed(frame)
        for mark in (self._torques, self._touch, self._forces):
            if mark is not None:
                mark.show(frame, self._positions[frame], marks)

    def remove(self) -> None:
        """Take it and its marks out of the scene."""
        self._mesh.remove()


class _Torques:
    """A ball on every joint: larger and redder with the norm of its torques."""

    def __init__(self, scene: viser.SceneApi, name: str, motion: Motion) -> None:
        assert motion.torques is not None
        slices = motion.skeleton.dof_slices
        self._norms = np.stack([np.linalg.norm(motion.torques[:, s], axis=1) for s in slices], axis=1)
        ball, count = trimesh.creation.icosphere(1), len(slices)
        self._balls = scene.add_batched_meshes_simple(
            name, ball.vertices, ball.faces, np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3)),
            batched_scales=np.full(count, _SMALL, np.float32), batched_colors=np.zeros((count, 3), np.uint8),
            opacity=0.7, lod="off", cast_shadow=False,
        )  # fmt: skip

    def show(self, frame: int, positions: Array, visible: bool) -> None:
        share = np.clip(self._norms[frame] / _STRONG, 0, 1)[:, None]
        self._balls.visible = visible
        self._balls.batched_positions = positions.astype(np.float32)
        self._balls.batched_scales = np.asarray(_SMALL + (_LARGE - _SMALL) * share[:, 0], dtype=np.float32)
        self._balls.batched_colors = (share * [220, 40, 30] + (1 - share) * [250, 220, 90]).astype(np.uint8)


class _Touch:
    """A disc on the ground below every joint that a touching point is named after.

    It lies at the centre of pressure where the motion's ground reaction names the same bodies: they may be on a box.
    """

    def __init__(self, scene: viser.SceneApi, name: str, motion: Motion) -> None:
        assert motion.contacts is not None
        joints = [_joint_of(label, motion.skeleton.names) for label in motion.contact_names]
        known = [(k, j) for k, j in enumerate(joints) if j is not None]
        self._contacts = motion.contacts
        ground = motion.ground_reaction
        self._points = ground.point if ground is not None and ground.bodies == motion.contact_names else None
        self._columns, self._joints = [k for k, _ in known], [j for _, j in known]
        ball = trimesh.creation.icosphere(1, radius=0.07).apply_scale([1.6, 1.6, 0.15])
        count = max(1, len(known))
        self._discs = scene.add_batched_meshes_simple(
            name, ball.vertices, ball.faces, np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3)),
            batched_scales=np.zeros(count, np.float32), batched_colors=_TOUCH, lod="off", cast_shadow=False,
        )  # fmt: skip

    def show(self, frame: int, positions: Array, visible: bool) -> None:
        self._discs.visible = visible and bool(self._joints)
        if self._joints:
            ground = positions[self._joints] * [1, 1, 0]
            if self._points is not None:
                ground = self._points[frame, self._columns]
            self._discs.batched_positions = ground.astype(np.float32)
            self._discs.batched_scales = self._contacts[frame, self._columns].astype(np.float32)


class _Forces:
    """Arrows from the centre of pressure along the force of the ground."""

    def __init__(self, scene: viser.SceneApi, name: str, forces: GroundReaction) -> None:
        self._tails = forces.point
        self._heads = forces.point + forces.force / _NEWTONS_A_METRE
        self._arrows = scene.add_arrows(name, self._at(0), _PUSH, shaft_radius=0.015, head_radius=0.035)

    def _at(self, frame: int) -> NDArray[np.float32]:
        return np.stack([self._tails[frame], self._heads[frame]], axis=1).astype(np.float32)

    def show(self, frame: int, positions: Array, visible: bool) -> None:
        self._arrows.visible = visible
        self._arrows.points = self._at(frame)


def _joint_of(label: str, names: tuple[str, ...]) -> int | None:
    """The joint whose name a contact's label begins with; the longest such name."""
    result = [n for n in names if label.lower().startswith(n.lower())]
    return names.index(max(result, key=len)) if result else None
