"""One door for poses that another program found: a folder or a file, told by its ending."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from egopose.core.errors import InputError
from egopose.motion.io._npz import entry_names
from egopose.scene.poses.from_motion import read_motion_poses
from egopose.scene.poses.openpose import read_openpose
from egopose.scene.poses.smpl_results import read_smpl_results, refuse_pickle
from egopose.scene.poses.track import PoseTrack, load_track

_READERS: dict[str, Callable[..., PoseTrack]] = {
    "": read_openpose,
    ".npz": read_smpl_results,
    ".bvh": read_motion_poses,
    ".trc": read_motion_poses,
    ".c3d": read_motion_poses,
    ".amc": read_motion_poses,
    ".mvnx": read_motion_poses,
    ".pkl": refuse_pickle,
    ".pickle": refuse_pickle,
    ".pt": refuse_pickle,
    ".pth": refuse_pickle,
}


def read_poses(path: str | Path, **options: Any) -> PoseTrack:
    """Read poses; the ending says how, and for ``.npz`` the arrays inside.

    Args:
        path: a folder of OpenPose's JSON (options ``fps``, ``at``, ``image_size``), ``.npz`` (a saved track; VIBE,
            WHAM, GVHMR: ``fps``, ``up``; a clip of this project), ``.bvh``, ``.trc``, ``.c3d``, ``.amc``, ``.mvnx``
            (options of :func:`egopose.motion.io.read_motion`).
        options: of that reader.

    Raises:
        InputError: an unknown ending or option, a pickle, or a fault of the file.
    """
    path = Path(path)
    suffix = "" if path.is_dir() else path.suffix.lower()
    reader = _READERS.get(suffix)
    if reader is None or (not suffix and not path.is_dir()):
        known = ", ".join(name for name in _READERS if name)
        cause = f"no reader for {suffix!r}" if path.exists() else "no such file or folder"
        raise InputError(path, "path", f"{cause}; poses are a folder of OpenPose's JSON or one of {known}")
    if suffix == ".npz":
        names = entry_names(path)
        reader = load_track if "pose_layout" in names else read_motion_poses if "header" in names else reader
    if reader not in (read_motion_poses, refuse_pickle):
        known_options = list(reader.__kwdefaults__ or ())
        unknown = sorted(set(options) - set(known_options))
        if unknown:
            has = f"the options {', '.join(known_options)}" if known_options else "no options"
            raise InputError(path, f"option {unknown[0]}", f"{reader.__name__} has {has}")
    return reader(path, **options)
