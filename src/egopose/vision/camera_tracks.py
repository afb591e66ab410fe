"""Where a camera is at any time: smooth between the frames of the motion that carries it.

Rolling shutters and inertial sensors ask for times between a motion's frames. Cubic splines answer, not straight lines:
a motion of 30 frames/s in straight lines would jerk an accelerometer 30 times a second.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, continuous, from_scipy, to_scipy
from egopose.vision.mounts import Mount, camera_poses

# Times [N] s to positions [N, 3] m and rotations [N, 3, 3] from camera axes (x right, y down, z ahead) to the world.
Track = Callable[[Array], tuple[Array, Array]]
# s over which a turn's speed is measured: much less than a step's shake, much more than rounding.
_STEP = 0.002


class Poses:
    """A motion at any time within it; before and behind it stands still.

    Args:
        qpos: ``[T, nq]``, the first seven a free joint, the others hinges.
        fps: frames/s.

    Raises:
        InputError: no frames, numbers that are not finite, or a rate that cannot be.
    """

    def __init__(self, qpos: Array, fps: float) -> None:
        qpos = np.asarray(qpos, dtype=np.float64)
        if qpos.ndim != 2 or not len(qpos) or qpos.shape[1] < 7 or not np.isfinite(qpos).all():
            raise InputError("film", "qpos", f"has shape {list(qpos.shape)}: finite numbers [T, 7 or more] are needed")
        if not 0.0 < fps <= 1000.0:
            raise InputError("film", "motion_fps", f"{fps}; more than 0 and at most 1000")
        self.duration = (len(qpos) - 1) / fps
        # A spline needs two frames.
        frames = qpos if len(qpos) > 1 else np.repeat(qpos, 2, axis=0)
        times = np.arange(len(frames)) / fps
        self._plain = CubicSpline(times, np.concatenate([frames[:, :3], frames[:, 7:]], axis=1))
        self._turn = RotationSpline(times, to_scipy(continuous(frames[:, 3:7])))

    def at(self, times: Array) -> Array:
        """``[N, nq]`` at times ``[N]`` s."""
        times = np.clip(times, 0.0, self.duration)
        plain = self._plain(times)
        return np.concatenate([plain[:, :3], from_scipy(self._turn(times), (len(times),)), plain[:, 3:]], axis=1)


def worn_track(model: mujoco.MjModel, poses: Poses, mount: Mount, angles: Array, shifts: Array) -> Track:
    """The track of a camera that a moving body wears.

    Args:
        model: the humanoid.
        poses: its motion.
        mount: how the camera is worn.
        angles: ``[K, 3]`` rad of play or sway, evenly spaced over the motion.
        shifts: ``[K, 3]`` m, likewise.
    """
    stamps = np.linspace(0.0, max(poses.duration, 1e-9), len(angles))
    play = CubicSpline(stamps, np.concatenate([angles, shifts], axis=1))

    def track(times: Array) -> tuple[Array, Array]:
        now = play(np.clip(times, 0.0, poses.duration))
        return camera_poses(model, poses.at(times), mount, now[:, :3], now[:, 3:])

    return track


def angular_velocity(track: Track, times: Array) -> Array:
    """rad/s ``[N, 3]`` about camera axes at times ``[N]`` s."""
    before, after = (track(times + step)[1] for step in (-0.5 * _STEP, 0.5 * _STEP))
    return turn_between(before, after) / _STEP


def turn_between(before: Array, after: Array) -> Array:
    """rad ``[N, 3]`` by which rotations ``[N, 3, 3]`` to the world differ, about the camera's own axes."""
    return np.asarray(Rotation.from_matrix(before.transpose(0, 2, 1) @ after).as_rotvec())


def free_track(times: Array, positions: Array, rotations: Array) -> Track:
    """The track of a camera that nobody wears, through given places ``[N, 3]`` m and rotations ``[N, 3, 3]``."""
    plain, turn = CubicSpline(times, positions), RotationSpline(times, Rotation.from_matrix(rotations))

    def track(now: Array) -> tuple[Array, Array]:
        inside = np.clip(now, times[0], times[-1])
        return plain(inside), turn(inside).as_matrix()

    return track
