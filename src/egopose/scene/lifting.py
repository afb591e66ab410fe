"""3D joints from 2D keypoints: a network that has seen motion capture through many virtual cameras.

Nine frames of keypoints go in, the middle frame's joints come out (after Martinez et al. 2017). Keypoints are taken
relative to the middle of the hips and to their own spread, so a picture's place, scale and zoom do not matter. Depth is
what one picture leaves open. Where a pose network gives 3D landmarks as well, the mean of both is nearer than either.

Camera axes: x right, y down, z ahead.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import BODY_25, HUMANOID_JOINTS, other_side
from egopose.scene.poses.mending import fill_gaps
from egopose.scene.poses.track import PoseTrack

#: The joints that come out, in order: the default humanoid's.
JOINTS = (
    *("Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot"),
)
#: The keypoints that go in. COCO's layout lacks the feet; they are then unseen, as in a part of the training.
KEYPOINTS = (
    *("nose", "left_ear", "right_ear"),
    *(f"{s}_{part}" for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in ("left", "right")),
    *("left_big_toe", "right_big_toe", "left_heel", "right_heel"),
)
#: Frames of a window and their rate per second.
WINDOW, RATE = 9, 30.0
INPUTS = WINDOW * len(KEYPOINTS) * 3
#: Rows of :data:`JOINTS` and of :data:`KEYPOINTS` that lie at one place, pair by pair.
SEEN_JOINTS = tuple(JOINTS.index(joint) for joint in HUMANOID_JOINTS.values())
SEEN_KEYPOINTS = tuple(KEYPOINTS.index(name) for name in HUMANOID_JOINTS)
_HIPS = (KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip"))
_MIRROR = [KEYPOINTS.index(other_side(name)) for name in KEYPOINTS]
_OTHER = {"Left": "Right", "Right": "Left"}
_JOINT_MIRROR = [
    JOINTS.index(next((_OTHER[side] + name[len(side) :] for side in _OTHER if name.startswith(side)), name))
    for name in JOINTS
]
#: Trunk joints follow the shoulders in proportion to their height above the hips.
_TRUNK = {"Spine": 0.2, "Spine1": 0.3, "Spine2": 0.6, "Spine3": 0.85, "Neck": 1.0, "Head": 1.0}
_TRUNK |= {"RightShoulder": 1.0, "LeftShoulder": 1.0}

#: Share of the 3D landmarks in the mean: across the picture and in depth. See experiments/lifting for their choice.
LANDMARK_SHARE = (0.5, 0.5)
#: Focal length over the picture's longer side, of a telephone's main camera: 27 mm for 36 mm of film.
_FOCAL = 0.75
_HEIGHT = 1.7  # m, where nothing tells
_SURE = 0.1  # below this confidence a keypoint is unseen
_LEAST = 6  # keypoints that a frame must show
_BRIDGED = 0.3  # s: a window's length


class LiftingNetwork(nn.Module):
    """513 -> residual blocks with batch norm -> 21 joints.

    Args:
        width: of the hidden layers.
        blocks: each of two layers.
        dropout: after each hidden layer.
    """

    def __init__(self, width: int = 512, blocks: int = 2, dropout: float = 0.1) -> None:
        super().__init__()
        self.first = nn.Sequential(*_layer(INPUTS, width, dropout))
        self.blocks = nn.ModuleList(
            nn.Sequential(*_layer(width, width, dropout), *_layer(width, width, dropout)) for _ in range(blocks)
        )
        self.last = nn.Linear(width, 1 + 3 * len(JOINTS))

    def forward(self, windows: Tensor) -> Tensor:
        """Joints ``[N, 21, 3]`` in body heights, relative to the middle of the hips, of windows ``[N, 513]``.

        Across the picture a joint lies where its keypoint is, up to the scale that the network gives and a correction.
        """
        hidden = self.first(windows)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        out = self.last(hidden)
        middle = windows.unflatten(-1, (WINDOW, len(KEYPOINTS), 3))[:, WINDOW // 2]
        seen = middle[:, list(SEEN_KEYPOINTS), :2] * (0.3 * out[:, :1, None]).exp()
        joints = out[:, 1:].unflatten(-1, (len(JOINTS), 3))
        base = torch.zeros_like(joints)
        base[:, list(SEEN_JOINTS), :2] = (_SPREAD * seen).to(base.dtype)
        return joints + base


#: Body heights per unit of a window, roughly: what the network's scale is told relative to.
_SPREAD = 0.3


def _layer(size: int, width: int, dropout: float) -> list[nn.Module]:
    return [nn.Linear(size, width), nn.BatchNorm1d(width), nn.ReLU(), nn.Dropout(dropout)]


def normalised_windows(keypoints: Tensor, confidence: Tensor) -> Tensor:
    """The network's inputs.

    Each frame is centred on the middle of its hips. A window is scaled so that the root mean square of what is seen
    is 1. What is not seen stands at the centre.

    Args:
        keypoints: ``[N, 9, K, 2]``, x right, y down, any unit; the hips' are finite, seen or not.
        confidence: ``[N, 9, K]``, 0 for what is not seen.

    Returns:
        ``[N, 513]`` float32.
    """
    centre = keypoints[:, :, list(_HIPS)].mean(dim=2, keepdim=True)
    seen = (confidence > 0)[..., None]
    points = torch.where(seen, keypoints - centre, 0.0)
    count = seen.sum(dim=(1, 2, 3)).clamp(min=1)
    spread = ((points**2).sum(dim=(1, 2, 3)) / count).sqrt().clamp(min=1e-9)
    points = points / spread[:, None, None, None]
    return torch.cat([points, confidence[..., None]], dim=-1).flatten(1).float()


def mirrored_windows(windows: Tensor) -> Tensor:
    """Windows ``[N, 513]`` of the mirror image, in which left and right change places."""
    out = windows.unflatten(-1, (WINDOW, len(KEYPOINTS), 3))[:, :, _MIRROR]
    return (out * out.new_tensor([-1.0, 1.0, 1.0])).flatten(1)


def mirrored_joints(joints: Tensor) -> Tensor:
    """Joints ``[N, 21, 3]`` of the mirror image."""
    return joints[:, _JOINT_MIRROR] * joints.new_tensor([-1.0, 1.0, 1.0])


def lift(
    track: PoseTrack,
    network: LiftingNetwork,
    height: float | None = None,
    focal: float | None = None,
    landmark_share: tuple[float, float] = LANDMARK_SHARE,
) -> Array:
    """Joints ``[T, 21, 3]`` m of :data:`JOINTS` in camera axes, relative to the middle of the hips.

    Args:
        track: 2D keypoints of any layout with hips; 3D landmarks in camera axes count too where there are any.
        network: in evaluation mode, see :func:`egopose.checkpoint.lifting.load_lifting_network`.
        height: m, of the body; None: what the 3D landmarks say, or 1.7 without any.
        focal: px; None: a telephone's. It turns a pose from the line of sight into the camera's axes.
        landmark_share: of the landmarks in the mean, across the picture and in depth; 0 is the network alone.

    Returns:
        NaN in frames that show fewer than six keypoints, and in gaps longer than a window.

    Raises:
        InputError: the track has no pixels or no hips, or ``height`` or ``focal`` is not positive.
    """
    for name, value in (("height", height), ("focal", focal)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError("lift", name, f"must be positive, got {value}")
    body = fill_gaps(track.to_schema(BODY_25), _SURE)
    rows = [BODY_25.index(name) for name in KEYPOINTS]
    pixels, confidence = body.pixels[:, rows], np.where(body.filled[:, rows], 0.0, body.confidence[:, rows])
    confidence = np.where(np.isfinite(pixels).all(axis=-1) & (confidence >= _SURE), confidence, 0.0)
    known = np.flatnonzero(np.isfinite(pixels[:, list(_HIPS)]).all(axis=(1, 2)))
    if not len(known):
        raise InputError("lift", "pixels", "show no hips in any frame: keypoints of 2D poses are needed")
    # Before the first and behind the last sight of the hips they stay where they were seen.
    nearest = known[np.abs(np.arange(len(track))[:, None] - known).argmin(axis=1)]
    pixels[:, list(_HIPS)] = pixels[nearest][:, list(_HIPS)]
    pixels = np.nan_to_num(pixels)
    sight = _lines_of_sight(pixels[:, list(_HIPS)].mean(axis=1), track.image_size, focal)
    if sight is not None:
        pixels = _seen_along(sight, pixels, track.image_size, focal)
    joints = _network_joints(network, pixels, confidence, track.fps)
    landmarks = _landmark_joints(body) if track.axes == "camera" else None
    if height is None and landmarks is not None:
        height = _height_of(joints, landmarks)
    joints *= height or _HEIGHT
    if landmarks is not None:
        joints = _mean(joints, landmarks, landmark_share)
    if sight is not None:
        joints = np.einsum("tji,tkj->tki", sight, joints)
    joints[~_shown(confidence, track.fps)] = np.nan
    return np.asarray(joints)


def _network_joints(network: LiftingNetwork, pixels: Array, confidence: Array, fps: float) -> Array:
    """``[T, 21, 3]`` in body heights: the mean of what the network says of the picture and of its mirror image."""
    frames = len(pixels)
    steps = np.round((np.arange(WINDOW) - WINDOW // 2) * fps / RATE).astype(int)
    index = np.clip(np.arange(frames)[:, None] + steps, 0, frames - 1)
    windows = normalised_windows(torch.from_numpy(pixels)[index], torch.from_numpy(confidence)[index])
    with torch.no_grad():
        both = network(windows), mirrored_joints(network(mirrored_windows(windows)))
    return np.asarray(0.5 * (both[0] + both[1]).double().numpy())


def _intrinsics(size: tuple[int, int], focal: float | None) -> Array:
    f = focal or _FOCAL * max(size)
    return np.array([[f, 0.0, size[0] / 2], [0.0, f, size[1] / 2], [0.0, 0.0, 1.0]])


def _lines_of_sight(hips: Array, size: tuple[int, int] | None, focal: float | None) -> Array | None:
    """``[T, 3, 3]``: rows are the axes, in the camera's, of one that looks at the hips ``[T, 2]`` px."""
    if size is None:
        return None
    z = np.concatenate([hips, np.ones((len(hips), 1))], axis=1) @ np.linalg.inv(_intrinsics(size, focal)).T
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _seen_along(sight: Array, pixels: Array, size: tuple[int, int] | None, focal: float | None) -> Array:
    """Pixels ``[T, K, 2]`` as a camera along the line of sight has them, in focal lengths."""
    assert size is not None
    rays = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2) @ np.linalg.inv(_intrinsics(size, focal)).T
    turned = np.einsum("tij,tkj->tki", sight, rays)
    return np.asarray(turned[..., :2] / np.maximum(turned[..., 2:], 0.1))


