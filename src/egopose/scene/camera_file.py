"""A camera's motion as an ``.npz``: ``to_first [T, 3, 3]``, ``degenerate [T]``, ``alike [T]``, ``kind`` (UTF-8 bytes).

See :class:`egopose.scene.camera.CameraTrack` for what they mean.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._npz import read_arrays
from egopose.scene.camera import KINDS, CameraTrack


def save_camera(camera: CameraTrack, path: Path) -> None:
    """Write ``path``, an ``.npz`` without pickle."""
    kind = np.frombuffer(camera.kind.encode(), dtype=np.uint8)
    np.savez_compressed(path, to_first=camera.to_first, degenerate=camera.degenerate, alike=camera.alike, kind=kind)


def load_camera(path: Path) -> CameraTrack:
    """Read what :func:`save_camera` wrote.

    Raises:
        InputError: an array is missing, of another shape, or not finite.
    """
    names = ("to_first", "degenerate", "alike", "kind")
    arrays = read_arrays(path, names)
    if missing := [name for name in names if name not in arrays]:
        raise InputError(path, missing[0], "is missing: this is no motion of a camera")
    to_first, kind = arrays["to_first"], arrays["kind"].tobytes().decode(errors="replace")
    if to_first.ndim != 3 or to_first.shape[1:] != (3, 3) or not np.isfinite(to_first).all():
        raise InputError(path, "to_first", f"must be [T, 3, 3] and finite, got {list(to_first.shape)}")
    for name in ("degenerate", "alike"):
        if arrays[name].shape != (len(to_first),):
            raise InputError(path, name, f"must be [{len(to_first)}], got {list(arrays[name].shape)}")
    if kind not in KINDS:
        raise InputError(path, "kind", f"{kind[:40]!r} is none of {', '.join(KINDS)}")
    return CameraTrack(to_first.astype(np.float64), arrays["degenerate"].astype(bool), arrays["alike"], kind)


def given_camera(path: Path, frames: int) -> CameraTrack:
    """A camera's motion that is known beforehand, for ``frames`` frames.

    Raises:
        InputError: no such file, a damaged one, or one of another number of frames.
    """
    if not path.is_file():
        raise InputError(path, "camera.track", "no such file")
    camera = load_camera(path)
    if len(camera) != frames:
        raise InputError(path, "camera.track", f"has {len(camera)} frames; there are poses of {frames}")
    return camera
