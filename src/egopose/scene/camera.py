"""How a camera moved, by what stands still behind the person: undone before anything else sees the keypoints.

Corners of the background are followed from frame to frame (Shi & Tomasi 1994; pyramidal Lucas-Kanade, Bouguet 2001).
A similarity or a homography is fitted to them by RANSAC (Fischler & Bolles 1981). It is fitted from a key frame on, not
from the frame before, so errors add up with each key frame and not with each frame.

A homography is exact for a camera that turns and zooms. One that travels sees near and far things move differently;
there either kind is a fit to the background that most corners lie on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.scene.poses.track import PoseTrack
from egopose.vision.video import Frame

KINDS = ("similarity", "homography")
#: The longer side of the picture in which corners are followed, px.
_WORKING_SIDE = 960
_MOST_CORNERS, _LEAST_CORNERS = 400, 16
#: A new key frame where fewer of the corners than this share are left.
_LEFT = 0.5
#: Corners that come back to this far from where they began (px) were followed rightly; and what RANSAC lets pass.
_RETURN, _NEAR = 1.0, 2.0
#: Of the corners, the share that must move alike; and a frame's change of size that no camera makes.
_ALIKE, _ZOOM = 0.4, 1.3
#: Corners that cover less than this share of the picture's width and height say nothing of the rest of it.
_COVER = 0.15
#: Side of the window that is followed, levels of the pyramid; a corner's least quality and distance to the next, px.
_WINDOW, _LEVELS = (21, 21), 3
_QUALITY, _DISTANCE = 0.01, 12


@dataclass(frozen=True)
class CameraTrack:
    """Where each frame's pixels lie in the first frame.

    Args:
        to_first: ``[T, 3, 3]`` homogeneous, pixels of frame t to those of the first frame; ``[2, 2]`` is 1.
        degenerate: ``[T]``: too little was seen or nothing moved alike, so the frame before stands for this one.
        alike: ``[T]`` share of the corners that the fit explains; 1 in the first frame.
        kind: ``similarity`` or ``homography``.
    """

    to_first: Array
    degenerate: NDArray[np.bool_]
    alike: Array
    kind: str

    def __len__(self) -> int:
        return len(self.to_first)

    def undo(self, pixels: Array) -> Array:
        """Points ``[T, ..., 2]`` (px of their own frame) as the first frame's camera would see them.

        Points that a homography sends behind the camera are NaN.
        """
        return _mapped(self.to_first, pixels)

    def redo(self, pixels: Array) -> Array:
        """Points ``[T, ..., 2]`` (px of the first frame) as each frame's own camera sees them."""
        return _mapped(np.linalg.inv(self.to_first).astype(np.float64), pixels)

    def size(self) -> Array:
        """``[T]`` how much larger the first frame shows things than frame t, at the origin: the zoom undone."""
        return np.sqrt(np.abs(np.linalg.det(self.to_first[:, :2, :2])))

    def undo_track(self, track: PoseTrack) -> PoseTrack:
        """The track as a camera that stands still would see it; frames whose camera is not known are noted.

        Raises:
            ValueError: the track has another number of frames.
        """
        if len(track) != len(self):
            raise ValueError(f"{len(self)} frames of the camera, {len(track)} of poses")
        notes = track.notes
        if self.degenerate.any():
            notes = (*notes, f"the camera's motion is not known in {int(self.degenerate.sum())} of {len(self)} frames")
        pixels = self.undo(track.pixels)
        known = np.isfinite(pixels).all(axis=-1) | ~np.isfinite(track.pixels).all(axis=-1)
        return replace(track, pixels=pixels, confidence=np.where(known, track.confidence, 0.0), notes=notes)


def camera_motion(frames: Iterable[Frame], boxes: Array | None = None, kind: str = "similarity") -> CameraTrack:
    """The motion of the camera over a film.

    Args:
        frames: uint8 RGB ``[H, W, 3]`` of one size, looked at once and in order.
        boxes: ``[T, 4]`` px (left, top, right, bottom) around the person, who moves otherwise; NaN where unknown: the
            last one known is taken. None: nobody is in the picture.
        kind: one of :data:`KINDS`.

    Raises:
        InputError: an unknown kind, no frames, frames of different sizes, fewer boxes than frames.
    """
    if kind not in KINDS:
        raise InputError("camera", "kind", f"{kind!r:.40} is not known; there are {', '.join(KINDS)}")
    to_first, degenerate, alike = [], [], []
    follower: _Follower | None = None
    box = np.full(4, np.nan)
    shape: tuple[int, ...] = ()
    for t, frame in enumerate(frames):
        if boxes is not None and t >= len(boxes):
            raise InputError("camera", "boxes", f"there are {len(boxes)}, and more frames")
        if boxes is not None and np.isfinite(boxes[t]).all():
            box = boxes[t]
        shape = shape or frame.shape
        if frame.shape != shape:
            raise InputError("camera", f"frame {t}", f"size {frame.shape[:2]} differs from the first's {shape[:2]}")
        if follower is None:
            follower = _Follower(frame, box, kind)
            fit = (True, 1.0)
        else:
            fit = follower.step(frame, box)
        to_first.append(follower.to_first)
        degenerate.append(not fit[0])
        alike.append(fit[1])
    if follower is None:
        raise InputError("camera", "frames", "there are none")
    return CameraTrack(np.stack(to_first), np.array(degenerate), np.array(alike), kind)