def _landmark_joints(body: PoseTrack) -> Array | None:
    """``[T, 12, 3]`` m: 3D landmarks at :data:`SEEN_JOINTS`, relative to the middle of the hips; None without any."""
    if body.positions is None or not np.isfinite(body.positions).any():
        return None
    hips = body.positions[:, [BODY_25.index("left_hip"), BODY_25.index("right_hip")]].mean(axis=1, keepdims=True)
    return np.asarray(body.positions[:, [BODY_25.index(name) for name in HUMANOID_JOINTS]] - hips)


def _height_of(joints: Array, landmarks: Array) -> float:
    """m: by which the network's joints (body heights) are as large as the landmarks."""
    ours, theirs = np.linalg.norm(joints[:, list(SEEN_JOINTS)], axis=2), np.linalg.norm(landmarks, axis=2)
    known = np.isfinite(theirs)
    return float(np.median(theirs[known]) / max(float(np.median(ours[known])), 1e-9))


def _mean(joints: Array, landmarks: Array, share: tuple[float, float]) -> Array:
    """The joints moved towards the landmarks by a share; trunk joints without a landmark follow the shoulders."""
    away = (landmarks - joints[:, list(SEEN_JOINTS)]) * [share[0], share[0], share[1]]
    out = joints.copy()
    away = np.nan_to_num(away)
    out[:, list(SEEN_JOINTS)] += away
    shoulders = away[:, [SEEN_JOINTS.index(JOINTS.index(side + "Arm")) for side in _OTHER]].mean(axis=1)
    for name, part in _TRUNK.items():
        out[:, JOINTS.index(name)] += part * shoulders
    return out


def _shown(confidence: Array, fps: float) -> np.ndarray:
    """``[T]`` frames that show enough, or lie between two of them no more than a window apart."""
    enough = (confidence > 0).sum(axis=1) >= _LEAST
    at = np.flatnonzero(enough)
    if not len(at):
        return enough
    frames = np.arange(len(enough))
    before, after = np.searchsorted(at, frames, side="right") - 1, np.searchsorted(at, frames)
    inside = (before >= 0) & (after < len(at))
    gap = np.where(inside, at[np.minimum(after, len(at) - 1)] - at[np.maximum(before, 0)], len(enough))
    return np.asarray(enough | (inside & (gap <= _BRIDGED * fps)))
