"""A body's turns and place out of the arrays that AMASS, SMPL-X's own tools and pose estimators write.

Each of them has the same numbers under other names: AMASS one array ``poses`` or (SMPL-X) ``root_orient`` and
``pose_body``, the ``smplx`` package and estimators ``global_orient``, ``body_pose`` and ``transl``, WHAM
``pose_world`` and ``trans_world``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.motion.io._files import excerpt
from egopose.motion.io._npz import read_arrays
from egopose.motion.rotations import Array

#: Joints of the body that SMPL, SMPL-H and SMPL-X share; the pelvis is the first.
SHARED_JOINTS = 22

_WHOLE = ("pose_world", "poses", "pose", "fullpose", "full_pose")
_ROOT, _BODY = ("root_orient", "global_orient"), ("pose_body", "body_pose")
_PLACE = ("trans_world", "trans", "transl", "translation")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate", "frame_rate")

#: Joints in one array -> the body model.
_MODELS = {22: "body", 24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}
_BODY_ALONE = (21, 23)  # without the pelvis; SMPL's has a joint in each hand besides
_KINDS = "poses, or root_orient and pose_body, or global_orient and body_pose"


@dataclass(frozen=True)
class SmplArrays:
    """``turns [T, 22, 3]`` rotation vectors (rad) in each joint's parent, ``place [T, 3]`` (m).

    ``fps`` is None where the file does not say it; ``dropped`` counts the numbers a frame of fingers, jaw and eyes.
    """

    turns: Array
    place: Array
    fps: float | None
    model: str
    dropped: int


def read_smpl_arrays(path: Path) -> SmplArrays:
    """Read them.

    Raises:
        InputError: an array missing, of another shape, not finite, or of absurd size; a frame rate that is none.
    """
    arrays = read_arrays(path, (*_WHOLE, *_ROOT, *_BODY, *_PLACE, *_RATES))
    whole, root, body, place = (_first(arrays, names) for names in (_WHOLE, _ROOT, _BODY, _PLACE))
    if whole:
        turns = _rotation_vectors(path, whole, arrays[whole])
        model = _MODELS.get(turns.shape[1])
        if model is None:
            known = ", ".join(str(3 * count) for count in _MODELS)
            raise InputError(path, whole, f"{3 * turns.shape[1]} columns; known are {known}")
    elif root and body:
        above, below = (_rotation_vectors(path, name, arrays[name]) for name in (root, body))
        if above.shape[1] != 1 or below.shape[1] not in _BODY_ALONE or len(above) != len(below):
            cause = f"shape {arrays[body].shape} beside {root} {arrays[root].shape}; [T, 63] and [T, 3] are read"
            raise InputError(path, body, cause)
        turns, model = np.concatenate([above, below], axis=1), "body"
    else:
        raise InputError(path, "poses", f"missing: an AMASS or SMPL file holds {_KINDS}; trans or transl; and a rate")
    if not place:
        raise InputError(path, "trans", "missing: the root's place [T, 3] in metres, as trans or transl")
    values = arrays[place].reshape(len(arrays[place]), -1) if arrays[place].ndim else arrays[place]
    _check_floats(path, place, values)
    if values.shape != (len(turns), 3):
        raise InputError(path, place, f"shape {arrays[place].shape}, {whole or body} have {len(turns)} frames")
    dropped = 3 * (turns.shape[1] - SHARED_JOINTS)
    return SmplArrays(turns[:, :SHARED_JOINTS], values.astype(np.float64), _rate(path, arrays), model, dropped)


def _first(arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> str:
    """The first of the names that is there; empty where none is."""
    return next((name for name in names if name in arrays), "")


def _check_floats(path: Path, name: str, array: np.ndarray) -> None:
    if array.ndim < 2 or array.dtype.kind != "f" or not len(array):
        raise InputError(path, name, f"must be [T, n] floats, got {array.dtype} {array.shape}")
    bad = ~(np.abs(array.reshape(len(array), -1)) < 1e4).all(axis=1)
    if bad.any():
        raise InputError(path, name, f"frame {int(np.argmax(bad))} is not finite or absurdly large")


def _rotation_vectors(path: Path, name: str, array: np.ndarray) -> Array:
    """``[T, J, 3]`` of ``[T, 3 J]``, ``[T, J, 3]`` or, as matrices, ``[T, J, 3, 3]`` (of roots also ``[T, 3, 3]``)."""
    _check_floats(path, name, array)
    frames = len(array)
    if array.shape[-2:] == (3, 3) and (array.ndim == 4 or name in _ROOT):
        try:
            turns = Rotation.from_matrix(array.reshape(-1, 3, 3).astype(np.float64)).as_rotvec()
        except ValueError as error:
            raise InputError(path, name, f"holds matrices that are no rotations: {error}"[:120]) from None
        return turns.reshape(frames, -1, 3)
    if array.ndim > 3 or (array.ndim == 3 and array.shape[2] != 3) or array[0].size % 3:
        columns = f"{array[0].size} columns" if array.ndim == 2 else f"shape {array.shape}"
        raise InputError(path, name, f"{columns}; turns are three numbers a joint: [T, 3 J] or [T, J, 3]")
    return array.reshape(frames, -1, 3).astype(np.float64)


def _rate(path: Path, arrays: dict[str, np.ndarray]) -> float | None:
    name = _first(arrays, _RATES)
    if not name:
        return None
    value = arrays[name]
    if value.size != 1 or value.dtype.kind not in "fiu" or not 0.1 <= float(value.reshape(())) <= 1e5:
        shown = str(value.tolist()) if value.size == 1 else f"an array of shape {value.shape}"
        raise InputError(path, name, f"{excerpt(shown)} is not a frame rate; the option fps gives it instead")
    return float(value.reshape(()))
