"""What a pose estimator is."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from egopose.scene.poses.track import PoseTrack
from egopose.vision.video import Frame


class PoseEstimator(Protocol):
    """Finds one person's keypoints in a film."""

    def estimate(self, frames: Iterable[Frame], fps: float) -> PoseTrack:
        """Keypoints of the person, in the estimator's own layout.

        Args:
            frames: uint8 RGB ``[H, W, 3]`` of one size, looked at once and in order.
            fps: frames per second.

        Raises:
            InputError: no frames, frames of other sizes, no person in any of them.
        """
        ...
