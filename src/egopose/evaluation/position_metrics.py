"""Metrics on joint positions, as the field reports them beside the paper's.

Positions are ``[T, J, 3]`` in metres, z up; joint 0 is the root. A function that compares returns one value a frame
``[T]`` in metres; the mean over frames is the take's figure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

SEGMENT = 100  # frames a segment of WA- and W-MPJPE (WHAM, Shin et al. CVPR 2024, section 4)


def mpjpe(estimate: Array, reference: Array) -> Array:
    """Mean per-joint position error ``[T]``: ``mean_j || p_j - p^_j ||`` in world coordinates."""
    return np.linalg.norm(estimate - reference, axis=-1).mean(axis=-1)


def mpjpe_root_aligned(estimate: Array, reference: Array) -> Array:
    """MPJPE ``[T]`` after moving both roots to the origin in every frame."""
    return mpjpe(estimate - estimate[:, :1], reference - reference[:, :1])


def mpjpe_procrustes(estimate: Array, reference: Array) -> Array:
    """PA-MPJPE ``[T]``: MPJPE after the best similarity (rotation, translation, scale) of every frame by itself."""
    return mpjpe(_apply(similarity(estimate, reference), estimate), reference)


def wa_mpjpe(estimate: Array, reference: Array, segment: int = SEGMENT) -> Array:
    """WA-MPJPE ``[T]``: each segment of 100 frames as a whole aligned to the reference by one similarity."""
    return _segmented(estimate, reference, segment, fit_frames=segment)


def w_mpjpe(estimate: Array, reference: Array, segment: int = SEGMENT) -> Array:
    """W-MPJPE ``[T]``: each segment of 100 frames aligned by the similarity of its first two frames alone."""
    return _segmented(estimate, reference, segment, fit_frames=2)


def root_translation_error(estimate: Array, reference: Array) -> Array:
    """Distance of the roots ``[T]`` after one rigid alignment of the whole root paths ``[T, 3]``."""
    transform = similarity(estimate[None], reference[None], with_scale=False)
    return np.linalg.norm(_apply(transform, estimate[None])[0] - reference, axis=-1)


def root_drift(estimate: Array, reference: Array) -> Array:
    """Distance of the roots ``[T]`` of two root paths ``[T, 3]`` that start at the same place, without alignment."""
    return np.linalg.norm(estimate - reference, axis=-1)


def foot_skate(feet: Array, contacts: NDArray[np.bool_], fps: float = 30.0) -> float:
    """Mean horizontal speed (m/s) of feet that touch the ground in a frame and the next; NaN if none ever does.

    Args:
        feet: ``[T, F, 3]`` positions.
        contacts: ``[T, F]``.
        fps: frames per second.
    """
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) * fps
    planted = contacts[1:] & contacts[:-1]
    return float(speed[planted].mean()) if planted.any() else float("nan")


def foot_slide(soles: Array, touching: NDArray[np.bool_], fps: float) -> float:
    """Mean horizontal speed (m/s) of feet that touch something in a frame and the next; NaN if none ever does.

    Of a foot's points the slowest counts: a foot that rolls from heel to ball does not slide.

    Args:
        soles: ``[T, F, P, 3]`` positions of each foot's points, m.
        touching: ``[T, F]``.
        fps: frames per second.
    """
    speed = np.linalg.norm(np.diff(soles[..., :2], axis=0), axis=-1).min(axis=-1) * fps
    planted = touching[1:] & touching[:-1]
    return float(speed[planted].mean()) if planted.any() else float("nan")


def ground_penetration(points: Array, ground: float = 0.0) -> Array:
    """Depth ``[T]`` of the lowest of ``points [T, P, 3]`` under the ground, 0 where nothing is under it."""
    return np.maximum(ground - points[..., 2].min(axis=-1), 0.0)


def contact_accuracy(estimate: NDArray[np.bool_], reference: NDArray[np.bool_]) -> Array:
    """Share of contact labels ``[T, F]`` that agree, per frame ``[T]``."""
    return (estimate == reference).mean(axis=-1)


def jitter(positions: Array, fps: float = 30.0) -> Array:
    """Mean over joints of the jerk ``|| d^3 p / dt^3 ||`` (m/s^3), ``[T - 3]``.

    Raises:
        ValueError: fewer than 4 frames.
    """
    if len(positions) < 4:
        raise ValueError(f"jitter needs at least 4 frames, got {len(positions)}")
    return np.linalg.norm(np.diff(positions, n=3, axis=0) * fps**3, axis=-1).mean(axis=-1)


def similarity(source: Array, target: Array, with_scale: bool = True) -> tuple[Array, Array, Array]:
    """Least-squares ``scale [B], rotation [B, 3, 3], translation [B, 3]`` that take ``source`` to ``target``.

    Umeyama, PAMI 1991. Both are ``[B, P, 3]``; without scale the scale is 1.
    """
    source_mean, target_mean = source.mean(axis=1), target.mean(axis=1)
    source_centred, target_centred = source - source_mean[:, None], target - target_mean[:, None]
    u, s, vt = np.linalg.svd(np.swapaxes(target_centred, 1, 2) @ source_centred)
    sign = np.ones_like(s)
    sign[:, 2] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1.0, 1.0)  # a rotation, not a mirror image
    rotation = (u * sign[:, None, :]) @ vt
    scale = np.ones(len(source))
    if with_scale:
        spread = (source_centred**2).sum(axis=(1, 2))
        scale = np.divide((s * sign).sum(axis=1), spread, out=scale, where=spread > 0)
    translation = target_mean - scale[:, None] * np.einsum("bij,bj->bi", rotation, source_mean)
    return scale, rotation, translation


def _apply(transform: tuple[Array, Array, Array], points: Array) -> Array:
    scale, rotation, translation = transform
    return scale[:, None, None] * points @ np.swapaxes(rotation, 1, 2) + translation[:, None]


def _segmented(estimate: Array, reference: Array, segment: int, fit_frames: int) -> Array:
    errors = []
    for start in range(0, len(estimate), segment):
        part = slice(start, start + segment)
        fit = slice(start, min(start + fit_frames, start + segment))
        transform = similarity(estimate[fit].reshape(1, -1, 3), reference[fit].reshape(1, -1, 3))
        moved = _apply(transform, estimate[part].reshape(1, -1, 3))
        errors.append(mpjpe(moved.reshape(estimate[part].shape), reference[part]))
    return np.concatenate(errors)
