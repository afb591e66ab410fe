"""The motions of ``egopose bench film``: people whom no weights saw, on the humanoid, made long by loops and bends.

The clips are in ``assets/bench``. A recorded walk crosses a room in three seconds. Here a cycle of it is looped, and
its path is bent by a smooth yaw rate, so that walks are long and turn. Slow ones are recorded walks played slowly, and
standing is one recorded pose that sways.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.io.native import read_native
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: Clips by name, in the order of tables.
CLIPS = ("walk", "brisk", "slow", "standing", "turning")
#: s, lengths of looped clips. The walk turns 90 degrees left in its first half, and right in its second.
SECONDS = {"walk": 10.0, "brisk": 6.0, "slow": 6.0, "standing": 15.0, "turning": 8.0}
_FPS = 30.0
_SOURCES = {
    "walk": "cmu35_walking_6",
    "brisk": "cmu10_04",
    "slow": "cmu10_04",
    "standing": "cmu131_02",
    "turning": "cmu10_04",
}
# Frames of a cycle, at least and at most: 0.7 s is a quick stride, 3 s are some slow ones.
_SHORTEST, _LONGEST = 20, 90
# The edge of a clip where nobody walks yet or any more, frames.
_EDGE = 8
# s from start to end of a turn by 90 degrees, and of the Gaussian that rounds it.
_TURN, _ROUNDING = 1.5, 0.2
# Of the recorded speed: the slow walk's, and that of the steps of who turns on the spot.
_SLOWED = {"slow": 0.7, "turning": 0.6}
# Quiet standing sways as a pendulum about the ankles, 0.2 to 0.5 Hz, by half a degree (Winter 1995); breath lifts the
# chest 15 times a minute.
_SWAY, _SWAY_HZ = np.deg2rad([0.35, 0.5]), (0.23, 0.31)
_BREATH, _BREATH_HZ = np.deg2rad(0.6), 0.25


def bench_clip(name: str, humanoid: HumanoidModel) -> Array:
    """``[T, nq]`` at 30 frames/s of a clip of :data:`CLIPS`.

    Raises:
        InputError: there is no clip of that name, or the humanoid has another skeleton than the clips.
    """
    if name not in CLIPS:
        raise InputError("bench film", "clip", f"{name!r}; there are {', '.join(CLIPS)}")
    motion = read_native(Path(str(files("egopose") / "assets" / "bench" / f"{_SOURCES[name]}.motion.npz")))
    if motion.skeleton.names != humanoid.skeleton.names or motion.fps != _FPS:
        raise InputError("bench film", "humanoid", "has another skeleton or rate than the clips of the bench")
    seconds = SECONDS[name]
    if name == "standing":
        return standing(motion, seconds)
    qpos = looped(motion.resample(_FPS / _SLOWED.get(name, 1.0)).qpos, seconds)
    times = np.arange(len(qpos)) / _FPS
    if name == "walk":
        return bent(qpos, turns(times, ((0.25 * seconds, 90.0), (0.75 * seconds, -90.0))))
    if name == "turning":
        return bent(on_the_spot(qpos), turns(times, ((0.3 * seconds, 90.0), (0.7 * seconds, -90.0))))
    return qpos


def cycle(qpos: Array) -> tuple[int, int]:
    """Two frames of a walk ``[T, nq]`` with the most alike poses and velocities, a stride or some apart.

    Raises:
        ValueError: the clip is too short to hold a cycle.
    """
    posture = np.column_stack([qpos[:, 7:], qpos[:, 2]])
    # Velocities count five times, so that a leg that swings back is not taken for one that swings ahead.
    both = np.column_stack([posture[:-1], 5.0 * np.diff(posture, axis=0)])
    best, found = np.inf, None
    for first in range(_EDGE, len(both) - _EDGE - _SHORTEST):
        others = both[first + _SHORTEST : min(first + _LONGEST, len(both) - _EDGE)]
        apart = np.abs(others - both[first]).sum(axis=1)
        if len(apart) and apart.min() < best:
            best, found = float(apart.min()), (first, first + _SHORTEST + int(apart.argmin()))
    if found is None:
        raise ValueError(f"{len(qpos)} frames hold no cycle")
    return found


def looped(qpos: Array, seconds: float, fps: float = _FPS) -> Array:
    """A walk ``[T, nq]`` as long as wished: its cycle again and again, each where the one before ends.

    What the poses at the two ends of the cycle differ is spread over the cycle, and so is what the heading differs.
    """
    first, last = cycle(qpos)
    length = last - first
    part = qpos[first : last + 1].copy()
    share = np.linspace(0.0, 1.0, length + 1)[:, None]
    part[:, 7:] += share * (part[0, 7:] - part[-1, 7:])
    part[:, 2] += share[:, 0] * (part[0, 2] - part[-1, 2])
    # The root's rotation comes back as well: the way stays straight.
    back = rot.to_rotvec(rot.multiply(part[0, 3:7], rot.conjugate(part[-1, 3:7])))
    part[:, 3:7] = rot.multiply(rot.from_rotvec(share * back), part[:, 3:7])
    count = round(seconds * fps) + 1
    copies = -(-count // length)
    out = np.tile(part[:-1], (copies, 1))
    out[:, :2] += np.repeat(np.arange(copies)[:, None] * (part[-1, :2] - part[0, :2]), length, axis=0)
    out[:, 3:7] = rot.continuous(out[:, 3:7])
    return np.asarray(out[:count])


def bent(qpos: Array, rate: Array, fps: float = _FPS) -> Array:
    """A motion ``[T, nq]`` whose way and heading turn by a yaw rate ``[T]`` rad/s in addition; speeds stay."""
    angle = np.concatenate([[0.0], np.cumsum(rate[:-1])]) / fps
    out = qpos.copy()
    step, cos, sin = np.diff(qpos[:, :2], axis=0), np.cos(angle[:-1]), np.sin(angle[:-1])
    turned = np.stack([cos * step[:, 0] - sin * step[:, 1], sin * step[:, 0] + cos * step[:, 1]], axis=1)
    out[1:, :2] = qpos[0, :2] + np.cumsum(turned, axis=0)
    out[:, 3:7] = rot.multiply(rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), angle), qpos[:, 3:7])
    return out


def turns(times: Array, wanted: tuple[tuple[float, float], ...]) -> Array:
    """Yaw rate ``[T]`` rad/s of smooth turns: each a middle (s) and degrees to the left, :data:`_TURN` s long."""
    rate = np.zeros_like(times)
    for middle, degrees in wanted:
        inside = np.abs(times - middle) <= 0.5 * _TURN
        rate[inside] += np.deg2rad(degrees) / (inside.sum() * (times[1] - times[0]))
    return np.asarray(gaussian_filter1d(rate, _ROUNDING / float(times[1] - times[0]), mode="constant"))


def on_the_spot(qpos: Array) -> Array:
    """A looped walk without its way: the mean step is taken out, the sway stays."""
    out = qpos.copy()
    out[:, :2] -= np.linspace(0.0, 1.0, len(qpos))[:, None] * (qpos[-1, :2] - qpos[0, :2])
    return out


def standing(motion: Motion, seconds: float, fps: float = _FPS) -> Array:
    """The first pose of a motion, which sways about the ankles and breathes. ``[T, nq]``."""
    times = np.arange(round(seconds * fps) + 1) / fps
    out = np.repeat(motion.qpos[:1], len(times), axis=0)
    tilt = np.zeros((len(times), 3))
    tilt[:, :2] = _SWAY * np.sin(2 * np.pi * times[:, None] * _SWAY_HZ)
    lean = rot.from_rotvec(tilt)
    ankles = np.array([out[0, 0], out[0, 1], 0.08])
    out[:, :3] = ankles + rot.rotate(lean, out[:, :3] - ankles)
    out[:, 3:7] = rot.multiply(lean, out[:, 3:7])
    # Its first hinge bends the spine ahead.
    out[:, 7] += _BREATH * np.sin(2 * np.pi * times * _BREATH_HZ)
    return out
