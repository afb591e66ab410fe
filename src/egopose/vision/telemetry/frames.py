"""Sensors at the frames of the video: how fast the camera turned, and where down was.

A row of the picture is exposed up to a readout after the frame's time stamp. The middle row stands for the frame, so
both are given at the stamp and half a readout. HERO11's own camera orientation fits its gyroscope best 8 ms after the
stamp, which is half of such a readout.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.core.errors import InputError
from egopose.motion.rotations import (
    Array,
    conjugate,
    continuous,
    from_rotvec,
    multiply,
    normalize,
    rotate,
    to_rotvec,
)
from egopose.vision.telemetry.samples import Samples, Telemetry

#: s by which a sensor may begin late or end early.
_HELD = 0.5
#: s, standard deviation of the weights that average the accelerometer. Steps come at 2 Hz and starts and turns take a
#: second, so this must be longer; a gyroscope's drift within it must stay small.
SMOOTHING = 3.0
#: A camera at rest, over a second: rad/s and m/s^2 of deviation, and the largest constant error of a gyroscope, rad/s.
_REST_TURNING, _REST_PUSH, _MOST_BIAS = 0.02, 0.15, 0.05
_REST_TIME = 1.0
_GRAVITY = 9.81


def angular_velocity_at(telemetry: Telemetry, frame_times: Array, interval: float) -> Array:
    """The mean angular velocity of the camera from one frame to the next.

    The gyroscope is integrated, not sampled: between two frames it may have turned to and fro. Its constant error is
    taken off where the camera rests (:func:`gyroscope_bias`), else it stays.

    Args:
        telemetry: with a gyroscope, else the trajectory's or the camera's orientation is taken.
        frame_times: ``[T]`` s of the video.
        interval: s from the frame before to each frame.

    Returns:
        ``[T, 3]`` rad/s in camera axes; row t is of the time from ``frame_times[t] - interval`` to ``frame_times[t]``.

    Raises:
        InputError: nothing tells how the camera turned, or not for these times.
    """
    times = np.asarray(frame_times, dtype=np.float64) + 0.5 * (telemetry.readout or 0.0)
    turned = _orientation_samples(telemetry)
    before, after = (_orientation_at(turned, t) for t in (times - interval, times))
    return to_rotvec(multiply(conjugate(before), after)) / interval


def down_at(telemetry: Telemetry, frame_times: Array) -> Array:
    """Unit vectors down at each frame.

    The camera's own gravity vector is taken if there is one, else the trajectory's. Otherwise the gyroscope carries
    the accelerometer's vectors into one frame of reference, where they are averaged over :data:`SMOOTHING` s to both
    sides. Walking shakes the accelerometer by as much as gravity, but an average over several steps does not move. What
    the gyroscope drifts by before and after a frame cancels, except at the ends of the film.

    Args:
        telemetry: with gravity, a trajectory, or gyroscope and accelerometer.
        frame_times: ``[T]`` s of the video.

    Returns:
        ``[T, 3]`` in camera axes.

    Raises:
        InputError: nothing tells where down is, or not for these times.
    """
    times = np.asarray(frame_times, dtype=np.float64) + 0.5 * (telemetry.readout or 0.0)
    if telemetry.gravity is not None:
        # One a frame, already of the middle row.
        return _unit(_interpolated(telemetry.gravity, np.asarray(frame_times, dtype=np.float64)))
    if telemetry.trajectory is not None:
        placed = Samples(telemetry.trajectory.times, continuous(telemetry.trajectory.orientation))
        return rotate(conjugate(_orientation_at(placed, times)), np.array([0.0, 0.0, -1.0]))
    if telemetry.gyroscope is None or telemetry.accelerometer is None:
        raise InputError(
            "telemetry", "gravity", "nothing tells where down is: no gravity, no accelerometer with gyroscope"
        )
    turned = _integrated(telemetry)
    pushes = telemetry.accelerometer
    inside = (pushes.times >= turned.times[0]) & (pushes.times <= turned.times[-1])
    carried = rotate(_orientation_at(turned, pushes.times[inside]), pushes.values[inside])
    count = max(int(inside.sum()), 1)
    width = SMOOTHING * count / max(float(np.ptp(pushes.times[inside])), 1e-6) if count > 1 else 1.0
    weight = gaussian_filter1d(np.ones(count), width, mode="constant")
    mean = gaussian_filter1d(carried, width, axis=0, mode="constant") / weight[:, None]
    up = _interpolated(Samples(pushes.times[inside], mean), times)
    return _unit(-rotate(conjugate(_orientation_at(turned, times)), up))


def gyroscope_bias(telemetry: Telemetry) -> Array:
    """The gyroscope's constant error ``[3]`` rad/s: what it says while the camera rests, or zeros.

    The camera rests where gyroscope and accelerometer hardly change for a second. A steady turn does not pass for
    rest: tilts move the accelerometer, and a pan faster than 0.05 rad/s is more than such an error. A slower pan of a
    steady camera does; nothing in the sensors tells it apart.
    """
    none = np.zeros(3)
    turning, push = telemetry.gyroscope, telemetry.accelerometer
    if turning is None or push is None or len(turning.times) < 2:
        return none
    second = np.floor(turning.times / _REST_TIME).astype(int)
    rests = []
    for number in np.unique(second):
        rates = turning.values[second == number]
        pushes = push.values[np.floor(push.times / _REST_TIME).astype(int) == number]
        if len(rates) < 10 or len(pushes) < 10:
            continue
        calm = rates.std(axis=0).max() < _REST_TURNING and pushes.std(axis=0).max() < _REST_PUSH
        if calm and np.abs(rates.mean(axis=0)).max() < _MOST_BIAS:
            rests.append(rates.mean(axis=0))
    return np.median(rests, axis=0) if rests else none


def _orientation_samples(telemetry: Telemetry) -> Samples:
    """Orientations to some fixed frame of reference, by the best there is."""
    if telemetry.gyroscope is not None and len(telemetry.gyroscope.times) > 1:
        return _integrated(telemetry)
    if telemetry.trajectory is not None:
        return Samples(telemetry.trajectory.times, continuous(telemetry.trajectory.orientation))
    if telemetry.camera_orientation is not None:
        # Its samples are of the middle row though their stamps are the frame's.
        delay = 0.5 * (telemetry.readout or 0.0)
        return Samples(telemetry.camera_orientation.times + delay, continuous(telemetry.camera_orientation.values))
    raise InputError("telemetry", "gyroscope", "nothing tells how the camera turned: no gyroscope, no orientation")


def _integrated(telemetry: Telemetry) -> Samples:
    """The camera's orientation to that at the first sample, by its gyroscope without its constant error."""
    gyroscope = telemetry.gyroscope
    assert gyroscope is not None
    rates = gyroscope.values - gyroscope_bias(telemetry)
    turns = from_rotvec(0.5 * (rates[1:] + rates[:-1]) * np.diff(gyroscope.times)[:, None])
    return Samples(gyroscope.times, continuous(_products(turns)))


