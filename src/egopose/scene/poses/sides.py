"""Frames in which left and right change places, found and put right.

An estimator that takes a back for a front gives both legs and both arms the other side's name. Within a clip the
names jump: the labels that move most smoothly are the right ones, found over all frames at once (Viterbi 1967). Legs
that pass each other change places too, so a keypoint may also go on as it moved before.

A clip that has the sides wrong from end to end does not jump. There the body itself tells, where 3D is known: toes and
nose point ahead, and a person's left lies at the left of where these point. Only a body that contradicts itself tells:
a pose network that takes a back for a front gives a whole front.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import KeypointSchema
from egopose.scene.poses.mending import exchange_sides
from egopose.scene.poses.track import PoseTrack

#: Limbs that get a name together, by which smoothness is judged.
_JUDGED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
#: In body heights: what a jump counts at most, what an exchange of names costs by itself, and a frame with other names
#: than the estimator gave. The last lets the majority of the frames be right.
_MOST, _CHANGE, _OTHER = 0.5, 0.04, 0.001
#: What the body's own contradiction counts, per frame.
_BODY = 0.02
_SURE = 0.2


def mend_sides(track: PoseTrack) -> PoseTrack:
    """The track with left and right under their own names in all frames; ``swapped`` marks and a note tells which.

    Frames without a person are passed over.
    """
    rows = np.array([[track.schema.index(f"{s}_{part}") for part in _JUDGED] for s in ("left", "right")])
    points, sure = _evidence(track, rows)
    frames = np.flatnonzero((sure.sum(axis=(1, 2)) >= 6) & np.isfinite(points).any(axis=(1, 2, 3)))
    if len(frames) < 3:
        return track
    words = facing(track)[frames] if track.positions is not None else np.zeros(len(frames))
    states = _smoothest(points[frames], sure[frames], frames, words)
    swapped = np.zeros(len(track), dtype=bool)
    swapped[frames] = states
    if not swapped.any():
        return track
    mended = exchange_sides(track, swapped)
    note = f"left and right had changed places in {int(swapped.sum())} of {len(track)} frames; put right"
    return replace(mended, notes=(*track.notes, note))


def facing(track: PoseTrack) -> Array:
    """``[T]`` from -1 to 1: whether the person's left lies at the left of where toes and nose point.

    Negative speaks for exchanged sides; 0 where the keypoints do not tell. 3D keypoints are needed.
    """
    schema, positions = track.schema, track.positions
    if positions is None:
        return np.zeros(len(track))

    def at(*names: str) -> Array:
        return positions[:, [schema.index(name) for name in names]].mean(axis=1)

    across = at("left_hip", "left_shoulder") - at("right_hip", "right_shoulder")
    up = at("left_shoulder", "right_shoulder") - at("left_hip", "right_hip")
    ahead = np.cross(across, up)
    told = [at("left_" + toe, "right_" + toe) - at("left_heel", "right_heel") for toe in _toes(schema)]
    told.append(at("nose") - at("left_ear", "right_ear"))
    cosines = np.stack([_cosine(ahead, word) for word in told])
    known = np.isfinite(cosines)
    return np.where(known, cosines, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)


def _toes(schema: KeypointSchema) -> list[str]:
    return [toe for toe in ("big_toe", "foot_index") if f"left_{toe}" in schema.names and "left_heel" in schema.names]


def _cosine(a: Array, b: Array) -> Array:
    length = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return (a * b).sum(axis=-1) / np.maximum(length, 1e-9)


def _evidence(track: PoseTrack, rows: np.ndarray) -> tuple[Array, Array]:
    """The judged keypoints ``[T, 2, J, d]`` in body heights, left first, and what each counts ``[T, 2, J]``.

    Pixels where there are any, else positions.
    """
    flat = np.isfinite(track.pixels).any()
    values = track.pixels if flat or track.positions is None else track.positions
    known = np.isfinite(values).all(axis=-1) & (track.confidence >= _SURE)
    with np.errstate(invalid="ignore"):
        extent = np.where(known[..., None], values, -np.inf).max(axis=1) - np.where(
            known[..., None], values, np.inf
        ).min(axis=1)
    tall = extent.max(axis=1)
    height = float(np.median(tall[np.isfinite(tall)])) if np.isfinite(tall).any() else 1.0
    sure = np.where(known, track.confidence, 0.0)
    return np.nan_to_num(values[:, rows]) / max(height, 1e-9), sure[:, rows]


def _smoothest(points: Array, sure: Array, frames: np.ndarray, words: Array) -> np.ndarray:
    """``[N]`` which frames to exchange: the labels of which keypoints stay, or go on as they moved, most nearly.

    Args:
        points: ``[N, 2, J, d]`` in body heights.
        sure: ``[N, 2, J]``.
        frames: ``[N]`` their numbers, rising.
        words: ``[N]`` from -1 to 1, see :func:`facing`.
    """
    count = len(points)
    either = (points, points[:, ::-1])
    weights = (sure, sure[:, ::-1])
    own = np.stack([_BODY * np.maximum(-words, 0.0), np.full(count, _OTHER)])
    # A state is the labels of two frames that follow each other.
    total = {(a, b): own[a, 0] + own[b, 1] + _CHANGE * (a != b) for a, b in product((0, 1), repeat=2)}
    links: list[dict[tuple[int, int], int]] = []
    for n in range(2, count):
        after, link = {}, {}
        before, step = frames[n - 1] - frames[n - 2], frames[n] - frames[n - 1]
        for b, c in product((0, 1), repeat=2):
            costs = []
            for a in (0, 1):
                ahead = either[b][n - 1] + (either[b][n - 1] - either[a][n - 2]) * (step / before)
                gone_on = np.linalg.norm(either[c][n] - ahead, axis=-1)
                stayed = np.linalg.norm(either[c][n] - either[b][n - 1], axis=-1)
                away = np.minimum(np.minimum(gone_on, stayed), _MOST)
                weight = np.minimum(np.minimum(weights[c][n], weights[b][n - 1]), weights[a][n - 2])
                costs.append(total[a, b] + float((away * weight).sum() / max(weight.sum(), 1e-9)))
            link[b, c] = int(np.argmin(costs))
            after[b, c] = min(costs) + own[c, n] + _CHANGE * (b != c)
        total = after
        links.append(link)
    b, c = min(total, key=lambda state: total[state])
    out = [c, b]
    for link in reversed(links):
        b, c = link[b, c], b
        out.append(b)
    return np.array(out[::-1], dtype=bool)
