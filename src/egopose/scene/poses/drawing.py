"""A person's keypoints drawn into the picture, for a look at what was found."""

from __future__ import annotations

import cv2
import numpy as np

from egopose.scene.poses.track import PoseTrack
from egopose.vision.video import Frame

#: RGB of the left side, the right side and the middle of the body, as OpenPose's pictures tell sides apart.
_LEFT, _RIGHT, _MIDDLE = (70, 190, 255), (255, 120, 60), (240, 240, 240)
_FILLED = (255, 0, 255)
_SURE = 0.3


def draw_pose(frame: Frame, track: PoseTrack, t: int) -> Frame:
    """A copy of ``frame [H, W, 3]`` with frame ``t`` of the track; left blue, right orange, filled keypoints magenta.

    Keypoints below a confidence of 0.3 are left out, unless they were filled.
    """
    out = frame.copy()
    width = max(1, round(max(frame.shape[:2]) / 500))
    shown = np.isfinite(track.pixels[t]).all(axis=1) & ((track.confidence[t] >= _SURE) | track.filled[t])
    places = np.where(shown[:, None], track.pixels[t], 0.0).round().astype(int)
    for a, b in track.schema.limbs:
        if shown[a] and shown[b]:
            colour = _colour(track.schema.names[a if "_" in track.schema.names[a] else b])
            cv2.line(out, _point(places[a]), _point(places[b]), colour, width, cv2.LINE_AA)
    for k in np.flatnonzero(shown):
        colour = _FILLED if track.filled[t, k] else _colour(track.schema.names[k])
        cv2.circle(out, _point(places[k]), 2 * width, colour, -1, cv2.LINE_AA)
    return out


def _point(place: np.ndarray) -> tuple[int, int]:
    return int(np.clip(place[0], -(2**14), 2**14)), int(np.clip(place[1], -(2**14), 2**14))


def _colour(name: str) -> tuple[int, int, int]:
    return _LEFT if name.startswith("left_") else _RIGHT if name.startswith("right_") else _MIDDLE
