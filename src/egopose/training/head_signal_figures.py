"""How well a regressor of head signals does on people it has not seen, from the exact signals of their motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from egopose.humanoid.model import HumanoidModel
from egopose.models.pose_regression import split_state
from egopose.models.regressor import StateRegressor
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.training.head_signal_regressor import exact_example
from egopose.vision.mounts import mount_of


@torch.no_grad()
def held_out_figures(
    model: StateRegressor, humanoid: HumanoidModel, clips: Sequence[Array], mounts: Sequence[str], pitch_down: float
) -> dict[str, dict[str, float]]:
    """Figures by mount, of clips as they were recorded.

    Args:
        model: in evaluation mode.
        humanoid: whose motions they are.
        clips: ``qpos [T, nq]`` at the control rate, at least one.
        mounts: their names.
        pitch_down: degrees that the camera looks below the horizon.

    Returns:
        For each mount ``E_pose`` (rad: Yuan & Kitani 2019, section 4.3, hands left out; mean over the clips' means),
        ``E_pose of the mean`` (likewise, of the training frames' mean state), ``error`` (the mean squared error over
        that of the mean state, in the regressor's units; 0: none, 1: no better than the mean).
    """
    fps, out = 1.0 / humanoid.control_dt, {}
    for kind in mounts:
        mount = mount_of(kind, 0.0, float(np.deg2rad(pitch_down)), 0.0)
        poses, still, wrong, spread = [], [], 0.0, 0.0
        for clip in clips:
            example = exact_example(humanoid, clip, fps, mount)
            seen = model.from_features(example.features[None])
            wanted = _pose(example.states.numpy(), humanoid)
            usual = _pose(model.state_mean[None].numpy(), humanoid)
            poses.append(_distance(_pose(seen["humanoid_state"][0].numpy(), humanoid), wanted))
            still.append(_distance(usual, wanted))
            target = model.normalise(example.states)
            wrong += float((seen["normalised_state"][0] - target).square().mean(1).sum())
            spread += float(target.square().mean(1).sum())
        out[kind] = {
            "E_pose": float(np.mean(poses)),
            "E_pose of the mean": float(np.mean(still)),
            "error": wrong / spread,
        }
    return out


def _pose(states: Array, humanoid: HumanoidModel) -> Array:
    """``[T, 2 + D]`` rad: the root's roll and pitch, and joint angles with the hands' set to 0, of z ``[T, S]``."""
    parts = split_state(states, humanoid.joint_range)
    # Static xyz, as E_pose has it: neither roll nor pitch depends on the heading that z leaves out.
    lean = rot.to_scipy(parts.deheaded).as_euler("xyz")[:, :2]
    joints = parts.joint_angles.copy()
    joints[:, humanoid.hand_dofs] = 0.0
    return np.concatenate([lean, joints], axis=1)


def _distance(one: Array, other: Array) -> float:
    apart = one - other
    apart[:, 0] = rot.wrapped(apart[:, 0])
    return float(np.linalg.norm(apart, axis=1).mean())
