"""What the inertial sensors of a virtual camera measure, and what the camera says of its own and its picture's turn."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion.rotations import Array, from_scipy
from egopose.vision.camera_tracks import Track, turn_between
from egopose.vision.telemetry.samples import Samples, Telemetry

_RATE = 200.0
_GRAVITY = 9.81


def inertial_samples(
    track: Track, duration: float, rng: np.random.Generator, noise: float, bias: float
) -> tuple[Samples, Samples]:
    """Gyroscope (rad/s) and accelerometer (m/s^2) at 200 Hz, ``[N, 3]`` in camera axes.

    The accelerometer measures the push that carries it: of a level camera at rest (0, -9.81, 0).

    Args:
        track: of the camera.
        duration: s of the motion.
        rng: of the noise.
        noise: rad/s, standard deviation of the gyroscope; the accelerometer's is ten times the number, in m/s^2.
        bias: rad/s, standard deviation of its constant error on each axis.
    """
    step = 1.0 / _RATE
    # A sample is the mean over its interval; all of them lie within the motion, which stands still before and behind.
    times = (np.arange(max(int(duration * _RATE), 3), dtype=np.float64) + 0.5) * step
    edges = np.append(times - 0.5 * step, times[-1] + 0.5 * step)
    position, rotation = track(edges)
    gyroscope = turn_between(rotation[:-1], rotation[1:]) / step
    _, turned = track(times)
    velocity = np.diff(position, axis=0) / step
    push = np.asarray(np.gradient(velocity, step, axis=0), dtype=np.float64)
    push[:, 2] += _GRAVITY
    accelerometer = np.asarray(np.einsum("tji,tj->ti", turned, push))
    gyroscope = gyroscope + rng.normal(scale=bias, size=3) + rng.normal(scale=noise, size=gyroscope.shape)
    accelerometer = accelerometer + rng.normal(scale=10.0 * noise, size=accelerometer.shape)
    return Samples(times, gyroscope), Samples(times, accelerometer)


def orientation_samples(times: Array, rotations: Array, image: Array) -> tuple[Samples, Samples, Samples]:
    """Camera orientation against the first frame's, image orientation, and down, one a frame.

    Args:
        times: ``[T]`` s, the frames' stamps.
        rotations: ``[T, 3, 3]`` of the camera to the world.
        image: ``[T, 3, 3]`` of the picture to the camera.
    """
    camera = from_scipy(Rotation.from_matrix(rotations[0].T @ rotations), (len(rotations),))
    picture = from_scipy(Rotation.from_matrix(image), (len(image),))
    return Samples(times, camera), Samples(times, picture), Samples(times, -rotations[:, 2, :])


def camera_telemetry(
    times: Array, rotations: Array, image: Array, gyroscope: Samples, accelerometer: Samples
) -> Telemetry:
    """All that the sensors tell; the settings of the lens and the shutter are still to be filled in."""
    camera, picture, down = orientation_samples(times, rotations, image)
    return Telemetry(
        model="virtual",
        gyroscope=gyroscope,
        accelerometer=accelerometer,
        gravity=down,
        camera_orientation=camera,
        image_orientation=picture,
    )
