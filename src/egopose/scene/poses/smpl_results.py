"""Results of VIBE, WHAM and GVHMR in, as ``.npz`` of plain arrays under the programs' own names.

The programs themselves write pickles (``vibe_output.pkl``, ``wham_output.pkl``, ``hmr4d_results.pt``). A pickle runs
whatever its writer put there, so none is opened here. The error that refuses one says how to convert it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._npz import entry_names, read_arrays
from egopose.motion.rotations import Array
from egopose.scene.poses.from_motion import read_motion_poses
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.poses.track import MAX_FRAMES, PoseTrack

#: VIBE's joints are SPIN's 49, of which the first 25 are OpenPose's in its order.
_SPIN = 49
_FURTHEST = 1e5

_CONVERT_PKL = (
    "import numpy; from joblib import load; "
    "[numpy.savez(f'person{k}.npz', **{n: v for n, v in p.items() if isinstance(v, "
    "numpy.ndarray)}) for k, p in load(FILE).items()]"
)
_CONVERT_PT = (
    "import numpy; from torch import load; "
    "numpy.savez('person.npz', **{n: v.numpy() for n, v in load(FILE, weights_only=True)"
    "['smpl_params_global'].items()})"
)


def refuse_pickle(path: str | Path, **_: object) -> PoseTrack:
    """Raises InputError with the command that turns a pickle into an ``.npz``."""
    command = _CONVERT_PKL if Path(path).suffix.lower() == ".pkl" else _CONVERT_PT
    command = command.replace("FILE", repr(Path(path).name))
    cause = f'is a pickle, which can run code; if you trust who wrote it, convert it: python -c "{command}"'
    raise InputError(path, "suffix", cause)


def read_smpl_results(path: str | Path, *, fps: float | None = None, up: str = "auto") -> PoseTrack:
    """One person's 3D keypoints of such a result.

    VIBE's ``joints3d [T, 49, 3]`` give ``BODY_25`` in camera axes, relative to the middle of the hips, and its
    ``joints2d_img_coord`` pixels. Of others the parameters are posed on a plain adult's bones in world axes: WHAM's
    ``pose_world`` and ``trans_world``, GVHMR's ``global_orient``, ``body_pose`` and ``transl``, and what else
    :func:`egopose.motion.io.amass.read_amass` knows. ``frame_ids [T]`` tells frames in which the person was not found.

    Args:
        path: the file.
        fps: frames per second of the video; the programs do not write it.
        up: the world's up axis, see :func:`~egopose.motion.io.amass.read_amass`.

    Raises:
        InputError: an array missing, of another shape or not finite, no frame rate.
    """
    path = Path(path)
    vibe = "joints3d" in entry_names(path)
    track = _read_vibe(path, fps) if vibe else read_motion_poses(path, up=up, **({} if fps is None else {"fps": fps}))
    ids = read_arrays(path, ("frame_ids",)).get("frame_ids")
    return track if ids is None else _spread(path, track, ids)


def _read_vibe(path: Path, fps: float | None) -> PoseTrack:
    if fps is None or not 0 < fps <= 1e4:
        raise InputError(path, "option fps", "VIBE does not write the frame rate: say fps=RATE of the video")
    arrays = read_arrays(path, ("joints3d", "joints2d_img_coord"))
    positions = _joints(path, "joints3d", arrays["joints3d"], 3)
    hips = positions[:, [BODY_25.index("mid_hip")]]
    pixels = np.full((len(positions), len(BODY_25), 2), np.nan)
    if "joints2d_img_coord" in arrays:
        pixels = _joints(path, "joints2d_img_coord", arrays["joints2d_img_coord"], 2)
    if len(pixels) != len(positions):
        raise InputError(path, "joints2d_img_coord", f"{len(pixels)} frames, joints3d has {len(positions)}")
    return PoseTrack(BODY_25, pixels, np.ones(pixels.shape[:2]), fps, positions=positions - hips)


def _joints(path: Path, name: str, array: np.ndarray, axes: int) -> Array:
    """``[T, 25, axes]`` of SPIN's joints."""
    if array.ndim != 3 or array.shape[1:] != (_SPIN, axes) or not 0 < len(array) <= MAX_FRAMES:
        raise InputError(path, name, f"must be [T, {_SPIN}, {axes}], got {list(array.shape)}")
    values = array[:, : len(BODY_25)].astype(np.float64)
    bad = ~(np.abs(values) < _FURTHEST).all(axis=(1, 2))
    if bad.any():
        raise InputError(path, name, f"frame {int(np.argmax(bad))} is not finite or absurdly large")
    return values


def _spread(path: Path, track: PoseTrack, ids: np.ndarray) -> PoseTrack:
    """The track with the frames left out put back as unknown ones."""
    numbers = ids.reshape(-1)
    if numbers.dtype.kind not in "iu" or len(numbers) != len(track) or (np.diff(numbers.astype(np.int64)) <= 0).any():
        raise InputError(path, "frame_ids", f"must be {len(track)} whole numbers that rise")
    numbers = numbers.astype(np.int64) - int(numbers[0])
    frames = int(numbers[-1]) + 1
    if frames > MAX_FRAMES:
        raise InputError(path, "frame_ids", f"{frames} frames; at most {MAX_FRAMES} are read")

    def spread(values: Array, empty: float) -> Array:
        out = np.full((frames, *values.shape[1:]), empty)
        out[numbers] = values
        return out

    positions = None if track.positions is None else spread(track.positions, np.nan)
    pixels, confidence = spread(track.pixels, np.nan), spread(track.confidence, 0.0)
    return PoseTrack(
        track.schema, pixels, confidence, track.fps, positions=positions, axes=track.axes, notes=track.notes
    )
