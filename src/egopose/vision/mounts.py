"""Where a wearer carries a camera: on the head, on the chest or in a hand, and how it moves with the body.

A mount is a body of the humanoid, a place on it and a direction. Place and direction are meant as they would be
measured on a person standing straight, in the model's rest pose: metres ahead, left and up; yaw left, pitch down, roll.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, from_axis_angle, from_scipy, multiply, rotate, to_matrix, to_scipy

# The camera on the humanoid's head: it tells which body the head is, where its eyes are and where it looks.
WEARER_CAMERA = "head"

MOUNTS = ("head", "chest", "held")
# Metres ahead, left and up. A head's is from the eyes; others' are from the head's joint, the body standing straight.
# Chest harnesses sit on the breastbone; a camera in the hand is held at a bent arm's length, under the chin.
_OFFSETS = {"head": (0.0, 0.0, 0.0), "chest": (0.16, 0.0, -0.25), "held": (0.38, 0.0, -0.12)}
# Standard deviations of a hand's sway against the trunk, m and degrees, and the seconds over which it is correlated:
# a few centimetres and degrees, slower than the 2 Hz of steps (this project's choice).
_SWAY, _SWAY_ANGLE, _SWAY_TIME = 0.02, 3.0, 0.5

_UP = np.array([0.0, 0.0, 1.0])
# MuJoCo's camera looks along -z with y up; a camera of vision looks along z with y down.
_FROM_MUJOCO = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Mount:
    """How a camera is worn.

    Args:
        kind: ``head``, ``chest`` or ``held``. The last two move with the trunk that bears the arms.
        yaw, pitch_down, roll: rad, of the camera on a person standing straight; a positive yaw looks left.
        offset: ``(ahead, left, up)`` m: from the eyes of a ``head``, else from the joint of the head.

    Raises:
        InputError: an unknown kind.
    """

    kind: str
    yaw: float = 0.0
    pitch_down: float = 0.0
    roll: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.kind not in MOUNTS:
            raise InputError("camera", "mount", f"{self.kind!r}; there are {', '.join(MOUNTS)}")


def mount_of(kind: str, yaw: float = 0.0, pitch_down: float = 0.0, roll: float = 0.0) -> Mount:
    """A mount of that kind at its usual place. Angles in rad. Raises InputError for an unknown kind."""
    return Mount(kind, yaw, pitch_down, roll, _OFFSETS.get(kind, (0.0, 0.0, 0.0)))


def mount_body(model: mujoco.MjModel, kind: str) -> int:
    """The body that bears the camera: the head, or its nearest ancestor from which limbs branch off.

    Raises:
        InputError: an unknown kind; the model has no camera ``head``, or nothing bears the head.
    """
    if kind not in MOUNTS:
        raise InputError("camera", "mount", f"{kind!r}; there are {', '.join(MOUNTS)}")
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, WEARER_CAMERA)
    if camera < 0:
        raise InputError("humanoid", "camera", f"the model has no camera {WEARER_CAMERA!r}")
    head = int(model.cam_bodyid[camera])
    if kind == "head":
        return head
    body = int(model.body_parentid[head])
    while body > 0 and int((model.body_parentid == body).sum()) < 2:
        body = int(model.body_parentid[body])
    if body == 0:
        raise InputError("humanoid", "bodies", f"none bears the head: a {kind} camera has no place")
    return body


def _at_rest(model: mujoco.MjModel) -> tuple[mujoco.MjData, Array]:
    """The model's rest pose, and the quaternion of the direction that its head looks to, about the vertical."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    ahead = -data.cam_xmat[model.camera(WEARER_CAMERA).id].reshape(3, 3)[:, 2]
    return data, from_axis_angle(_UP, np.arctan2(ahead[1], ahead[0]))


def camera_orientations(model: mujoco.MjModel, angles: Array, kind: str = "head") -> NDArray[np.float64]:
    """Quaternions ``[T, 4]`` of MuJoCo's camera in its body's frame, from yaw, pitch down, roll ``[T, 3]`` (rad).

    The angles are meant as they would be measured on a person standing straight: the model's rest pose says where
    the head looks then, and its camera ``head`` only in which direction.

    Raises:
        InputError: as :func:`mount_body`.
    """
    body = mount_body(model, kind)
    data, heading = _at_rest(model)
    # MuJoCo's camera looks along -z with x to its right: level and along the world's x, in columns.
    level = from_scipy(to_scipy(np.array([[0.5, 0.5, -0.5, -0.5]])), (1,))[0]
    turns = [
        from_axis_angle(np.array(axis), sign * angles[:, column])
        for axis, sign, column in (((0.0, 1.0, 0.0), 1.0, 0), ((1.0, 0.0, 0.0), -1.0, 1), ((0.0, 0.0, 1.0), 1.0, 2))
    ]
    bearer = data.xquat[body] * np.array([1.0, -1.0, -1.0, -1.0])
    fixed = multiply(multiply(bearer, heading), level)
    return multiply(multiply(multiply(np.broadcast_to(fixed, (len(angles), 4)), turns[0]), turns[1]), turns[2])


