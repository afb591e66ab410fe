"""Bodies and boxes drawn into pictures."""

from __future__ import annotations

import cv2
import numpy as np

from egopose.motion.kinematics import tip_positions
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.projection import Projection
from egopose.scene.scene_file import Box
from egopose.vision.video import Frame

_BODY, _BOX, _FLOOR = (70, 230, 110), (255, 190, 40), (150, 150, 150)
_FILL = 0.25
_LIMIT = 2**14


def box_corners(box: Box) -> Array:
    """``[8, 3]`` m: the corners of the upper face, then those on the floor below them.

    Raises:
        ValueError: its place, height or yaw is not known.
    """
    if box.place is None or box.height is None or box.yaw is None:
        raise ValueError(f"{box.name} has no place, height or yaw")
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)
    flat = 0.5 * signs * box.size @ np.array([[c, s], [-s, c]]) + box.place
    return np.concatenate([np.column_stack([flat, np.full(4, height)]) for height in (box.height, 0.0)])


def body_points(motion: Motion) -> tuple[Array, np.ndarray]:
    """``[T, J + K, 3]`` m, joints and tips of a body, and the row that each hangs on; -1 for the root."""
    positions, quats = motion.forward_kinematics()
    names, tips = tip_positions(motion.skeleton, positions, quats)
    parents = [*motion.skeleton.parents, *(motion.skeleton.index(name) for name in names)]
    return np.concatenate([positions, tips], axis=1), np.array(parents)


def draw_bones(frame: Frame, places: Array, parents: np.ndarray, colour: tuple[int, int, int] = _BODY) -> Frame:
    """A copy of the picture with a line from every point ``[J, 2]`` (px) to the one it hangs on, see above."""
    out = frame.copy()
    width = max(1, round(max(frame.shape[:2]) / 400))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            cv2.line(out, _point(places[joint]), _point(places[parent]), colour, width, cv2.LINE_AA)
    return out


def draw_box(frame: Frame, box: Box, projection: Projection, t: int) -> Frame:
    """A copy of the picture of frame ``t`` with a box: its edges, the upper face filled faintly."""
    corners = box_corners(box)
    places = projection.at(t).pixels(corners[None])[0]
    out = frame.copy()
    face = np.array([_point(place) for place in places[:4]], dtype=np.int32)
    cv2.fillPoly(out, [face], _BOX, cv2.LINE_AA)
    out = cv2.addWeighted(out, _FILL, frame, 1 - _FILL, 0.0).astype(np.uint8)
    width = max(1, round(max(frame.shape[:2]) / 500))
    for a in range(4):
        b = (a + 1) % 4
        for first, second in ((a, b), (a + 4, b + 4), (a, a + 4)):
            cv2.line(out, _point(places[first]), _point(places[second]), _BOX, width, cv2.LINE_AA)
    return out


def draw_floor(frame: Frame, centre: Array, projection: Projection, t: int, reach: int = 2) -> Frame:
    """A copy of the picture with a grid of metres on the floor around ``centre [2]`` (m)."""
    out, middle = frame.copy(), np.round(centre)
    lines = range(-reach, reach + 1)
    ends = [[[k, -reach], [k, reach]] for k in lines] + [[[-reach, k], [reach, k]] for k in lines]
    flat = np.array(ends, dtype=np.float64).reshape(-1, 2) + middle
    places = projection.at(t).pixels(np.column_stack([flat, np.zeros(len(flat))])[None])[0].reshape(-1, 2, 2)
    for a, b in places:
        cv2.line(out, _point(a), _point(b), _FLOOR, 1, cv2.LINE_AA)
    return out


def _point(place: Array) -> tuple[int, int]:
    x, y = np.clip(np.nan_to_num(place), -_LIMIT, _LIMIT).round().astype(int)
    return int(x), int(y)
