"""Metrics on where a person walks and faces: the root's path and heading, and the rate of steps.

A path is ``[T, 2]``: x and y of the root in metres. A heading is ``[T]`` rad about the vertical, zero along x; it may
be wrapped. Both are at a constant rate. Two of them are compared after their starts were laid on each other: what a
worn camera sees has no compass.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

#: Steps a second of people who walk or run: slow walking has about 1.2, sprinters 5 but joggers 2.7 (Nilsson &
#: Thorstensson 1987). The band is wide enough for all but sprints, and leaves out a stride's sway.
STEP_BAND = (1.0, 3.5)
#: m, root mean square in the band. A slow walk bobs by 2 cm from top to bottom, 7 mm rms (Gard, Miff & Kuo 2004).
SMALLEST_BOB = 0.003
#: m/s and m: below them a person stands, and there is nothing to divide by.
SLOWEST, SHORTEST_PATH = 0.05, 0.1
#: Points of the spectrum per hertz, at least: a step rate is then known to 0.02 Hz before its peak is interpolated.
_POINTS_PER_HERTZ = 50
_ROUNDING = 1e-9  # rad/s, above what differences of headings of some hundred turns leave


def path_of(qpos: Array) -> tuple[Array, Array]:
    """Path ``[T, 2]`` m and heading ``[T]`` rad, without jumps of a whole turn, of the root of ``qpos [T, 7 + D]``."""
    return qpos[:, :2], np.unwrap(rot.yaw(qpos[:, 3:7]))


def yaw_rate(heading: Array, fps: float) -> Array:
    """``[T]`` rad/s by central differences of a heading ``[T]``.

    Raises:
        ValueError: fewer than 2 frames.
    """
    _at_least(heading, 2)
    return np.gradient(np.unwrap(heading)) * fps


def yaw_rate_correlation(estimate: Array, reference: Array, fps: float) -> float:
    """Pearson's r of the yaw rates of two headings ``[T]``; NaN where one of them never changes.

    Raises:
        ValueError: they differ in length, or have fewer than 2 frames.
    """
    _same_length(estimate, reference)
    one, other = yaw_rate(estimate, fps), yaw_rate(reference, fps)
    one, other = one - one.mean(), other - other.mean()
    sizes = np.linalg.norm(one), np.linalg.norm(other)
    # What is left of equal numbers after their mean was taken off is rounding.
    return float(one @ other / (sizes[0] * sizes[1])) if min(sizes) > _ROUNDING * len(one) ** 0.5 else float("nan")


def forward_speed(path: Array, heading: Array, fps: float) -> float:
    """Mean speed (m/s) towards where the root faces, of ``path [T, 2]`` and ``heading [T]``.

    Raises:
        ValueError: they differ in length, or have fewer than 2 frames.
    """
    _same_length(path, heading)
    _at_least(path, 2)
    steps, facing = np.diff(path, axis=0) * fps, heading[:-1]
    return float((steps[:, 0] * np.cos(facing) + steps[:, 1] * np.sin(facing)).mean())


def forward_speed_ratio(
    path: Array, heading: Array, reference_path: Array, reference_heading: Array, fps: float
) -> float:
    """:func:`forward_speed` of the estimate over the truth's; NaN where the truth is slower than 0.05 m/s either way.

    Raises:
        ValueError: lengths differ, or there are fewer than 2 frames.
    """
    _same_length(path, reference_path)
    true = forward_speed(reference_path, reference_heading, fps)
    return forward_speed(path, heading, fps) / true if abs(true) >= SLOWEST else float("nan")


def net_path_error_percent(path: Array, heading: Array, reference_path: Array, reference_heading: Array) -> float:
    """Distance of the end points in percent of the true path's length; the first frames' places and headings are made
    equal before.

    NaN where the truth moves less than 0.1 m.

    Raises:
        ValueError: lengths differ, or there are fewer than 2 frames.
    """
    _same_length(path, reference_path)
    _same_length(path, heading)
    _same_length(reference_path, reference_heading)
    _at_least(path, 2)
    length = float(np.linalg.norm(np.diff(reference_path, axis=0), axis=1).sum())
    if length < SHORTEST_PATH:
        return float("nan")
    turn = reference_heading[0] - heading[0]
    cos, sin = np.cos(turn), np.sin(turn)
    way, true = path[-1] - path[0], reference_path[-1] - reference_path[0]
    turned = np.array([cos * way[0] - sin * way[1], sin * way[0] + cos * way[1]])
    return 100.0 * float(np.linalg.norm(turned - true)) / length


def heading_error(estimate: Array, reference: Array, fps: float) -> float:
    """Mean absolute difference (rad) of two headings ``[T]``, after their first seconds were laid on each other.

    Raises:
        ValueError: they differ in length, or have no frame.
    """
    _same_length(estimate, reference)
    _at_least(estimate, 1)
    apart = estimate - reference
    first = apart[: max(1, round(fps))]
    offset = np.arctan2(np.sin(first).mean(), np.cos(first).mean())
    return float(np.abs(rot.wrapped(apart - offset)).mean())


def step_frequency(height: Array, fps: float) -> float:
    """Steps a second from the bob of root or head: the peak of ``height [T]`` (m) in 1 to 3.5 Hz by Welch's method.

    A body is lowest once a step. Segments are of 4 s, or of the whole where it is shorter.

    Returns:
        Hz; NaN where the body stands (a bob below 3 mm rms in the band), where no frequency of the band stands out from
        its edges, or where there is less than 2 s.
    """
    if len(height) < 2.0 * fps:
        return float("nan")
    segment = min(len(height), round(4.0 * fps))
    points = max(segment, round(_POINTS_PER_HERTZ * fps))
    frequency, power = welch(height, fps, nperseg=segment, nfft=points, detrend="linear")
    inside = np.flatnonzero((frequency >= STEP_BAND[0]) & (frequency <= STEP_BAND[1]))
    if not len(inside) or np.sqrt(power[inside].sum() * frequency[1]) < SMALLEST_BOB:
        return float("nan")
    peak = inside[np.argmax(power[inside])]
    if peak in (inside[0], inside[-1]):
        return float("nan")
    left, top, right = power[peak - 1 : peak + 2]
    curve = left - 2.0 * top + right
    return float(frequency[peak] + (0.5 * (left - right) / curve if curve < 0 else 0.0) * frequency[1])


def _same_length(one: Array, other: Array) -> None:
    if len(one) != len(other):
        raise ValueError(f"{len(one)} and {len(other)} frames differ")


def _at_least(frames: Array, count: int) -> None:
    if len(frames) < count:
        raise ValueError(f"needs at least {count} frames, got {len(frames)}")
