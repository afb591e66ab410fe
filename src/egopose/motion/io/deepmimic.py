"""DeepMimic text: JSON of 44 numbers a frame for one fixed humanoid (Peng et al. 2018).

A frame holds its duration (s), the root's position (m, y up), then rotations as quaternions ``wxyz``, one angle (rad)
at knees and elbows. The humanoid stands along y, faces x, its right is z.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Slerp

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io._files import read_text
from egopose.motion.io.frames import euler_angles, frame_rate, given_rate, given_up, up_rotation
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Joint, Skeleton, hinges

_COLUMNS = 44

#: Bytes of JSON: twenty minutes at 30 frames/s; as Python objects it takes up to thirty times as much.
_MAX_BYTES = 32 * 2**20

#: With the twist in the middle no ball joint of the 29 published clips comes within 9 degrees of a quarter turn there;
#: the other orders lock in flips (hips) or with arms held forward (shoulders).
_BALL = "xyz"


def _skeleton() -> Skeleton:
    def leg(side: str, z: float) -> list[tuple[str, str, tuple[float, float, float], str]]:
        return [
            (f"{side}_hip", "root", (0.0, 0.0, z * 0.084887), _BALL),
            (f"{side}_knee", f"{side}_hip", (0.0, -0.421546, 0.0), "z"),
            (f"{side}_ankle", f"{side}_knee", (0.0, -0.409870, 0.0), _BALL),
        ]

    def arm(side: str, z: float) -> list[tuple[str, str, tuple[float, float, float], str]]:
        return [
            (f"{side}_shoulder", "chest", (-0.02405, 0.24350, z * 0.18311), _BALL),
            (f"{side}_elbow", f"{side}_shoulder", (0.0, -0.274788, 0.0), "z"),
            (f"{side}_wrist", f"{side}_elbow", (0.0, -0.258947, 0.0), ""),
        ]

    # The crown and the four corners of each sole that the humanoid's collision shapes reach to.
    sole = tuple((x, -0.05, z) for x in (-0.0435, 0.1335) for z in (-0.045, 0.045))
    tips = {"neck": ((0.0, 0.2775, 0.0),), "right_ankle": sole, "left_ankle": sole}
    rows = [("root", "", (0.0, 0.0, 0.0), ""), ("chest", "root", (0.0, 0.236151, 0.0), _BALL)]
    rows += [("neck", "chest", (0.0, 0.223894, 0.0), _BALL)]
    rows += leg("right", 1.0) + arm("right", 1.0) + leg("left", -1.0) + arm("left", -1.0)
    names = [row[0] for row in rows]
    return Skeleton(
        tuple(
            Joint(name, names.index(parent) if parent else -1, offset, hinges(axes), tips.get(name, ()))
            for name, parent, offset, axes in rows
        ),
        name="deepmimic",
    )


#: The humanoid all DeepMimic clips are made for.
DEEPMIMIC_SKELETON = _skeleton()


def read_deepmimic(path: str | Path, *, up: str = "auto", fps: float | None = None, encoding: str = "auto") -> Motion:
    """Read a DeepMimic clip; frames of uneven duration are resampled to the commonest rate.

    Args:
        path: the file.
        up: its up axis; ``"auto"``: y, as the format has it.
        fps: frames per second, in place of the frames' durations.
        encoding: of the text, see :func:`egopose.motion.io._files.read_text`.

    Returns:
        z up, facing +x at the identity. ``meta["loop"]`` is the file's ``Loop``.

    Raises:
        InputError: not JSON, no ``Frames``, a frame that is not 44 finite numbers, durations that are not positive,
            a quaternion of a length outside 0.1 to 2 (others are normalised).
    """
    path = Path(path)
    up = "y" if given_up(path, up) == "auto" else up
    loop, frames = _parse(path, encoding)
    if fps is not None:
        frames[:, 0] = 1.0 / given_rate(path, fps)
    durations = frames[:, 0]
    if len(frames) > 1 and not (durations[:-1] > 0).all():
        bad = int(np.argmax(durations[:-1] <= 0))
        raise InputError(path, f"Frames[{bad}]", f"duration {durations[bad]:g} s is not positive")
    step = float(np.median(durations[:-1])) if len(frames) > 1 else float(durations[0])
    if not 1e-5 <= step <= 10.0:
        raise InputError(path, "Frames", f"duration {step:g} s is not between 1e-5 and 10")
    fps = frame_rate(step) if fps is None else fps
    times = np.concatenate([[0.0], np.cumsum(durations[:-1])])
    even = len(frames) == 1 or bool(np.abs(durations[:-1] - step).max() < 1e-3 * step)
    if not even and times[-1] * fps > 10 * len(frames):
        raise InputError(
            path, "Frames", f"durations differ too much to share a rate: {len(frames)} frames, {times[-1]:g} s"
        )
    at = times if even else np.arange(int(times[-1] * fps + 1e-6) + 1) / fps

    def linear(values: Array) -> Array:
        return values if even else np.stack([np.interp(at, times, v) for v in values.T], axis=-1)

    def ball(column: int) -> Array:
        quats = frames[:, column : column + 4]
        lengths = np.linalg.norm(quats, axis=-1)
        if lengths.min() < 0.1 or lengths.max() > 2.0:  # published clips hold blends as short as 0.58
            bad = int(np.argmax(np.abs(np.log(np.maximum(lengths, 1e-12)))))
            cause = f"numbers {column} to {column + 3}: a quaternion of length {lengths[bad]:.3g}, far from 1"
            raise InputError(path, f"Frames[{bad}]", cause)
        if even:
            return rot.continuous(rot.normalize(quats))
        return rot.continuous(rot.from_scipy(Slerp(times, rot.to_scipy(quats))(at), (len(at),)))

    to_z_up = up_rotation(up)
    columns = [rot.rotate(to_z_up, linear(frames[:, 1:4])), rot.multiply(to_z_up, ball(4))]
    column = 8
    for joint in DEEPMIMIC_SKELETON.joints[1:]:
        if len(joint.dofs) == 3:
            columns.append(euler_angles(ball(column), _BALL))
            column += 4
        elif len(joint.dofs) == 1:
            columns.append(linear(frames[:, column : column + 1]))
            column += 1
    meta = {"format": "deepmimic", "source": path.name, "unit": "m", "unit_metres": 1.0, "up": up, "loop": loop}
    return Motion(DEEPMIMIC_SKELETON, np.concatenate(columns, axis=1), float(fps), name=path.stem, meta=meta)


def _parse(path: Path, encoding: str) -> tuple[str, Array]:
    """The file's ``Loop`` and its frames ``[T, 44]``."""
    text = read_text(path, _MAX_BYTES, encoding)
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(path, f"line {error.lineno}", f"not JSON: {error.msg}") from error
    except ValueError as error:  # a whole number of thousands of digits
        raise InputError(path, "Frames", f"not JSON: {error}"[:120]) from error
    except RecursionError:
        raise InputError(path, "Frames", "brackets nested too deeply") from None
    frames = content.get("Frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(path, "Frames", "a DeepMimic clip is a JSON object with a list of frames; there is none")
    for i, frame in enumerate(frames):
        if not isinstance(frame, list) or len(frame) != _COLUMNS:
            result = f"{len(frame)} numbers" if isinstance(frame, list) else type(frame).__name__
            raise InputError(path, f"Frames[{i}]", f"a frame is {_COLUMNS} numbers, found {result}")
        for k, value in enumerate(frame):
            if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
                raise InputError(path, f"Frames[{i}]", f"number {k} is {value!r:.40}: not a finite number of sane size")
    return str(content.get("Loop", "none"))[:40], np.array(frames, dtype=np.float64)
