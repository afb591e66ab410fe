"""Motion capture of a flat floor lifted onto boxes: heights of feet, hands and pelvis change, the limbs follow.

A stance is a time in which a foot or a hand stands. Each stance gets the height of what it is to stand on. Between
stances a foot rises early and sinks late, so that it clears a box's edge. The pelvis rises with the mean height under
all that stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.foot_geometry import sole_edges, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.contacts import without_short_runs
from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton
from egopose.scene.scene_file import Box

#: Share of a swing in which a foot rises to what it has to clear, and in which it sinks from it.
_RISEN = 0.45
#: s, standard deviation of the smoothing of the pelvis's height.
_SMOOTH = 0.12
#: Frames: shorter stances are noise; and in so many a hand that does not stand yet, or any more, is let go.
_SHORTEST, _LET_GO = 3, 6
#: m/s and m: hands that are slower and lower stand. They roll over what they stand on.
_HAND_SPEED, _HAND_LOWNESS = 1.3, 0.08
_HANDS = ("RightHand", "LeftHand")
#: In inverse kinematics soles count fully and the pelvis ten times that; m per rad of staying.
_PELVIS, _STAY = 10.0, 0.01


@dataclass(frozen=True)
class Stance:
    """A limb that stands in frames ``start .. stop - 1``: of ``humanoid.feet``, then the right and the left hand."""

    limb: int
    start: int
    stop: int


@dataclass(frozen=True)
class Platform:
    """A box to be put under the feet that stand in some frames.

    Args:
        name: of the box.
        first, last: frames; stances whose middle lies in them are on it.
        height: m, of its upper face.
        margin: m, around the soles, along and across the box.
        yaw: rad, of the box's own x.
        limb: only this one's stances; None for all.
    """

    name: str
    first: int
    last: int
    height: float
    margin: tuple[float, float]
    yaw: float = 0.0
    limb: int | None = None

    def under(self, stance: Stance) -> bool:
        """Whether the stance is on it."""
        return self.first <= 0.5 * (stance.start + stance.stop - 1) <= self.last and self.limb in (None, stance.limb)


def limb_points(humanoid: HumanoidModel, motion: Motion) -> list[Array]:
    """``[T, P, 3]`` m of each foot's heel and ball, then of each hand's tip: what stands."""
    feet = sole_positions(humanoid, motion)
    positions, quats = motion.forward_kinematics()
    tips = [
        positions[:, hand, None] + rot.rotate(quats[:, hand], tip[None])[:, None]
        for hand, tip in zip(*_hands(motion.skeleton), strict=True)
    ]
    return [*np.split(feet, len(humanoid.feet), axis=1), *tips]


def _hands(skeleton: Skeleton) -> tuple[list[int], list[Array]]:
    """Joints of the hands, and their tips in them (m)."""
    rows = [skeleton.index(name) for name in _HANDS]
    return rows, [np.array(skeleton.joints[row].tips[0]) for row in rows]


def stances(
    humanoid: HumanoidModel,
    motion: Motion,
    speed: float = 0.35,
    lowness: float | None = 0.06,
    hands: bool = False,
) -> list[Stance]:
    """When feet stand: heel or ball is slow, and low over z = 0 where the floor is flat.

    Args:
        humanoid: whose motion it is.
        motion: on its skeleton.
        speed: m/s, a point that is slower stands.
        lowness: m, it must also be lower than this; None where the motion is not on a flat floor.
        hands: whether hands stand, too.
    """
    out = []
    for limb, points in enumerate(limb_points(humanoid, motion)):
        hand = limb >= len(humanoid.feet)
        if hand and not hands:
            break
        standing = np.linalg.norm(np.gradient(points, axis=0), axis=2) * motion.fps < (_HAND_SPEED if hand else speed)
        if lowness is not None:
            standing &= points[..., 2] < (_HAND_LOWNESS if hand else lowness)
        runs = standing.any(axis=1, keepdims=True)
        runs = ~without_short_runs(~without_short_runs(runs, _SHORTEST), _SHORTEST)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], runs[:, 0].astype(np.int8), [0]])))
        out += [Stance(limb, int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return sorted(out, key=lambda stance: (stance.start, stance.limb))


def lifted(humanoid: HumanoidModel, motion: Motion, standing: Sequence[Stance], heights: Sequence[float]) -> Motion:
    """The motion with each stance at its height, m over where it was.

    Raises:
        ValueError: nothing ever stands.
    """
    if not standing:
        raise ValueError("nothing ever stands")
    frames, feet = len(motion), len(humanoid.feet)
    qpos = motion.qpos.copy()
    qpos[:, 2] += _pelvis_height(frames, motion.fps, standing, heights)
    joints, offsets = [*humanoid.feet.tolist()], list(humanoid.sole_points)
    for hand, tip in zip(*_hands(motion.skeleton), strict=True):
        joints.append(hand)
        offsets.append(tip[None])
    goals, weights = [], []
    for limb, points in enumerate(limb_points(humanoid, motion)):
        goals.append(points + [[[0.0, 0.0, 1.0]]] * _limb_height(frames, limb, standing, heights)[:, None, None])
        held = np.ones(frames) if limb < feet else _held(frames, limb, standing)
        weights.append(np.repeat(held[:, None], points.shape[1], axis=1))
    targets = Targets(
        point_joint=np.concatenate([*(np.full(len(o), j) for j, o in zip(joints, offsets, strict=True)), [0]]),
        point_offset=np.concatenate([*offsets, np.zeros((1, 3))]),
        positions=np.concatenate([*goals, qpos[:, None, :3]], axis=1),
        position_weight=np.concatenate([*weights, np.full((frames, 1), _PELVIS)], axis=1),
        frame_joint=np.array([0]),
        orientations=qpos[:, None, 3:7],
        orientation_weight=np.array([_PELVIS]),
    )
    solved = solve(motion.skeleton, qpos, targets, humanoid.joint_range, stay=_STAY)
    return Motion(motion.skeleton, solved, motion.fps, motion.name)


def _held(frames: int, limb: int, standing: Sequence[Stance]) -> Array:
    """``[T]``: 1 while a hand stands, less the further from that, and 0 for one that does not stand."""
    out = np.zeros(frames)
    for stance in standing:
        if stance.limb == limb:
            away = np.maximum(stance.start - np.arange(frames), np.arange(frames) - stance.stop + 1)
            out = np.maximum(out, _smooth_step(1 - away / _LET_GO))
    return out


def _limb_height(frames: int, limb: int, standing: Sequence[Stance], heights: Sequence[float]) -> Array:
    """``[T]`` m: constant in a stance, a smooth step between two."""
    own = [(s, h) for s, h in zip(standing, heights, strict=True) if s.limb == limb]
    out = np.zeros(frames)
    if not own:
        return out
    out[: own[0][0].stop], out[own[-1][0].start :] = own[0][1], own[-1][1]
    for (one, low), (other, high) in pairwise(own):
        swing = np.arange(one.stop - 1, other.start + 1)
        share = (swing - swing[0]) / max(swing[-1] - swing[0], 1)
        # What another limb stands on meanwhile lies on the way.
        passed = [h for s, h in zip(standing, heights, strict=True) if s.start < other.start and s.stop > one.stop]
        peak = max(low, high, *passed)
        out[swing] = peak - (peak - low) * _smooth_step(1 - share / _RISEN)
        out[swing] -= (peak - high) * _smooth_step(1 - (1 - share) / _RISEN)
        out[other.start : other.stop] = high
    return out


def _smooth_step(share: Array) -> Array:
    """From 0 to 1 without a jump in speed; held beyond."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share**2 * (3 - 2 * share))


