"""Feet that stand do not slide: the poses of a film solved again so that standing soles stay where they are.

Lifted poses tremble and stretch, so that feet slide at a metre a second under a root that is in the right place. No
body can do that. All frames are solved at once for the body's points, soles on their footholds, and smoothness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.smooth_inverse_kinematics import Smoothness, solve_smooth
from egopose.scene.root import Support


@dataclass(frozen=True)
class FootholdSettings:
    """Weights against each other.

    Args:
        stands: of a sole's point that stands.
        body: of the body's other points, which are a few centimetres off.
        turn: m/rad, of the root's rotation.
        lift: m: of a standing foot's two points, one that is this much higher than the other hardly stands.
        hinges, root: what accelerations cost, see :class:`~egopose.motion.smooth_inverse_kinematics.Smoothness`.
        iterations: of the solver.
    """

    stands: float = 2.0
    body: float = 0.3
    turn: float = 0.2
    lift: float = 0.05
    hinges: float = 0.0007
    root: float = 0.002
    iterations: int = 8


def on_footholds(
    humanoid: HumanoidModel,
    motion: Motion,
    supports: Sequence[Support],
    trust: Array,
    settings: FootholdSettings | None = None,
) -> Motion:
    """The motion with its standing soles where they stand, and smooth.

    Args:
        humanoid: whose skeleton the motion is on.
        motion: in the world.
        supports: of its feet; a foot is 0 for the right and 1 for the left.
        trust: ``[T]`` how far each frame is to be believed, 0 to 1.
        settings: see :class:`FootholdSettings`; None for its own values.
    """
    settings = settings or FootholdSettings()
    names = [humanoid.skeleton.names[foot] for foot in humanoid.feet]
    order = [names.index(name) for name in ("RightFoot", "LeftFoot")]
    soles = sole_positions(humanoid, motion).reshape(len(motion), len(names), 2, 3)[:, order]
    goal, weight = soles.copy(), np.zeros(soles.shape[:3])
    for support in supports:
        span, foot = slice(support.start, support.stop), support.foot
        part = soles[span, foot]
        stands = np.exp(-(part[..., 2] - part[..., 2].min(axis=1, keepdims=True)) / settings.lift)
        place = (stands[..., None] * part).sum(axis=0) / stands.sum(axis=0)[:, None]
        goal[span, foot, :, :2], goal[span, foot, :, 2] = place[:, :2], support.height
        weight[span, foot] = settings.stands * stands
    positions, quats = motion.forward_kinematics()
    bodies = positions.shape[1]
    joints = np.repeat(np.array([humanoid.feet[k] for k in order]), 2)
    offsets = np.concatenate([humanoid.sole_points[k] for k in order])
    body_weight = settings.body * np.sqrt(trust)[:, None] * np.ones(bodies)
    targets = Targets(
        point_joint=np.concatenate([joints, np.arange(bodies)]),
        point_offset=np.concatenate([offsets, np.zeros((bodies, 3))]),
        positions=np.concatenate([goal.reshape(len(motion), -1, 3), positions], axis=1),
        position_weight=np.concatenate([weight.reshape(len(motion), -1), body_weight], axis=1),
        frame_joint=np.array([0]),
        orientations=quats[:, :1],
        orientation_weight=np.array([settings.turn]),
    )
    qpos = solve_smooth(
        motion.skeleton,
        motion.qpos,
        targets,
        motion.fps,
        Smoothness(settings.hinges, settings.root),
        limits=humanoid.joint_range,
        iterations=settings.iterations,
    )
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    return replace(motion, qpos=qpos)
