"""Where the target motion goes next, seen from the body: what a policy that follows any kinematic motion reads.

A window holds the target of some frames ahead, each as its difference from the present body, in the body's heading
frame. So a policy that reads it needs no table of the motion, and follows what comes from a video, a forecast or mocap
alike (the reference observations of Hasenclever et al. 2020, "CoMic", and Wagener et al. 2022, "MoCapAct").
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from egopose.humanoid.state_layout import StateLayout

Rows = NDArray[np.floating]

#: What a unit of the window is: m, rad, m/s, rad/s. About a standard deviation of what a body that keeps up shows.
HEIGHT, PLACE, HEADING, TILT, JOINTS = 0.1, 0.3, 0.5, 0.1, 0.3
LINEAR, ANGULAR, JOINT_RATES = 0.5, 1.0, 2.0
#: Of the scaled numbers.
CLIP = 5.0


def window_size(dofs: int, ahead: int) -> int:
    """W, numbers of a window of ``ahead`` frames for a body of ``dofs`` joint degrees of freedom."""
    return ahead * (6 + dofs) + 6 + dofs


def target_window(state: Rows, root: Rows, targets: Rows, path: Rows) -> Rows:
    """The window ``[N, W]``, scaled and clipped, float32.

    For each frame ahead: height, place ahead and to the left, heading, tilt (x and y of the de-headed quaternion) and
    joint angles of the target less the body's. Of the first also the root's and the joints' velocities.

    Args:
        state: ``[N, S]`` humanoid states z of the bodies, in their own units.
        root: ``[N, 3]`` x, y (m) and heading (rad) of the bodies in the path's axes.
        targets: ``[N, K, S]`` target states of the frames ahead.
        path: ``[N, K, 3]`` x, y and heading of the target's root in these frames.
    """
    layout = StateLayout.of_size(state.shape[-1])
    count, frames = targets.shape[:2]
    pose = 6 + layout.dofs
    out = np.empty((count, window_size(layout.dofs, frames)), dtype=np.float32)
    first = out[:, : frames * pose].reshape(count, frames, pose)
    rotation = layout.root_rotation.start
    away = path[..., :2] - root[:, None, :2]
    cos, sin = np.cos(root[:, None, 2]), np.sin(root[:, None, 2])
    turn = path[..., 2] - root[:, None, 2]
    first[..., 0] = (targets[..., 0] - state[:, None, 0]) / HEIGHT
    first[..., 1] = (cos * away[..., 0] + sin * away[..., 1]) / PLACE
    first[..., 2] = (cos * away[..., 1] - sin * away[..., 0]) / PLACE
    first[..., 3] = (np.mod(turn + np.pi, 2 * np.pi) - np.pi) / HEADING
    tilt = slice(rotation + 1, rotation + 3)
    first[..., 4:6] = (targets[..., tilt] - state[:, None, tilt]) / TILT
    np.subtract(targets[..., layout.joint_angles], state[:, None, layout.joint_angles], out=first[..., 6:])
    first[..., 6:] /= JOINTS
    rates = targets[:, 0, layout.velocities] - state[:, layout.velocities]
    rates[:, 0:3] /= LINEAR
    rates[:, 3:6] /= ANGULAR
    rates[:, 6:] /= JOINT_RATES
    out[:, frames * pose :] = rates
    return np.clip(out, -CLIP, CLIP, out=out)


class TargetWindow(Transform):
    """Writes the window of each world's target motion. To stand before the normaliser, which changes the state.

    Args:
        states: ``[F, S]`` target states of every frame.
        path: ``[F, 3]`` x, y (m) and heading (rad) of their root.
        last: ``[F]`` int64, the last frame of each frame's take.
        ahead: frames ahead, in order; behind a take's end its last frame stands still.
        key: of what it writes, ``[..., W]``.
    """

    def __init__(
        self, states: Tensor, path: Tensor, last: Tensor, ahead: tuple[int, ...], key: str = "target_window"
    ) -> None:
        super().__init__(in_keys=["humanoid_state", "root_on_path", "frame"], out_keys=[key])
        self.states, self.path = states.float().numpy(), path.double().numpy()
        self._last, self._ahead = last.numpy(), np.array(ahead)
        self.size = window_size(StateLayout.of_size(states.shape[1]).dofs, len(ahead))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state``, ``root_on_path`` and ``frame``."""
        frame = tensordict["frame"].numpy().reshape(-1)
        state, root = tensordict["humanoid_state"], tensordict["root_on_path"]
        rows = np.minimum(frame[:, None] + self._ahead, self._last[frame][:, None])
        seen = target_window(
            state.numpy().reshape(len(frame), -1),
            root.numpy().reshape(len(frame), 3),
            self.states[rows],
            self.path[rows],
        )
        return tensordict.set(self.out_keys[0], torch.from_numpy(seen).reshape(*state.shape[:-1], self.size))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, self.size)
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