def _pelvis_height(frames: int, fps: float, standing: Sequence[Stance], heights: Sequence[float]) -> Array:
    """``[T]`` m: the mean height under all that stands, straight lines between, smoothed."""
    total, count = np.zeros(frames), np.zeros(frames)
    for stance, height in zip(standing, heights, strict=True):
        total[stance.start : stance.stop] += height
        count[stance.start : stance.stop] += 1
    known = np.flatnonzero(count)
    line = np.interp(np.arange(frames), known, total[known] / count[known])
    return gaussian_filter1d(line, _SMOOTH * fps, mode="nearest")


def boxes_under(
    humanoid: HumanoidModel, motion: Motion, standing: Sequence[Stance], platforms: Sequence[Platform]
) -> list[Box]:
    """Boxes around the soles and the hands' tips of the stances on each platform.

    Raises:
        ValueError: nothing stands on a platform.
    """
    edges = np.split(sole_edges(humanoid, motion), len(humanoid.feet), axis=1)
    corners = [*edges, *limb_points(humanoid, motion)[len(edges) :]]
    out = []
    for platform in platforms:
        soles = [corners[s.limb][s.start : s.stop, :, :2].reshape(-1, 2) for s in standing if platform.under(s)]
        if not soles:
            raise ValueError(f"nothing stands on {platform.name}")
        ahead = np.array([np.cos(platform.yaw), np.sin(platform.yaw)])
        axes = np.stack([ahead, [-ahead[1], ahead[0]]])
        spots = np.concatenate(soles) @ axes.T
        low, high = spots.min(axis=0) - platform.margin, spots.max(axis=0) + platform.margin
        place = 0.5 * (low + high) @ axes
        out.append(
            Box(
                platform.name,
                (round(float(high[0] - low[0]), 3), round(float(high[1] - low[1]), 3)),
                (round(float(place[0]), 3), round(float(place[1]), 3)),
                platform.height,
                platform.yaw,
            )
        )
    return out
