"""Feet that stand do not slide, no foot sinks, hands hold: the poses of a film solved again with soles on footholds.

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
from egopose.scene.handholds import Handhold, hands_of
from egopose.scene.root import Support
from egopose.scene.standing import in_box_axes

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
        holds: of a hand that holds; as much as the poses themselves, which are a decimetre off there.
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
    holds: float = 0.3
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
        along, across = in_box_axes(away, self.headings)
        reach = 0.5 * self.sizes + _BESIDE
        over = (np.abs(along) <= reach[:, 0]) & (np.abs(across) <= reach[:, 1])
        return np.asarray(np.where(over, self.tops[:, 2], 0.0).max(axis=-1, initial=0.0))


def on_footholds(
    humanoid: HumanoidModel,
    motion: Motion,
    supports: Sequence[Support],
    trust: Array,
    settings: FootholdSettings | None = None,
    boxes: BoxTops | None = None,
    holds: Sequence[tuple[Handhold, Array]] = (),
) -> Motion:
    """The motion with its standing soles where they stand and no sole in what is below it, and smooth.

    Args:
        humanoid: whose skeleton the motion is on.
        motion: in the world.
        supports: of its feet; a foot is 0 for the right and 1 for the left.
        trust: ``[T]`` how far each frame is to be believed, 0 to 1.
        settings: see :class:`FootholdSettings`; None for its own values.
        boxes: that feet pass over or beside; None where their places are not known.
        holds: of its hands, each with the place ``[3]`` m of the hand's middle.
    """
    settings = settings or FootholdSettings()
    corners = _soles(humanoid, motion)
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
    lowest, held = _ground(len(motion), supports)[..., None], _held(len(motion), holds, settings.holds)
    qpos = _solved(humanoid, motion, motion.qpos, (goal, weight), held, trust, settings)
    for _ in range(settings.rounds - 1):
        # A point of the sole that has sunk is held where it is, at the ground's height.
        found = _soles(humanoid, replace(motion, qpos=qpos))
        ground = np.broadcast_to(lowest, weight.shape)
        if boxes is not None:
            ground = np.maximum(ground, boxes.heights(found[..., :2]))
        sunk = (found[..., 2] < ground - _DEEP) & (weight < settings.clear)
        raised = np.concatenate([found[..., :2], ground[..., None]], axis=-1)
        goal, weight = np.where(sunk[..., None], raised, goal), np.where(sunk, settings.clear, weight)
        qpos = _solved(humanoid, motion, qpos, (goal, weight), held, trust, settings)
    qpos = qpos.copy()
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    return replace(motion, qpos=qpos)


def _solved(
    humanoid: HumanoidModel,
    motion: Motion,
    start: Array,
    soles: tuple[Array, Array],
    hands: tuple[Array, Array],
    trust: Array,
    settings: FootholdSettings,
) -> Array:
    """``[T, nq]``, solved from ``start``: soles and hands at their places, the body near the motion's own.

    ``soles`` are places ``[T, 2, 4, 3]`` m and weights ``[T, 2, 4]``, ``hands`` places ``[T, 2, 3]`` and ``[T, 2]``.
    """
    (goal, weight), (grip, grip_weight), middles = soles, hands, hands_of(humanoid)
    positions, quats = motion.forward_kinematics()
    frames, bodies = positions.shape[:2]
    joints, offsets = (part.reshape(-1, *part.shape[2:]) for part in _corners(humanoid))
    of_bodies = settings.body * np.sqrt(trust)[:, None] * np.ones(bodies)
    targets = Targets(
        point_joint=np.concatenate([joints, middles.joints, np.arange(bodies)]),
        point_offset=np.concatenate([offsets, middles.offsets, np.zeros((bodies, 3))]),
        positions=np.concatenate([goal.reshape(frames, -1, 3), grip, positions], axis=1),
        position_weight=np.concatenate([weight.reshape(frames, -1), grip_weight, of_bodies], axis=1),
        frame_joint=np.array([0]),
        orientations=quats[:, :1],
        orientation_weight=np.array([settings.turn]),
    )
    return solve_smooth(
        motion.skeleton,
        start,
        targets,
        motion.fps,
        Smoothness(settings.hinges, settings.root),
        limits=humanoid.joint_range,
        iterations=settings.iterations,
    )


def _held(frames: int, holds: Sequence[tuple[Handhold, Array]], weight: float) -> tuple[Array, Array]:
    """Places ``[T, 2, 3]`` m of hands, and weights ``[T, 2]``."""
    places, weights = np.zeros((frames, 2, 3)), np.zeros((frames, 2))
    for hold, place in holds:
        places[hold.start : hold.stop, hold.hand], weights[hold.start : hold.stop, hold.hand] = place, weight
    return places, weights


def _soles(humanoid: HumanoidModel, motion: Motion) -> Array:
    """Corners ``[T, 2, 4, 3]`` m of the right and the left sole, two of the heel first."""
    return sole_edges(humanoid, motion).reshape(len(motion), -1, 4, 3)[:, _order(humanoid)]


def _corners(humanoid: HumanoidModel) -> tuple[NDArray[np.intp], Array]:
    """The joint ``[2, 4]`` of each point of :func:`_soles`, and its place ``[2, 4, 3]`` m in the joint's frame."""
    joints, offsets = sole_corners(humanoid)
    order = _order(humanoid)
    return joints.reshape(-1, 4)[order], offsets.reshape(-1, 4, 3)[order]


def _order(humanoid: HumanoidModel) -> list[int]:
    """Of the humanoid's feet: the right one, the left one."""
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    return [names.index(name) for name in ("RightFoot", "LeftFoot")]


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