class _Follower:
    """Corners of the background, followed from the last key frame to the present one."""

    def __init__(self, frame: Frame, box: Array, kind: str) -> None:
        self._kind = kind
        self._scale = min(1.0, _WORKING_SIDE / max(frame.shape[:2]))
        self._grey = self._small(frame)
        #: From the present frame to the first, in pixels of the film.
        self.to_first = np.eye(3)
        self._start(box)

    def _small(self, frame: Frame) -> np.ndarray:
        grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        if self._scale == 1.0:
            return grey
        return cv2.resize(grey, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)

    def _start(self, box: Array) -> None:
        """Make the present frame the key frame."""
        height, width = self._grey.shape[:2]
        mask = np.full((height, width), 255, dtype=np.uint8)
        if np.isfinite(box).all():
            limit = np.array([width, height] * 2)
            left, top, right, bottom = np.clip(np.round(box * self._scale), 0, limit).astype(int)
            mask[top:bottom, left:right] = 0
        corners = cv2.goodFeaturesToTrack(self._grey, _MOST_CORNERS, _QUALITY, _DISTANCE, mask=mask)
        self._now = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2).astype(np.float32)
        self._key, self._began, self._key_to_first = self._now.copy(), len(self._now), self.to_first

    def step(self, frame: Frame, box: Array) -> tuple[bool, float]:
        """Go on to the next frame; whether its place is known, and the share of corners that it explains."""
        grey = self._small(frame)
        moved, kept = _followed(self._grey, grey, self._now)
        kept &= ~_inside(moved, box * self._scale)
        self._grey, self._now, self._key = grey, moved[kept], self._key[kept]
        matrix, inside = _fitted(self._key, self._now, self._kind)
        alike = float(inside.mean()) if len(inside) else 0.0
        good = matrix is not None and alike >= _ALIKE and _covers(self._now[inside], grey.shape)
        if good:
            assert matrix is not None
            to_first = self._key_to_first @ np.linalg.inv(self._whole(matrix))
            to_first = to_first / to_first[2, 2]
            change = np.linalg.det(np.linalg.solve(self.to_first, to_first)[:2, :2])
            good = bool(np.isfinite(to_first).all() and _ZOOM**-2 < change < _ZOOM**2)
            if good:
                self.to_first = to_first
                self._now, self._key = self._now[inside], self._key[inside]
        if not good or len(self._now) < max(_LEFT * self._began, _LEAST_CORNERS):
            self._start(box)
        return good, alike

    def _whole(self, matrix: Array) -> Array:
        """A matrix of the small picture's pixels in the film's: a pixel's middle lies at its number."""
        shift = 0.5 * self._scale - 0.5
        small = np.array([[self._scale, 0.0, shift], [0.0, self._scale, shift], [0.0, 0.0, 1.0]])
        return np.linalg.inv(small) @ matrix @ small


def _followed(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, NDArray[np.bool_]]:
    """Where points ``[N, 2]`` went, and which came back when followed the other way."""
    if not len(points):
        return points, np.zeros(0, dtype=bool)
    start = points[:, None]
    there, found = _flow(before, after, start)
    back, again = _flow(after, before, there)
    kept = (found.ravel() == 1) & (again.ravel() == 1)
    kept &= np.linalg.norm(back[:, 0] - points, axis=1) < _RETURN
    return there[:, 0], kept


def _flow(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.zeros_like(points), winSize=_WINDOW, maxLevel=_LEVELS
    )
    return np.asarray(there), np.asarray(found)


def _fitted(source: np.ndarray, target: np.ndarray, kind: str) -> tuple[Array | None, NDArray[np.bool_]]:
    """The matrix ``[3, 3]`` from source to target points ``[N, 2]``, or None, and which of them it explains."""
    if len(source) < _LEAST_CORNERS:
        return None, np.zeros(len(source), dtype=bool)
    a, b = source[:, None].astype(np.float32), target[:, None].astype(np.float32)
    cv2.setRNGSeed(0)
    if kind == "homography":
        found, inside = cv2.findHomography(a, b, cv2.RANSAC, _NEAR)
    else:
        found, inside = cv2.estimateAffinePartial2D(a, b, method=cv2.RANSAC, ransacReprojThreshold=_NEAR)
    matrix = None if found is None else np.asarray(found, dtype=np.float64)
    if matrix is not None and len(matrix) == 2:
        matrix = np.vstack([matrix, [0.0, 0.0, 1.0]])
    if matrix is None or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
        return None, np.zeros(len(source), dtype=bool)
    return matrix, np.asarray(inside).ravel().astype(bool)


def _inside(points: np.ndarray, box: Array) -> NDArray[np.bool_]:
    if not np.isfinite(box).all():
        return np.zeros(len(points), dtype=bool)
    return np.asarray(((points >= box[:2]) & (points <= box[2:])).all(axis=1))


def _covers(points: np.ndarray, shape: tuple[int, ...]) -> bool:
    if len(points) < _LEAST_CORNERS:
        return False
    return bool((np.ptp(points, axis=0) >= _COVER * np.array([shape[1], shape[0]])).all())


def _mapped(matrices: Array, pixels: Array) -> Array:
    flat = pixels.reshape(len(pixels), -1, 2)
    homogeneous = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1)
    out = homogeneous @ matrices.transpose(0, 2, 1)
    ahead = out[..., 2:] > 1e-6
    return np.where(ahead, out[..., :2] / np.where(ahead, out[..., 2:], 1.0), np.nan).reshape(pixels.shape)