def camera_places(model: mujoco.MjModel, mount: Mount, shifts: Array) -> NDArray[np.float64]:
    """Positions ``[T, 3]`` (m) of the camera in its body's frame, shifted ``[T, 3]`` m ahead, left and up.

    Raises:
        InputError: as :func:`mount_body`.
    """
    body = mount_body(model, mount.kind)
    data, heading = _at_rest(model)
    camera = model.camera(WEARER_CAMERA).id
    anchor = data.cam_xpos[camera] if mount.kind == "head" else data.xpos[model.cam_bodyid[camera]]
    moved = anchor + rotate(heading, np.array(mount.offset) + shifts) - data.xpos[body]
    return rotate(data.xquat[body] * np.array([1.0, -1.0, -1.0, -1.0]), moved)


def camera_poses(
    model: mujoco.MjModel, qpos: Array, mount: Mount, angles: Array | None = None, shifts: Array | None = None
) -> tuple[Array, Array]:
    """Where the camera is and how it is turned in every pose, by MuJoCo's kinematics.

    Args:
        model: the humanoid with its camera ``head``.
        qpos: ``[T, nq]``, any rate.
        mount: how the camera is worn.
        angles: ``[T, 3]`` rad, yaw, pitch down and roll added to the mount's: play and sway. None adds nothing.
        shifts: ``[T, 3]`` m, ahead, left and up, added to the mount's offset. None adds nothing.

    Returns:
        ``[T, 3]`` m in the world; ``[T, 3, 3]`` from the camera's axes (x right, y down, z ahead) to the world's.

    Raises:
        InputError: as :func:`mount_body`; ``qpos``, ``angles`` or ``shifts`` of another shape.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq:
        raise InputError("camera", "qpos", f"has shape {list(qpos.shape)}; the model needs [T, {model.nq}]")
    own = np.array([mount.yaw, mount.pitch_down, mount.roll])
    turned = own + _of_frames("angles", angles, len(qpos))
    local = camera_orientations(model, turned, mount.kind)
    place = camera_places(model, mount, _of_frames("shifts", shifts, len(qpos)))
    body, data = mount_body(model, mount.kind), mujoco.MjData(model)
    at, bearer = np.empty((len(qpos), 3)), np.empty((len(qpos), 4))
    for t, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        at[t], bearer[t] = data.xpos[body], data.xquat[body]
    return at + rotate(bearer, place), to_matrix(multiply(bearer, local)) * _FROM_MUJOCO


def _of_frames(name: str, values: Array | None, count: int) -> Array:
    if values is None:
        return np.zeros((count, 3))
    values = np.asarray(values, dtype=np.float64)
    if values.shape != (count, 3):
        raise InputError("camera", name, f"has shape {list(values.shape)}; {count} poses need [{count}, 3]")
    return values


def held_sway(rng: np.random.Generator, count: int, fps: float) -> tuple[Array, Array]:
    """How a hand that holds a camera sways against the trunk: angles ``[count, 3]`` rad and shifts ``[count, 3]`` m.

    Args:
        rng: what it is drawn with.
        count: frames.
        fps: frames/s.
    """
    unit = slow_noise(rng, count, 6, _SWAY_TIME, fps)
    return np.deg2rad(_SWAY_ANGLE) * unit[:, :3], _SWAY * unit[:, 3:]


def slow_noise(rng: np.random.Generator, count: int, columns: int, time: float, fps: float) -> Array:
    """Noise ``[count, columns]`` of deviation 1, correlated over ``time`` s: two low passes, so that it never jumps."""
    keep = float(np.exp(-2.0 / (time * fps)))
    # Run in over several times the correlation: the first frame sways as much as the last.
    lead = int(np.ceil(5 * time * fps))
    state, sway = np.zeros((2, columns)), np.empty((lead + count, columns))
    for t, noise in enumerate(rng.normal(size=(lead + count, columns))):
        state[0] = keep * state[0] + (1 - keep) * noise
        state[1] = keep * state[1] + (1 - keep) * state[0]
        sway[t] = state[1]
    # Variance of unit white noise after two equal low passes.
    deviation = np.sqrt((1 - keep) ** 4 * (1 + keep**2) / (1 - keep**2) ** 3)
    return np.asarray(sway[lead:] / deviation)
