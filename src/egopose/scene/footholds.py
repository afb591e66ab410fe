"""Feet that stand do not slide, and no foot sinks: the poses of a film solved again with the soles on their footholds.

Lifted poses tremble and stretch, so that feet slide at a metre a second under a root that is in the right place. No
body can do that. All frames are solved at once for the body's points, soles on their footholds, and smoothness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.foot_geometry import sole_corners, sole_edges
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.smooth_inverse_kinematics import Smoothness, solve_smooth
from egopose.scene.root import Support

_DEEP = 0.002  # m: a corner that is less deep is on the ground
_BESIDE = 0.03  # m from a box's edge


@dataclass(frozen=True)
class FootholdSettings:
    """Weights against each other.

    Args:
        stands: of a sole's point that stands.
        body: of the body's other points, which are a few centimetres off.
        turn: m/rad, of the root's rotation.
        lift: m: of a standing foot's heel and ball, one that is this much higher than the other hardly stands.
        hinges, root: what accelerations cost, see :class:`~egopose.motion.smooth_inverse_kinematics.Smoothness`.
        iterations: of the solver.
        clear: of a sole's corner that was in the ground, at the ground's height.
        rounds: of the solver; after each but the last, corners in the ground are found.
    """

    stands: float = 2.0
    body: float = 0.3
    turn: float = 0.2
    lift: float = 0.05
    hinges: float = 0.0007
    root: float = 0.002
    iterations: int = 8
    clear: float = 1.0
    rounds: int = 3


@dataclass(frozen=True)
class BoxTops:
    """Upper faces of boxes: centres ``tops [K, 3]`` m, ``headings [K]`` rad and ``sizes [K, 2]`` m."""

    tops: Array
    headings: Array
    sizes: Array

    def heights(self, points: Array) -> Array:
        """``[...]`` m of what is under ``points [..., 2]`` m: the highest box there, or the floor.

        A point a little beside a box counts as over it: feet are not placed to the centimetre.
        """
        away = points[..., None, :] - self.tops[:, :2]
        cos, sin = np.cos(self.headings), np.sin(self.headings)
        along = np.abs(cos * away[..., 0] + sin * away[..., 1])
        across = np.abs(cos * away[..., 1] - sin * away[..., 0])
        over = (along <= 0.5 * self.sizes[:, 0] + _BESIDE) & (across <= 0.5 * self.sizes[:, 1] + _BESIDE)
        return np.asarray(np.where(over, self.tops[:, 2], 0.0).max(axis=-1, initial=0.0))


def on_footholds(
    humanoid: HumanoidModel,
    motion: Motion,
    supports: Sequence[Support],
    trust: Array,
    settings: FootholdSettings | None = None,
    boxes: BoxTops | None = None,
) -> Motion:
    """The motion with its standing soles where they stand and no sole in what is below it, and smooth.

    Args:
        humanoid: whose skeleton the motion is on.
        motion: in the world.
        supports: of its feet; a foot is 0 for the right and 1 for the left.
        trust: ``[T]`` how far each frame is to be believed, 0 to 1.
        settings: see :class:`FootholdSettings`; None for its own values.
        boxes: that feet pass over or beside; None where their places are not known.
    """
    settings = settings or FootholdSettings()
    corners, joints, offsets = _soles(humanoid, motion)
    goal, weight = corners.copy(), np.zeros(corners.shape[:3])
    for support in supports:
        span, foot = slice(support.start, support.stop), support.foot
        part = corners[span, foot]
        # Of heel and ball, not of each corner: a foot that is tilted to a side stands on both.
        ends = np.repeat(part[..., 2].reshape(len(part), 2, 2).mean(axis=2), 2, axis=1)
        stands = np.exp(-(ends - ends.min(axis=1, keepdims=True)) / settings.lift)
        place = (stands[..., None] * part).sum(axis=0) / stands.sum(axis=0)[:, None]
        goal[span, foot, :, :2], goal[span, foot, :, 2] = place[:, :2], support.height
        weight[span, foot] = settings.stands * stands
    positions, quats = motion.forward_kinematics()
    bodies = positions.shape[1]
    lowest = _ground(len(motion), supports)[..., None]
    qpos = motion.qpos
    for _ in range(settings.rounds):
        targets = Targets(
            point_joint=np.concatenate([joints, np.arange(bodies)]),
            point_offset=np.concatenate([offsets, np.zeros((bodies, 3))]),
            positions=np.concatenate([goal.reshape(len(motion), -1, 3), positions], axis=1),
            position_weight=np.concatenate(
                [
                    weight.reshape(len(motion), -1),
                    settings.body * np.sqrt(trust)[:, None] * np.ones(bodies),
                ],
                axis=1,
            ),
            frame_joint=np.array([0]),
            orientations=quats[:, :1],
            orientation_weight=np.array([settings.turn]),
        )
        qpos = solve_smooth(
            motion.skeleton,
            qpos,
            targets,
            motion.fps,
            Smoothness(settings.hinges, settings.root),
            limits=humanoid.joint_range,
            iterations=settings.iterations,
        )
        # A point of the sole that has sunk is held where it is, at the ground's height.
        found = _soles(humanoid, replace(motion, qpos=qpos))[0]
        ground = lowest if boxes is None else np.maximum(lowest, boxes.heights(found[..., :2]))
        sunk = (found[..., 2] < ground - _DEEP) | (weight == settings.clear)
        new = sunk & (weight < settings.clear)
        goal = np.where(new[..., None], np.stack([*np.moveaxis(found[..., :2], -1, 0), ground + 0 * weight], -1), goal)
        weight = np.where(new, settings.clear, weight)
    qpos = qpos.copy()
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    return replace(motion, qpos=qpos)


def _soles(humanoid: HumanoidModel, motion: Motion) -> tuple[Array, NDArray[np.intp], Array]:
    """Corners ``[T, 2, 4, 3]`` m of the right and the left sole, two of the heel first.

    Also the joint ``[8]`` and the place ``[8, 3]`` m in its frame of each.
    """
    joints, offsets = sole_corners(humanoid)
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    order = [names.index(name) for name in ("RightFoot", "LeftFoot")]
    corners = sole_edges(humanoid, motion).reshape(len(motion), len(names), 4, 3)[:, order]
    return corners, joints.reshape(-1, 4)[order].ravel(), offsets.reshape(-1, 4, 3)[order].reshape(-1, 3)


def _ground(frames: int, supports: Sequence[Support]) -> Array:
    """``[T, 2]`` m: what the right and the left foot are above: the lower of what it stood on and will stand on.

    A foot that never stands may be anywhere.
    """
    ground = np.full((frames, 2), -np.inf)
    for foot in (0, 1):
        own = sorted((s for s in supports if s.foot == foot), key=lambda s: s.start)
        edges = [0, *[s.start for s in own[1:]], frames]
        for k, support in enumerate(own):
            ground[edges[k] : edges[k + 1], foot] = support.height
            if k + 1 < len(own):
                ground[support.stop : own[k + 1].start, foot] = min(support.height, own[k + 1].height)
    return ground
