"""The telemetry of one film, in camera axes: x right, y down, z ahead."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Samples:
    """A sensor's samples.

    Args:
        times: ``[N]`` s of the video (its first frame is at 0), rising.
        values: ``[N, k]``.
    """

    times: Array
    values: Array

    def __post_init__(self) -> None:
        assert self.times.ndim == 1
        assert self.values.ndim == 2
        assert len(self.times) == len(self.values)


@dataclass(frozen=True)
class Trajectory:
    """A camera's way through a world whose z is up.

    Args:
        times: ``[N]`` s.
        position: ``[N, 3]`` m, or None where only the orientation is known.
        orientation: ``[N, 4]`` wxyz, from camera axes to the world.
    """

    times: Array
    position: Array | None
    orientation: Array


@dataclass(frozen=True)
class Telemetry:
    """What a camera, or a sensor fixed to it, tells of a film; None where it does not.

    Args:
        model: the camera's own name, ``""`` where the file has none.
        gyroscope: ``[N, 3]`` rad/s, about camera axes, by the right-hand rule.
        accelerometer: ``[N, 3]`` m/s^2; a level camera at rest measures about (0, -9.8, 0): the push from below.
        gravity: ``[N, 3]`` unit vectors down; of a level camera (0, 1, 0).
        camera_orientation: ``[N, 4]`` wxyz, one a frame: takes camera axes to those the camera had when it started.
        image_orientation: ``[N, 4]`` wxyz, one a frame: takes a direction in the picture to the camera's axes. It is
            what stabilisation turned the picture by; camera_orientation * image_orientation is the steadied view.
        gps: ``[N, 5]``: latitude and longitude in degrees, altitude in m, speed over ground and in space in m/s.
        field_of_view: degrees across the width of the picture.
        lens: the mode of the lens: ``linear``, ``wide`` ... (:data:`egopose.vision.telemetry.lens_fields.LENSES`).
        readout: s from the exposure of the first row to that of the last.
        stabilised: whether the camera steadied the picture.
        lens_coefficients: what else the file has of the lens, by its own names (``POLY``, ``ZMPL``, ``ARUW``,
            ``ARWA``), as it stands there. GoPro's polynomial gives the angle of a radius; nothing here uses it.
        trajectory: of a sensor that also knows where it is.
    """

    model: str = ""
    gyroscope: Samples | None = None
    accelerometer: Samples | None = None
    gravity: Samples | None = None
    camera_orientation: Samples | None = None
    image_orientation: Samples | None = None
    gps: Samples | None = None
    field_of_view: float | None = None
    lens: str | None = None
    readout: float | None = None
    stabilised: bool | None = None
    lens_coefficients: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    trajectory: Trajectory | None = None