def _products(turns: Array) -> Array:
    """``1, q1, q1 q2 ...`` of quaternions ``[N, 4]``, by doubling: some twenty products of whole arrays."""
    out = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], turns])
    step = 1
    while step < len(out):
        out = np.concatenate([out[:step], multiply(out[:-step], out[step:])])
        step *= 2
    return normalize(out)


def _orientation_at(samples: Samples, times: Array) -> Array:
    """Orientations ``[T, 4]`` between samples ``[N, 4]`` whose signs are continuous, at a constant rate in between.

    Just outside the samples the first and the last rate go on.
    """
    _check(samples, times)
    left = np.clip(np.searchsorted(samples.times, times, side="right") - 1, 0, max(len(samples.times) - 2, 0))
    right = np.minimum(left + 1, len(samples.times) - 1)
    gap = samples.times[right] - samples.times[left]
    share = np.where(gap > 0, (times - samples.times[left]) / np.where(gap > 0, gap, 1.0), 0.0)
    turn = to_rotvec(multiply(conjugate(samples.values[left]), samples.values[right]))
    return multiply(samples.values[left], from_rotvec(share[:, None] * turn))


def _interpolated(samples: Samples, times: Array) -> Array:
    _check(samples, times)
    return np.stack([np.interp(times, samples.times, column) for column in samples.values.T], axis=1)


def _check(samples: Samples, times: Array) -> None:
    """Raises InputError where times are more than half a second outside the samples."""
    if not len(samples.times):
        raise InputError("telemetry", "samples", "there are none")
    early, late = samples.times[0] - times.min(initial=np.inf), times.max(initial=-np.inf) - samples.times[-1]
    if max(early, late) > _HELD:
        end = f"begins {early:.3f} s after" if early > late else f"ends {late:.3f} s before"
        raise InputError("telemetry", "times", f"{end} what is asked: not of this video, or cut")


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def image_rotation(telemetry: Telemetry, times: Array) -> Array | None:
    """How each frame's picture is turned against the camera: ``[T, 4]`` from picture to camera axes.

    Args:
        telemetry: of the film.
        times: ``[T]`` s of the frames.

    Returns:
        None where the file does not say.

    Raises:
        InputError: the times are not of this film.
    """
    if telemetry.image_orientation is None:
        return None
    return _orientation_at(telemetry.image_orientation, np.asarray(times, dtype=np.float64))
