"""The body-state keys of a reference clip, by the same MuJoCo kinematics the simulation uses."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from egopose.humanoid.model import HumanoidModel
from egopose.motion.motion import Motion, finite_difference


def reference_states(humanoid: HumanoidModel, motion: Motion) -> TensorDict:
    """Body states ``[T]`` of a clip on the humanoid's skeleton.

    Args:
        humanoid: the model.
        motion: at the control rate, on ``humanoid.skeleton``.

    Returns:
        float64 TensorDict ``[T]``: ``qpos [59]``, ``qvel [58]`` (forward differences), ``xpos [21, 3]``,
        ``xquat [21, 4]``, ``com [3]``, ``com_vel [3]`` (m/s, forward differences).

    Raises:
        ValueError: another frame rate or skeleton.
    """
    if abs(motion.fps * humanoid.control_dt - 1.0) > 1e-6:
        raise ValueError(f"the clip has {motion.fps} fps, the control rate is {1.0 / humanoid.control_dt}")
    if motion.skeleton.names != humanoid.skeleton.names:
        raise ValueError("the clip is not on the humanoid's skeleton; retarget it first")
    model = humanoid.mj_model
    data = mujoco.MjData(model)
    mass = model.body_mass / model.body_mass.sum()
    frames, bodies = len(motion), len(humanoid.body_ids)
    xpos, xquat, com = np.empty((frames, bodies, 3)), np.empty((frames, bodies, 4)), np.empty((frames, 3))
    for t, qpos in enumerate(motion.qpos):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        xpos[t], xquat[t] = data.xpos[humanoid.body_ids], data.xquat[humanoid.body_ids]
        com[t] = mass @ data.xipos
    com_vel = np.zeros_like(com)
    if frames > 1:
        com_vel[:-1] = np.diff(com, axis=0) * motion.fps
        com_vel[-1] = com_vel[-2]
    arrays = {
        "qpos": motion.qpos,
        "qvel": finite_difference(motion.qpos, motion.fps),
        "xpos": xpos,
        "xquat": xquat,
        "com": com,
        "com_vel": com_vel,
    }
    return TensorDict({k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}, batch_size=[frames])


def falls_freely(com: np.ndarray, fps: float, window: float = 0.1) -> np.ndarray:
    """Frames ``[T]`` in which the centre of mass ``[T, 3]`` (m) accelerates downwards by half of gravity or more.

    Args:
        com: of a clip.
        fps: frames per second.
        window: s either side over which the acceleration is averaged.
    """
    reach = max(1, round(window * fps))
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    height = com[:, 2]
    acceleration = np.gradient(np.gradient(height)) * fps**2 if len(height) > 1 else np.zeros(1)
    return np.convolve(np.pad(acceleration, reach, mode="edge"), kernel, mode="valid") < -0.5 * 9.81


def supported(
    humanoid: HumanoidModel,
    states: TensorDict,
    contacts: np.ndarray,
    fps: float,
    surface: np.ndarray | None = None,
) -> np.ndarray:
    """Frames ``[T]`` a body on a bare floor could be in: a sole touches it, or the body really falls freely.

    Where the mocap's actor hung from or stood on something the scene does not hold, the centre of mass neither falls
    nor is held up by a foot on the floor; no control can follow there, so neither training nor the physics gate starts
    there.

    Args:
        humanoid: for the floor contact of other bodies than feet.
        states: of :func:`reference_states`.
        contacts: ``[T, K]`` of the sole points.
        fps: frames per second.
        surface: ``[T]`` m, the lowest point of other bodies than feet, see
            :func:`egopose.humanoid.foot_geometry.lowest_points`.
    """
    falls = falls_freely(states["com"].numpy(), fps)
    lowest = states["xpos"][:, :, 2].numpy().min(axis=1)
    # Hands, knees or seat on the floor: some joint is as low as a sole's joint ever is, or the body's surface touches.
    near_floor = lowest < _LOW_JOINT
    if surface is not None:
        near_floor |= surface < _TOUCH
    return contacts.any(axis=1) | falls | near_floor


#: A joint this low (m) means that some part of the body lies or stands on the floor.
_LOW_JOINT = 0.13
#: Settled bodies rest within this of the floor, m.
_TOUCH = 0.02
