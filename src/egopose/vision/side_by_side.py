"""Motions and the wearer's view beside each other in one picture."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import cv2
import mujoco
import numpy as np

from egopose.motion.rotations import Array
from egopose.vision.rendering import label_frame, side_view_frames
from egopose.vision.video import Frame


def side_by_side(
    model: mujoco.MjModel, motions: Mapping[str, Iterable[Array]], wearer: Iterable[Frame], wearer_label: str, size: int
) -> Iterator[Frame]:
    """Frames ``[size, size * (len(motions) + 1), 3]``: each motion seen from beside, then what the wearer's camera saw.

    Args:
        model: the humanoid with its floor.
        motions: label -> ``[T, nq]`` or its rows as they come, in the order of the panels.
        wearer: RGB frames in step with the motions; square or not, the middle square is shown.
        wearer_label: of the last panel; says where the video is rendered and not filmed.
        size: side of a panel, pixels.
    """
    bodies = side_view_frames(model, list(motions.values()), list(motions), size)
    for panels, seen in zip(bodies, wearer, strict=False):
        yield np.concatenate([panels, label_frame(middle_square(seen, size), wearer_label)], axis=1)


def middle_square(frame: Frame, size: int) -> Frame:
    """The middle square of a picture ``[H, W, 3]``, resized to ``[size, size, 3]``."""
    height, width = frame.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = frame[top : top + side, left : left + side]
    while side >= 2 * size:  # halves first: OpenCV is some times as fast at them as at other ratios
        side //= 2
        square = cv2.resize(square[: 2 * side, : 2 * side], (side, side), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return np.asarray(cv2.resize(square, (size, size), interpolation=cv2.INTER_AREA), dtype=np.uint8)
