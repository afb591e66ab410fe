"""Windows of 2D keypoints and their 3D joints, from motion capture through cameras drawn at random.

Only the turns of the joints are taken from motion capture. Bodies, parts put together, cameras and a pose estimator's
errors are drawn anew for every window, all windows at once. World: z up. Lengths are in body heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Skeleton
from egopose.scene.lifting import (
    BESIDE,
    JOINTS,
    KEYPOINTS,
    SEEN,
    WINDOW,
    mirrored_points,
    mirrored_windows,
    normalised_windows,
)
from egopose.scene.poses.keypoints import other_side

Range = tuple[float, float]
#: A point beside a joint: joint and place in its frame (x ahead, y left, z up), body heights (Winter 2009, figure 4.1).
_BESIDE = {
    "nose": ("Head", (0.065, 0.0, 0.04)),
    "left_ear": ("Head", (0.005, 0.043, 0.04)),
    "right_ear": ("Head", (0.005, -0.043, 0.04)),
    **{f"{side.lower()}_big_toe": (f"{side}Foot", (0.105, 0.0, -0.03)) for side in ("Left", "Right")},
    **{f"{side.lower()}_heel": (f"{side}Foot", (-0.03, 0.0, -0.03)) for side in ("Left", "Right")},
}
_FEET = [KEYPOINTS.index(name) for name in KEYPOINTS if name.endswith(("toe", "heel"))]
_HIPS = [KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip")]
#: Keypoints that are hidden together.
_LIMBS = [
    [k for k, name in enumerate(KEYPOINTS) if name.startswith(side) and name.endswith(parts)]
    for side in ("left", "right")
    for parts in (("elbow", "wrist"), ("knee", "ankle", "toe", "heel"))
]
_ARMS = [k for k, name in enumerate(KEYPOINTS) if name.endswith(("shoulder", "elbow", "wrist"))]
_LEGS = [k for k, name in enumerate(KEYPOINTS) if name.endswith(("hip", "knee", "ankle", "toe", "heel"))]
_MIRROR = [KEYPOINTS.index(other_side(name)) for name in KEYPOINTS]


@dataclass(frozen=True)
class SightSettings:
    """How bodies are drawn and seen; ``conf/lifter.yaml`` gives the source of every value.

    Args:
        lengths: body heights, from a joint's parent to it, where the skeleton's own proportion is not used.
        skeleton_height: m, of the skeleton.
        length_error: of the logarithm of a bone's length, among bodies.
        mixed: share of windows whose trunk and arms come from another window than their legs.
        elevation, roll: degrees, mean and deviation: of the camera above the body, and about its axis.
        distance: body heights, of the camera.
        error: mean distance of a keypoint from its joint, body heights; drawn for each window.
        lasting: share of the error's variance that lasts for a window.
        definition: share of it that is constant in the body: where an estimator's joint lies beside the skeleton's.
        dropped: share of keypoints that are not seen, each by itself.
        hidden: share of limbs that are guessed or not seen for a whole window.
        no_feet: share of windows without feet: layouts like COCO's.
        swapped: share of windows in which left and right change places in some frames.
    """

    lengths: dict[str, float]
    skeleton_height: float
    length_error: float
    mixed: float
    elevation: Range
    roll: Range
    distance: Range
    error: Range
    lasting: float
    definition: float
    dropped: float
    hidden: float
    no_feet: float
    swapped: float

    def __post_init__(self) -> None:
        if unknown := set(self.lengths) - set(JOINTS):
            raise InputError("lifter", "lengths", f"{sorted(unknown)[0]!r} is no joint; there are {', '.join(JOINTS)}")
        if self.lasting < 0 or self.definition < 0 or self.lasting + self.definition > 1:
            raise InputError("lifter", "lasting", "and definition are shares: together at most 1")
        if not (self.skeleton_height > 0 and self.distance[0] > 1):
            raise InputError("lifter", "distance", "must be over 1 body height, and skeleton_height positive")


@dataclass(frozen=True)
class Turns:
    """Joints' turns of all clips.

    Args:
        matrices: ``[F, 21, 3, 3]`` in the world, float32.
        middles: ``[N]`` frames in whose window no other clip lies.
    """

    matrices: Tensor
    middles: Tensor


def joint_turns(clips: Sequence[Motion]) -> Turns:
    """The turns of clips of the default humanoid at 30 frames/s.

    Raises:
        InputError: no clip is long enough.
    """
    matrices, middles, start = [], [], 0
    for clip in clips:
        if len(clip) < WINDOW:
            continue
        rows = [clip.skeleton.index(name) for name in JOINTS]
        matrices.append(torch.from_numpy(rot.to_matrix(clip.forward_kinematics()[1][:, rows])).float())
        middles.append(torch.arange(start + WINDOW // 2, start + len(clip) - WINDOW // 2))
        start += len(clip)
    if not matrices:
        raise InputError("lifter", "takes", f"none has {WINDOW} frames to learn from")
    return Turns(torch.cat(matrices), torch.cat(middles))


def body_offsets(humanoid: HumanoidModel, settings: SightSettings) -> Tensor:
    """``[21, 3]`` body heights: of each of :data:`JOINTS` from its parent, in the parent's frame."""
    skeleton = humanoid.skeleton
    offsets = np.array([skeleton.offsets[skeleton.index(name)] for name in JOINTS]) / settings.skeleton_height
    for name, length in settings.lengths.items():
        row = JOINTS.index(name)
        offsets[row] *= length / np.linalg.norm(offsets[row])
    return torch.from_numpy(offsets).float()


