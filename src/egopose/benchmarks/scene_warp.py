"""Motion capture of a flat floor lifted onto boxes: the feet's heights and the pelvis's change, the legs follow.

A stance is a time in which a foot stands. Each stance gets the height of what it is to stand on. Between stances a foot
rises early and sinks late, so that it clears a box's edge. The pelvis rises with the mean height under the feet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.foot_geometry import sole_edges, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.contacts import without_short_runs
from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.scene_file import Box

#: Share of a swing in which a foot rises to what it has to clear, and in which it sinks from it.
_RISEN = 0.45
#: s, standard deviation of the smoothing of the pelvis's height.
_SMOOTH = 0.12
#: Frames: shorter stances are noise.
_SHORTEST = 3
#: In inverse kinematics soles count fully and the pelvis ten times that; m per rad of staying.
_PELVIS, _STAY = 10.0, 0.01


@dataclass(frozen=True)
class Stance:
    """A foot that stands in frames ``start .. stop - 1``; ``foot`` is its index in ``humanoid.feet``."""

    foot: int
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
        foot: only this one's stances; None for both.
    """

    name: str
    first: int
    last: int
    height: float
    margin: tuple[float, float]
    yaw: float = 0.0
    foot: int | None = None

    def under(self, stance: Stance) -> bool:
        """Whether the stance is on it."""
        return self.first <= 0.5 * (stance.start + stance.stop - 1) <= self.last and self.foot in (None, stance.foot)


def stances(humanoid: HumanoidModel, motion: Motion, speed: float = 0.35, lowness: float | None = 0.06) -> list[Stance]:
    """When feet stand: heel or ball is slow, and low over z = 0 where the floor is flat.

    Args:
        humanoid: whose motion it is.
        motion: on its skeleton.
        speed: m/s, a point that is slower stands.
        lowness: m, it must also be lower than this; None where the motion is not on a flat floor.
    """
    points = sole_positions(humanoid, motion)
    slow = np.linalg.norm(np.gradient(points, axis=0), axis=2) * motion.fps < speed
    if lowness is not None:
        slow &= points[..., 2] < lowness
    standing = slow.reshape(len(motion), len(humanoid.feet), -1).any(axis=2)
    standing = ~without_short_runs(~without_short_runs(standing, _SHORTEST), _SHORTEST)
    out = []
    for foot in range(len(humanoid.feet)):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], standing[:, foot].astype(np.int8), [0]])))
        out += [Stance(foot, int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return sorted(out, key=lambda stance: (stance.start, stance.foot))


def lifted(humanoid: HumanoidModel, motion: Motion, standing: Sequence[Stance], heights: Sequence[float]) -> Motion:
    """The motion with each stance at its height, m over where it was.

    Raises:
        ValueError: no foot ever stands.
    """
    if not standing:
        raise ValueError("no foot ever stands")
    frames = len(motion)
    feet = np.stack([_foot_height(frames, k, standing, heights) for k in range(len(humanoid.feet))], axis=1)
    pelvis = _pelvis_height(frames, motion.fps, standing, heights)
    qpos = motion.qpos.copy()
    qpos[:, 2] += pelvis
    goal = sole_positions(humanoid, motion)
    points = goal.shape[1] // len(humanoid.feet)
    goal[..., 2] += np.repeat(feet, points, axis=1)
    targets = Targets(
        point_joint=np.concatenate([np.repeat(humanoid.feet, points), [0]]),
        point_offset=np.concatenate([humanoid.sole_points.reshape(-1, 3), np.zeros((1, 3))]),
        positions=np.concatenate([goal, qpos[:, None, :3]], axis=1),
        position_weight=np.array([1.0] * goal.shape[1] + [_PELVIS]),
        frame_joint=np.array([0]),
        orientations=qpos[:, None, 3:7],
        orientation_weight=np.array([_PELVIS]),
    )
    solved = solve(motion.skeleton, qpos, targets, humanoid.joint_range, stay=_STAY)
    return Motion(motion.skeleton, solved, motion.fps, motion.name)


def _foot_height(frames: int, foot: int, standing: Sequence[Stance], heights: Sequence[float]) -> Array:
    """``[T]`` m: constant in a stance, a smooth step between two."""
    own = [(s, h) for s, h in zip(standing, heights, strict=True) if s.foot == foot]
    out = np.zeros(frames)
    if not own:
        return out
    out[: own[0][0].stop], out[own[-1][0].start :] = own[0][1], own[-1][1]
    for (one, low), (other, high) in pairwise(own):
        swing = np.arange(one.stop - 1, other.start + 1)
        share = (swing - swing[0]) / max(swing[-1] - swing[0], 1)
        # What the other foot stands on meanwhile lies on the way.
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
    """``[T]`` m: the mean height under the feet that stand, straight lines between, smoothed."""
    total, count = np.zeros(frames), np.zeros(frames)
    for stance, height in zip(standing, heights, strict=True):
        total[stance.start : stance.stop] += height
        count[stance.start : stance.stop] += 1
    known = np.flatnonzero(count)
    line = np.interp(np.arange(frames), known, total[known] / count[known])
    return gaussian_filter1d(line, _SMOOTH * fps, mode="nearest")


def platform_of(stance: Stance, platforms: Sequence[Platform]) -> Platform | None:
    """The platform under a stance; None for the floor."""
    return next((platform for platform in platforms if platform.under(stance)), None)


def boxes_under(
    humanoid: HumanoidModel, motion: Motion, standing: Sequence[Stance], platforms: Sequence[Platform]
) -> list[Box]:
    """Boxes around the soles of the stances on each platform.

    Raises:
        ValueError: nothing stands on a platform.
    """
    corners = sole_edges(humanoid, motion).reshape(len(motion), len(humanoid.feet), -1, 3)
    out = []
    for platform in platforms:
        soles = [corners[s.start : s.stop, s.foot, :, :2].reshape(-1, 2) for s in standing if platform.under(s)]
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


def turned(motion: Motion, angle: float, place: NDArray[np.floating]) -> Motion:
    """The motion turned about the vertical by ``angle`` (rad), then moved by ``place [2]`` (m)."""
    turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(angle))
    qpos = motion.qpos.copy()
    qpos[:, :3] = rot.rotate(turn, qpos[:, :3])
    qpos[:, :2] += place
    qpos[:, 3:7] = rot.multiply(turn, qpos[:, 3:7])
    return Motion(motion.skeleton, qpos, motion.fps, motion.name)
