"""The root's path and heading from a head signal: states whose velocities lead where the camera went.

A regressor of states knows how the body turns and sways within a step, and drifts. The head signal does not drift, but
it is the head's: people look about. So what is slow comes from the head, and what is quick from the states.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.pose_regression import integrated_path, split_state
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.vision.head_signal import HeadSignal
from egopose.vision.mounts import camera_poses, mount_of

#: s, standard deviation of the Gaussian that parts slow from quick. Steps are quicker; a glance aside takes a second.
_SLOW_TURN, _SLOW_MOVE = 0.6, 0.7
# Below the first number nothing moves, above the second all of it counts: m/s, and rad/s (2 and 5 degrees/s). Errors of
# a standing person's signal lie below.
_STANDS, _STANDING_TURN = (0.06, 0.14), (0.035, 0.09)
#: Of a body that stands straight: CMU's walkers carry their heads so much lower.
_WALKING_HEIGHT = 0.97
#: Qualities of the velocity below which it counts for nothing, and from which it counts in full. Level cameras that see
#: little ground outdoors have 0.3, those that see none in a small room 0.1 to 0.2.
_DOUBTED = (0.15, 0.3)
# Share of trusted frames from which the rest may be filled in by them.
_FULL = 0.7
#: s over which it is decided whether somebody stands.
_DECISION = 0.5
_UP = np.array([0.0, 0.0, 1.0])


def camera_height(humanoid: HumanoidModel, mount: str) -> float:
    """m above the floor of a camera that a humanoid wears while it walks."""
    pose = humanoid.mj_model.qpos0[None].copy()
    soles = sole_positions(humanoid, Motion(humanoid.skeleton, pose, 1.0 / humanoid.control_dt))
    positions, _ = camera_poses(humanoid.mj_model, pose, mount_of(mount))
    return _WALKING_HEIGHT * float(positions[0, 2] - soles[..., 2].min())


def path_of_signal(signal: HeadSignal, states: Array, height: float, fps: float) -> Array:
    """The root's path ``[T, 3]``: x, y (m) and heading (rad), from the origin and along x.

    Args:
        signal: of T frames.
        states: ``[T, S]`` what a regressor makes of them.
        height: m of the camera above the floor.
        fps: frames/s.
    """
    quick = integrated_path(states, fps)
    turned = quiet(signal.turning[:, 2], _STANDING_TURN, fps)
    away = gaussian_filter1d(np.cumsum(turned) / fps - quick[:, 2], _SLOW_TURN * fps, mode="nearest")
    heading = quick[:, 2] + away
    facing = np.cumsum(turned) / fps
    seen = _turned(signal.velocity[:, :2] * height, facing)
    own = np.zeros_like(seen)
    own[:-1] = _turned(_turned(np.diff(quick[:, :2], axis=0) * fps, -quick[:-1, 2]), heading[:-1])
    own[-1:] = own[-2:-1]  # the last state leads nowhere: as zero it would be a stop that the filter spreads
    # Walls close by, taken for the floor, make a speed that is no one's: there the states know better.
    trust = np.clip((signal.quality[:, 1:2] - _DOUBTED[0]) / (_DOUBTED[1] - _DOUBTED[0]), 0.0, 1.0)
    weight, kept = (
        gaussian_filter1d(part, _SLOW_MOVE * fps, axis=0, mode="nearest") for part in (trust, trust * (seen - own))
    )
    velocity = own + kept / np.maximum(weight, _FULL)
    speed = gaussian_filter1d(velocity, _DECISION * fps, axis=0, mode="nearest")
    velocity *= _share(np.hypot(*speed.T), _STANDS)[:, None]
    path = np.column_stack([np.cumsum(velocity, axis=0) / fps, heading])
    path[:, :2] -= path[0, :2]
    return np.asarray(np.column_stack([_turned(path[:, :2], -heading[:1].repeat(len(path))), heading - heading[0]]))


def quiet(values: Array, limits: tuple[float, float], fps: float) -> Array:
    """``values [T]``, zero where their mean over half a second is below the first of ``limits``."""
    mean = gaussian_filter1d(values, _DECISION * fps, mode="nearest")
    return np.asarray(values * _share(np.abs(mean), limits))


def states_on_path(states: Array, path: Array, fps: float) -> Array:
    """States ``[T, S]`` with the root's velocities that lead along ``path [T, 3]``; the rest stays.

    :func:`~egopose.models.pose_regression.integrated_path` of the result is the path.
    """
    out = np.array(states, dtype=np.float64)
    layout = StateLayout.of_size(out.shape[1])
    if len(out) < 2:
        return out
    step = np.diff(path[:, :2], axis=0) * fps
    linear, angular = layout.root_linear_velocity, layout.root_angular_velocity
    out[:-1, linear.start : linear.start + 2] = _turned(step, -path[:-1, 2])
    wanted = np.diff(path[:, 2])
    # A turn about the vertical, in the root's own frame; twice, as the root may lean.
    for _ in range(2):
        parts = split_state(out)
        turned = rot.heading(rot.multiply(parts.deheaded, rot.from_rotvec(parts.angular_velocity / fps)))
        missing = rot.wrapped(wanted - 2.0 * np.arctan2(turned[:-1, 3], turned[:-1, 0]))
        up = rot.rotate(rot.conjugate(parts.deheaded[:-1]), _UP)
        out[:-1, angular] += up * missing[:, None] * fps
    out[-1, layout.root_velocity] = out[-2, layout.root_velocity]
    return out


def _share(size: Array, limits: tuple[float, float]) -> Array:
    part = np.clip((size - limits[0]) / (limits[1] - limits[0]), 0.0, 1.0)
    return np.asarray(part * part * (3 - 2 * part))


def _turned(vectors: Array, angle: Array) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