def joint_parents(skeleton: Skeleton) -> list[int]:
    """Row of each of :data:`JOINTS`'s parent; -1 for the root."""
    parents = [int(skeleton.parents[skeleton.index(name)]) for name in JOINTS]
    return [JOINTS.index(skeleton.names[p]) if p >= 0 else -1 for p in parents]


def draw_windows(
    turns: Turns,
    middles: Tensor,
    offsets: Tensor,
    parents: list[int],
    settings: SightSettings,
    random: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Windows as the network takes them and what it should say, one for each of ``middles``.

    Args:
        turns: of all clips.
        middles: ``[N]`` frames.
        offsets, parents: of the body.
        settings: of bodies, cameras and errors.
        random: of every draw.

    Returns:
        ``[N, 513]`` and ``[N, 28, 3]`` body heights in the axes of a camera that looks at the hips.
    """
    count, points = len(middles), len(KEYPOINTS)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=random)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=random)

    index = middles[:, None] + torch.arange(WINDOW) - WINDOW // 2
    matrices = _mixed(turns, index, settings.mixed, random)
    lengths = _symmetric((settings.length_error * normal(count, len(JOINTS))).exp())
    positions = _placed(matrices, offsets * lengths[..., None], parents)
    level = settings.error[0] + (settings.error[1] - settings.error[0]) * uniform(count, 1, 1)
    # A mean distance of 1 in a plane is a standard deviation of sqrt(2 / pi) an axis.
    level = level * (2 / np.pi) ** 0.5
    beside = settings.definition**0.5 * level * normal(count, points, 3)
    seen, target = _keypoints(matrices, positions, beside)
    camera = _cameras(count, settings, random)
    hips = seen[:, :, _HIPS].mean(dim=2, keepdim=True)
    target = torch.einsum("nij,nkj->nki", camera, target - hips[:, WINDOW // 2])
    seen = torch.einsum("nij,ntkj->ntki", camera, seen - hips)
    low, high = settings.distance
    depth = 1 + seen[..., 2:] / (low + (high - low) * uniform(count, 1, 1, 1))
    pictures = seen[..., :2] / depth
    size = (0.4 * normal(count, 1, points)).exp()
    hidden = torch.zeros(count, points, dtype=torch.bool)
    for limb in _LIMBS:
        hidden[:, limb] |= uniform(count, 1) < settings.hidden
    size = torch.where(hidden[:, None], 3.0 * size, size)
    along = torch.linspace(-1, 1, WINDOW)[:, None, None]
    lasting = normal(count, 1, points, 2) + 0.3 * along * normal(count, 1, points, 2)
    quick = (1 - settings.lasting - settings.definition) ** 0.5 * normal(count, WINDOW, points, 2)
    error = settings.lasting**0.5 * lasting + quick
    pictures = pictures + (level * size)[..., None] * error
    confidence = 0.9 - 0.15 * (size - 1) + 0.05 * normal(count, WINDOW, points)
    confidence = confidence.clamp(0.11, 1.0)
    unseen = uniform(count, WINDOW, points) < settings.dropped
    unseen |= (hidden & (uniform(count, 1) < 0.5))[:, None]
    unseen[:, :, _FEET] |= uniform(count, 1, 1) < settings.no_feet
    confidence = torch.where(unseen, 0.0, confidence)
    _exchange(pictures, confidence, settings.swapped, random)
    windows = normalised_windows(pictures, confidence)
    flip = uniform(count) < 0.5
    windows[flip], target[flip] = mirrored_windows(windows[flip]), mirrored_points(target[flip])
    return windows, target


def _mixed(turns: Turns, index: Tensor, share: float, random: torch.Generator) -> Tensor:
    """``[N, 9, 21, 3, 3]``: turns of the windows ``index [N, 9]``, some with another window's trunk and arms."""
    out = turns.matrices[index]
    count = len(index)
    chosen = torch.rand(count, generator=random) < share
    if not chosen.any():
        return out
    other = turns.middles[torch.randint(len(turns.middles), (int(chosen.sum()),), generator=random)]
    theirs = turns.matrices[other[:, None] + torch.arange(WINDOW) - WINDOW // 2]
    # The other trunk stands on these hips as it stood on its own.
    onto = out[chosen][:, :, :1] @ theirs[:, :, :1].transpose(-1, -2)
    upper = [k for k, name in enumerate(JOINTS) if not name.endswith(("Hips", "Leg", "Foot"))]
    mixed = out[chosen]
    mixed[:, :, upper] = onto @ theirs[:, :, upper]
    out[chosen] = mixed
    return out


def _symmetric(lengths: Tensor) -> Tensor:
    """Left bones as long as right ones."""
    left = [k for k, name in enumerate(JOINTS) if name.startswith("Left")]
    lengths[:, left] = lengths[:, [JOINTS.index("Right" + JOINTS[k][4:]) for k in left]]
    return lengths


def _placed(matrices: Tensor, offsets: Tensor, parents: list[int]) -> Tensor:
    """``[N, 9, 21, 3]``: joints relative to the root, from turns ``[N, 9, 21, 3, 3]`` and bones ``[N, 21, 3]``."""
    out = [torch.zeros(matrices.shape[0], WINDOW, 3)]
    for joint in range(1, len(parents)):
        parent = parents[joint]
        out.append(out[parent] + torch.einsum("ntij,nj->nti", matrices[:, :, parent], offsets[:, joint]))
    return torch.stack(out, dim=2)


def _keypoints(matrices: Tensor, positions: Tensor, beside: Tensor) -> tuple[Tensor, Tensor]:
    """Keypoints ``[N, 9, 19, 3]`` as an estimator defines them, and the middle frame's points ``[N, 28, 3]``."""
    joints, places = [], torch.zeros(len(KEYPOINTS), 3)
    for k, name in enumerate(KEYPOINTS):
        if name in _BESIDE:
            joint, place = _BESIDE[name]
            joints.append(JOINTS.index(joint))
            places[k] = torch.tensor(place)
        else:
            joints.append(SEEN[k])
    # An estimator's hip stays beside the pelvis when the thigh turns.
    frames = [0 if name.endswith("hip") else joint for name, joint in zip(KEYPOINTS, joints, strict=True)]
    seen = positions[:, :, joints] + torch.einsum("ntkij,nkj->ntki", matrices[:, :, frames], places + beside)
    middle = seen[:, WINDOW // 2]
    target = torch.cat([positions[:, WINDOW // 2], middle[:, : len(BESIDE)]], dim=1)
    target[:, list(SEEN)] = middle
    return seen, target


def _cameras(count: int, settings: SightSettings, random: torch.Generator) -> Tensor:
    """``[N, 3, 3]``: rows are the axes of cameras that look at the body from anywhere around."""
    azimuth = 2 * np.pi * torch.rand(count, generator=random)
    elevation, roll = (
        torch.deg2rad(mean + deviation * torch.randn(count, generator=random))
        for mean, deviation in (settings.elevation, settings.roll)
    )
    elevation = elevation.clamp(-1.2, 1.2)
    zero = torch.zeros(count)
    z = torch.stack([-elevation.cos() * azimuth.cos(), -elevation.cos() * azimuth.sin(), -elevation.sin()], dim=1)
    x = torch.stack([-azimuth.sin(), azimuth.cos(), zero], dim=1)
    y = torch.linalg.cross(z, x)
    c, s = roll.cos()[:, None], roll.sin()[:, None]
    return torch.stack([c * x + s * y, c * y - s * x, z], dim=1)


def _exchange(pictures: Tensor, confidence: Tensor, share: float, random: torch.Generator) -> None:
    """Left and right change places, in place: in some frames of some windows, of the whole body, arms or legs."""
    count = len(pictures)
    chosen = torch.rand(count, generator=random) < share
    begin = torch.randint(WINDOW, (count, 1), generator=random)
    length = torch.randint(1, 5, (count, 1), generator=random)
    time = torch.arange(WINDOW)
    frames = chosen[:, None] & (time >= begin) & (time < begin + length)
    kind = torch.randint(3, (count, 1), generator=random)
    for number, rows in enumerate((list(range(len(KEYPOINTS))), _ARMS, _LEGS)):
        n, t = torch.nonzero(frames & (kind == number), as_tuple=True)
        if len(n):
            twins = [_MIRROR[k] for k in rows]
            for values in (pictures, confidence):
                there = values[n, t]
                there[:, rows] = there[:, twins]
                values[n, t] = there
