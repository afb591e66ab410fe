"""What is wrong with a track, mended and reported: sides that change places, frames without a person."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from egopose.motion.contacts import runs_of
from egopose.motion.rotations import Array
from egopose.scene.poses.track import Mask, PoseTrack

#: Confidence of what was interpolated, and weight of a keyframe made by hand (the paper, section 6.1).
MADE_UP = 0.1


def with_keyframes(track: PoseTrack, keyframes: Mapping[int, Array], weight: float = MADE_UP) -> PoseTrack:
    """The track with 3D poses made by hand in some frames, usually within a gap.

    Args:
        track: with 3D keypoints.
        keyframes: frame -> ``[K, 3]`` m, in the track's axes; NaN leaves a keypoint as it is.
        weight: how much such a frame counts beside an estimated one.

    Raises:
        ValueError: no 3D keypoints, a frame outside the clip, another shape.
    """
    if track.positions is None:
        raise ValueError("keyframes are 3D poses, and the track has none")
    positions, confidence, weights = track.positions.copy(), track.confidence.copy(), track.weights.copy()
    for t, pose in keyframes.items():
        if not 0 <= t < len(track) or pose.shape != positions.shape[1:]:
            raise ValueError(f"keyframe {t}: expected {list(positions.shape[1:])} in a frame below {len(track)}")
        given = np.isfinite(pose).all(axis=1)
        positions[t, given], confidence[t, given], weights[t] = pose[given], 1.0, weight
    note = f"{len(keyframes)} keyframes of weight {weight:g}: frames {', '.join(str(t) for t in sorted(keyframes))}"
    notes = (*track.notes, note)
    return replace(track, positions=positions, confidence=confidence, weights=weights, notes=notes)


def fill_gaps(track: PoseTrack, least: float = 0.1) -> PoseTrack:
    """Keypoints that were not seen, interpolated in time between those that were, and marked.

    What lies before the first or behind the last sight of a keypoint stays unknown. Interpolated pixels have the
    confidence :data:`MADE_UP`.

    Args:
        track: as it was read.
        least: confidence below which pixels were not seen.
    """
    known = np.asarray(np.isfinite(track.pixels).all(axis=-1) & (track.confidence >= least))
    pixels, filled = _interpolated(track.pixels, known)
    positions = track.positions
    if positions is not None:
        positions, more = _interpolated(positions, np.asarray(np.isfinite(positions).all(axis=-1)))
        filled |= more
    confidence = np.where(filled, MADE_UP, track.confidence)
    gaps = runs_of(np.asarray(filled.mean(axis=1) > 0.5))
    notes = [f"frames {a} to {b - 1}: nobody was found; interpolated" for a, b in gaps]
    single = int(filled.sum()) - sum(int(filled[a:b].sum()) for a, b in gaps)
    if single:
        notes.append(f"{single} single keypoints of {filled.size} were not seen; interpolated")
    nobody = ~np.isfinite(pixels).any(axis=(1, 2)) if positions is None else ~np.isfinite(positions).any(axis=(1, 2))
    notes += [
        f"frames {a} to {b - 1}: nobody was found, at the clip's end or beginning"
        for a, b in runs_of(np.asarray(nobody))
    ]
    return replace(
        track,
        pixels=pixels,
        positions=positions,
        confidence=confidence,
        filled=track.filled | filled,
        notes=(*track.notes, *notes),
    )


def exchange_sides(track: PoseTrack, frames: Mask) -> PoseTrack:
    """Left and right under each other's names in some frames ``[T]``, over the whole body."""
    mirror = track.schema.mirror

    def exchanged(values: np.ndarray) -> np.ndarray:
        out = values.copy()
        out[frames] = values[frames][:, mirror]
        return out

    return replace(
        track,
        pixels=exchanged(track.pixels),
        confidence=exchanged(track.confidence),
        filled=exchanged(track.filled),
        positions=None if track.positions is None else exchanged(track.positions),
        swapped=track.swapped ^ frames,
    )


def _interpolated(values: Array, known: Mask) -> tuple[Array, Mask]:
    """``[T, K, d]`` with every keypoint's inner gaps filled linearly, and which ``[T, K]`` were."""
    out, filled = values.copy(), np.zeros(known.shape, dtype=bool)
    for k in range(values.shape[1]):
        at = np.flatnonzero(known[:, k])
        if not len(at):
            continue
        inner = np.arange(at[0], at[-1] + 1)
        missing = inner[~known[inner, k]]
        for axis in range(values.shape[2]):
            out[missing, k, axis] = np.interp(missing, at, values[at, k, axis])
        filled[missing, k] = True
    return out, filled
