"""A track at another rate, and a part of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from egopose.motion.rotations import Array
from egopose.scene.poses.track import PoseTrack


def resampled(track: PoseTrack, fps: float) -> PoseTrack:
    """The track at ``fps`` frames/s, linear in between; a keypoint next to an unknown one is unknown."""
    if abs(fps - track.fps) < 1e-9:
        return track
    count = int(np.floor((len(track) - 1) / track.fps * fps + 1e-6)) + 1
    at = np.minimum(np.arange(count) / fps * track.fps, len(track) - 1)
    low = np.floor(at + 1e-9).astype(int)
    high = np.minimum(np.where(at - low > 1e-6, low + 1, low), len(track) - 1)
    share = np.clip(at - low, 0.0, 1.0)

    def between(values: Array) -> Array:
        weight = share.reshape(-1, *(1,) * (values.ndim - 1))
        return (1 - weight) * values[low] + weight * values[high]

    return replace(
        track,
        fps=fps,
        pixels=between(track.pixels),
        positions=None if track.positions is None else between(track.positions),
        confidence=np.minimum(track.confidence[low], track.confidence[high]),
        filled=track.filled[low] | track.filled[high],
        swapped=track.swapped[np.where(share < 0.5, low, high)],
        weights=np.minimum(track.weights[low], track.weights[high]),
    )


def cut(track: PoseTrack, start: int, stop: int) -> PoseTrack:
    """Frames ``start`` to ``stop`` (exclusive)."""
    part = slice(start, stop)
    return replace(
        track,
        pixels=track.pixels[part],
        positions=None if track.positions is None else track.positions[part],
        confidence=track.confidence[part],
        filled=track.filled[part],
        swapped=track.swapped[part],
        weights=track.weights[part],
    )


def known_span(track: PoseTrack, least: int = 6) -> tuple[int, int]:
    """First and one past the last frame in which ``least`` keypoints are known; (0, 0) if there is none."""
    known = np.flatnonzero(np.isfinite(track.pixels).all(axis=-1).sum(axis=1) >= least)
    return (int(known[0]), int(known[-1]) + 1) if len(known) else (0, 0)
