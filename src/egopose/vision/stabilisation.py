"""A steadied film back to what the camera saw: every picture is turned back by what the camera turned it by.

A camera that steadies its film turns and crops each picture. The flow of such a film tells how the cropped view
moved, not how the wearer's head did.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from egopose.vision.lens import Camera
from egopose.vision.telemetry.camera import require_undoable
from egopose.vision.telemetry.frames import image_rotation
from egopose.vision.telemetry.samples import Telemetry
from egopose.vision.video import Frame

_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


def as_the_camera_saw(
    frames: Iterable[tuple[float, Frame]], telemetry: Telemetry, camera: Camera, size: int, path: str | PathLike[str]
) -> Iterator[tuple[float, Frame, NDArray[np.bool_]]]:
    """A film through :meth:`Camera.turning_rectifier`, each picture turned back.

    Args:
        frames: times (s of the video) and pictures, as :func:`egopose.vision.video.read_frames` gives them.
        telemetry: of the film.
        camera: with a field of view; ``stabilised="ignore"`` leaves pictures as they are turned.
        size: half the side of the squares, pixels.
        path: the film, for errors.

    Yields:
        Time, square ``[2 size, 2 size, 3]`` and ``[2 size, 2 size]`` where the film has a picture of it.

    Raises:
        InputError: the picture was steadied and the file does not say how; no field of view; a time not of this film.
    """
    ignored = camera.stabilised == "ignore"
    if not ignored:
        require_undoable(telemetry, path)
    rectify = None
    for time, frame in frames:
        if rectify is None:
            rectify = camera.turning_rectifier(frame.shape[1], frame.shape[0], size)
        turn = None if ignored else image_rotation(telemetry, np.array([time]))
        yield time, *rectify(frame, _UNTURNED if turn is None else turn[0])
