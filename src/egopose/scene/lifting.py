"""3D points from 2D keypoints: a network that has seen motion capture through many virtual cameras.

Nine frames of keypoints go in, the middle frame's points come out (after Martinez et al. 2017). Keypoints are taken
relative to the middle of the hips and to their own spread, so a picture's place, scale and zoom do not matter. Depth is
what one picture leaves open. Where a pose network gives 3D landmarks as well, the mean of both is nearer than either.

Axes: x right, y down, z ahead, of a camera that looks straight at the hips. Pose networks see a cut-out around the
person, so their landmarks have these axes too. :func:`camera_axes` turns them into the camera's own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import binary_closing
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import BODY_25, HUMANOID_JOINTS, STAND_INS, other_side
from egopose.scene.poses.mending import fill_gaps
from egopose.scene.poses.track import PoseTrack

#: The joints that come out, in order: the default humanoid's.
JOINTS = (
    *("Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot"),
)
#: Points of face and feet that come out behind them.
BESIDE = ("nose", "left_ear", "right_ear", "left_big_toe", "right_big_toe", "left_heel", "right_heel")
POINTS = (*JOINTS, *BESIDE)
#: The keypoints that go in. COCO's layout lacks the feet; they are then unseen, as in a part of the training.
KEYPOINTS = (
    *("nose", "left_ear", "right_ear"),
    *(f"{s}_{part}" for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in ("left", "right")),
    *("left_big_toe", "right_big_toe", "left_heel", "right_heel"),
)
#: Frames of a window and their rate per second.
WINDOW, RATE = 9, 30.0
INPUTS = WINDOW * len(KEYPOINTS) * 3
#: Of each keypoint, its row among :data:`POINTS`.
SEEN = tuple(POINTS.index(HUMANOID_JOINTS.get(name, name)) for name in KEYPOINTS)
_HIPS = (KEYPOINTS.index("left_hip"), KEYPOINTS.index("right_hip"))
_MIRROR = [KEYPOINTS.index(other_side(name)) for name in KEYPOINTS]


def _twin(name: str) -> str:
    """The point of the other side: ``LeftArm`` of ``RightArm``, ``left_ear`` of ``right_ear``."""
    pair = next((pair for pair in (("Left", "Right"), ("Right", "Left")) if name.startswith(pair[0])), None)
    return other_side(name) if pair is None else pair[1] + name[len(pair[0]) :]


_POINT_MIRROR = [POINTS.index(_twin(name)) for name in POINTS]
#: Trunk joints follow the shoulders in proportion to their height above the hips.
_TRUNK = {"Spine": 0.2, "Spine1": 0.3, "Spine2": 0.6, "Spine3": 0.85, "Neck": 1.0, "Head": 1.0}
_TRUNK |= {"RightShoulder": 1.0, "LeftShoulder": 1.0}

#: Share of the 3D landmarks in the mean: across the picture and in depth. Chosen on BlazePose in experiments/lifting.
LANDMARK_SHARE = (0.25, 0.75)
#: Focal length over the picture's longer side, of a telephone's main camera: 27 mm for 36 mm of film.
_FOCAL = 0.75
#: Body heights per unit of a window, roughly: what the network's scale is told relative to.
_SPREAD = 0.33
_HEIGHT = 1.7  # m, where nothing tells
_SURE = 0.1  # below this confidence a keypoint is unseen
_LEAST = 6  # keypoints that a frame must show
_BRIDGED = 0.3  # s, a window's length: gaps shorter than that are interpolated
_GUESSED = 0.5  # confidence of what was interpolated


class LiftingNetwork(nn.Module):
    """513 -> residual blocks with batch norm -> 28 points.

    Args:
        width: of the hidden layers.
        blocks: each of two layers.
        dropout: after each hidden layer.
    """

    def __init__(self, width: int = 384, blocks: int = 2, dropout: float = 0.1) -> None:
        super().__init__()
        self.first = nn.Sequential(*_layer(INPUTS, width, dropout))
        self.blocks = nn.ModuleList(
            nn.Sequential(*_layer(width, width, dropout), *_layer(width, width, dropout)) for _ in range(blocks)
        )
        self.last = nn.Linear(width, 1 + 3 * len(POINTS))
        # Untrained, the points lie where their keypoints are.
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, windows: Tensor) -> Tensor:
        """:data:`POINTS` ``[N, 28, 3]`` in body heights, relative to the middle of the hips, of windows ``[N, 513]``.

        Across the picture a point lies where its keypoint is, up to the scale that the network gives and a correction.
        """
        hidden = self.first(windows)
        for block in self.blocks:
            hidden = hidden + block(hidden)
        out = self.last(hidden)
        middle = windows.unflatten(-1, (WINDOW, len(KEYPOINTS), 3))[:, WINDOW // 2]
        flat = _SPREAD * middle[..., :2] * (0.3 * out[:, :1, None]).exp()
        points = out[:, 1:].unflatten(-1, (len(POINTS), 3))
        base = torch.zeros_like(points)
        base[:, list(SEEN), :2] = flat.to(base.dtype)
        return points + base


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


def mirrored_points(points: Tensor) -> Tensor:
    """:data:`POINTS` ``[N, 28, 3]`` of the mirror image."""
    return points[:, _POINT_MIRROR] * points.new_tensor([-1.0, 1.0, 1.0])


def lift(
    track: PoseTrack,
    network: LiftingNetwork,
    height: float | None = None,
    landmark_share: tuple[float, float] = LANDMARK_SHARE,
) -> Array:
    """:data:`POINTS` ``[T, 28, 3]`` m, relative to the middle of the hips; the first 21 are :data:`JOINTS`.

    Args:
        track: 2D keypoints of any layout with hips; 3D landmarks in camera axes count too where there are any.
        network: in evaluation mode, see :func:`egopose.checkpoint.lifting.load_lifting_network`.
        height: m, of the body; None: what the 3D landmarks say, or 1.7 without any.
        landmark_share: of the landmarks in the mean, across the picture and in depth; 0 is the network alone.

    Returns:
        NaN in frames that show fewer than six keypoints, and in gaps longer than a window.

    Raises:
        InputError: no frame shows hips in pixels, or ``height`` is not positive.
    """
    if height is not None and not (np.isfinite(height) and height > 0):
        raise InputError("lift", "height", f"must be positive, got {height}")
    body = fill_gaps(track.to_schema(BODY_25), _SURE)
    pixels, confidence = _inputs(body)
    points = _network_points(network, pixels, confidence, track.fps)
    landmarks = _landmarks(body)
    if height is None and landmarks is not None:
        height = _height_of(points, landmarks)
    points *= height or _HEIGHT
    if landmarks is not None:
        points = _mean(points, landmarks, landmark_share)
    points[~_bridged((confidence > 0).sum(axis=1) >= _LEAST, track.fps)] = np.nan
    return points


def lifted_track(
    track: PoseTrack,
    network: LiftingNetwork,
    height: float | None = None,
    landmark_share: tuple[float, float] = LANDMARK_SHARE,
) -> PoseTrack:
    """The track in ``BODY_25`` with what :func:`lift` gives as its 3D keypoints; its arguments are the same."""
    points = lift(track, network, height, landmark_share)
    body = track.to_schema(BODY_25)
    positions = np.full((len(track), len(BODY_25), 3), np.nan)
    positions[:, [BODY_25.index(name) for name in KEYPOINTS]] = points[:, list(SEEN)]
    for name in ("neck", "mid_hip"):
        positions[:, BODY_25.index(name)] = positions[:, [BODY_25.index(part) for part in STAND_INS[name]]].mean(axis=1)
    return replace(body, positions=positions, axes="camera")


def camera_axes(points: Array, track: PoseTrack, focal: float | None = None) -> Array:
    """Points ``[T, J, 3]`` of :func:`lift` turned into the camera's own axes.

    Args:
        points: relative to the hips, in the axes of a camera that looks straight at them.
        track: whose pixels tell where in the picture the hips are.
        focal: px; None: a telephone's.

    Raises:
        InputError: the track has no size of picture, or ``focal`` is not positive.
    """
    if track.image_size is None:
        raise InputError("lift", "image_size", "is not known: where the camera looks cannot be told")
    if focal is not None and not (np.isfinite(focal) and focal > 0):
        raise InputError("lift", "focal", f"must be positive, got {focal}")
    width, height = track.image_size
    hips = _held_hips(fill_gaps(track.to_schema(BODY_25), _SURE))
    ahead = np.ones((len(track), 3))
    ahead[:, :2] = (hips.mean(axis=1) - [width / 2, height / 2]) / (focal or _FOCAL * max(width, height))
    z = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    turns = np.stack([x, np.cross(z, x), z], axis=1)
    return np.asarray(np.einsum("tji,tkj->tki", turns, points))


def _inputs(body: PoseTrack) -> tuple[Array, Array]:
    """Pixels ``[T, K, 2]`` of :data:`KEYPOINTS`, all finite, and confidence ``[T, K]``, 0 for what was not seen."""
    rows = [BODY_25.index(name) for name in KEYPOINTS]
    pixels = body.pixels[:, rows]
    seen = np.isfinite(pixels).all(axis=-1) & ~body.filled[:, rows] & (body.confidence[:, rows] >= _SURE)
    pixels[:, list(_HIPS)] = _held_hips(body)
    guessed = np.where(_bridged(seen, body.fps), _GUESSED, 0.0)
    return np.nan_to_num(pixels), np.where(seen, body.confidence[:, rows], guessed)


def _bridged(seen: np.ndarray, fps: float) -> np.ndarray:
    """``seen [T, ...]`` with its gaps in time that are shorter than a window filled."""
    length = max(1, round(_BRIDGED * fps))
    structure = np.ones((length, *(1,) * (seen.ndim - 1)), dtype=bool)
    return np.asarray(binary_closing(seen, structure) | seen)


def _held_hips(body: PoseTrack) -> Array:
    """``[T, 2, 2]`` px; before their first and behind their last sight the hips stay where they were seen."""
    hips = body.pixels[:, [BODY_25.index("left_hip"), BODY_25.index("right_hip")]]
    known = np.flatnonzero(np.isfinite(hips).all(axis=(1, 2)))
    if not len(known):
        raise InputError("lift", "pixels", "show no hips in any frame: keypoints of 2D poses are needed")
    frames = np.arange(len(hips))
    after = np.minimum(np.searchsorted(known, frames), len(known) - 1)
    before = np.maximum(after - 1, 0)
    nearer = frames - known[before] < known[after] - frames
    return hips[np.where(nearer, known[before], known[after])]


def _network_points(network: LiftingNetwork, pixels: Array, confidence: Array, fps: float) -> Array:
    """``[T, 28, 3]`` in body heights: the mean of what the network says of the picture and of its mirror image."""
    frames = len(pixels)
    steps = np.round((np.arange(WINDOW) - WINDOW // 2) * fps / RATE).astype(int)
    index = np.clip(np.arange(frames)[:, None] + steps, 0, frames - 1)
    windows = normalised_windows(torch.from_numpy(pixels)[index], torch.from_numpy(confidence)[index])
    with torch.no_grad():
        both = network(windows) + mirrored_points(network(mirrored_windows(windows)))
    points = 0.5 * both.double().numpy()
    return np.asarray(points - points[:, [SEEN[k] for k in _HIPS]].mean(axis=1, keepdims=True))


def _landmarks(body: PoseTrack) -> Array | None:
    """``[T, K, 3]`` m: 3D landmarks of :data:`KEYPOINTS` relative to the middle of the hips; None without any."""
    if body.positions is None or body.axes != "camera" or not np.isfinite(body.positions).any():
        return None
    landmarks = body.positions[:, [BODY_25.index(name) for name in KEYPOINTS]]
    return np.asarray(landmarks - landmarks[:, list(_HIPS)].mean(axis=1, keepdims=True))


def _height_of(points: Array, landmarks: Array) -> float:
    """m: by which the network's points (body heights) are as large as the landmarks."""
    ours, theirs = np.linalg.norm(points[:, list(SEEN)], axis=2), np.linalg.norm(landmarks, axis=2)
    known = np.isfinite(theirs)
    return float(np.median(theirs[known]) / max(float(np.median(ours[known])), 1e-9))


def _mean(points: Array, landmarks: Array, share: tuple[float, float]) -> Array:
    """The points moved towards the landmarks by a share; trunk joints without a landmark follow the shoulders."""
    away = np.nan_to_num((landmarks - points[:, list(SEEN)]) * [share[0], share[0], share[1]])
    out = points.copy()
    out[:, list(SEEN)] += away
    shoulders = away[:, [KEYPOINTS.index(f"{side}_shoulder") for side in ("left", "right")]].mean(axis=1)
    for name, part in _TRUNK.items():
        out[:, JOINTS.index(name)] += part * shoulders
    return out
