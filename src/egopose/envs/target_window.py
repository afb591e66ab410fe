"""Where the target motion goes next, seen from the body: what a policy that follows any kinematic motion reads.

A window holds the target of some frames ahead, each as its difference from the present body, in the body's heading
frame. So a policy that reads it needs no table of the motion, and follows what comes from a video, a forecast or mocap
alike (the reference observations of Hasenclever et al. 2020, "CoMic", and Wagener et al. 2022, "MoCapAct").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from egopose.envs.problem import TargetMotion
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


def target_window(state: Any, root: Any, targets: Any, path: Any, xp: Any = np) -> Any:
    """The window ``[N, W]``, scaled and clipped, float32.

    For each frame ahead: height, place ahead and to the left, heading, tilt (x and y of the de-headed quaternion) and
    joint angles of the target less the body's. Of the first also the root's and the joints' velocities.

    Args:
        state: ``[N, S]`` humanoid states z of the bodies, in their own units.
        root: ``[N, 3]`` x, y (m) and heading (rad) of the bodies in the path's axes.
        targets: ``[N, K, S]`` target states of the frames ahead.
        path: ``[N, K, 3]`` x, y and heading of the target's root in these frames.
        xp: ``numpy``, or ``torch`` for tensors: arrays cost a step less, and a trace needs tensors.
    """
    layout = StateLayout.of_size(int(state.shape[-1]))
    rotation = layout.root_rotation.start
    tilt = slice(rotation + 1, rotation + 3)
    away, turn = path[..., :2] - root[:, None, :2], path[..., 2] - root[:, None, 2]
    cos, sin = xp.cos(root[:, None, 2]), xp.sin(root[:, None, 2])
    pose = (
        (targets[..., :1] - state[:, None, :1]) / HEIGHT,
        ((cos * away[..., 0] + sin * away[..., 1]) / PLACE)[..., None],
        ((cos * away[..., 1] - sin * away[..., 0]) / PLACE)[..., None],
        ((xp.remainder(turn + np.pi, 2 * np.pi) - np.pi) / HEADING)[..., None],
        (targets[..., tilt] - state[:, None, tilt]) / TILT,
        (targets[..., layout.joint_angles] - state[:, None, layout.joint_angles]) / JOINTS,
    )
    rates = targets[:, 0, layout.velocities] - state[:, layout.velocities]
    scaled = (rates[:, :3] / LINEAR, rates[:, 3:6] / ANGULAR, rates[:, 6:] / JOINT_RATES)
    poses = xp.concatenate(pose, axis=-1).reshape(state.shape[0], -1)
    return xp.asarray(xp.clip(xp.concatenate((poses, *scaled), axis=-1), -CLIP, CLIP), dtype=xp.float32)


class TargetWindow(Transform):
    """Writes the window of each world's target motion. To stand before the normaliser, which changes the state.

    Args:
        motion: that is followed.
        ahead: frames ahead, in order; behind the motion's end its last frame stands still.
        key: of what it writes, ``[..., W]``.
    """

    def __init__(self, motion: TargetMotion, ahead: tuple[int, ...], key: str = "target_window") -> None:
        clock = ["frame", "episode_start", "episode_step"]
        super().__init__(in_keys=["humanoid_state", "root_on_path", *clock], out_keys=[key])
        self._motion, self._ahead = motion, np.array(ahead)
        self.size = window_size(StateLayout.of_size(motion.size).dofs, len(ahead))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state``, ``root_on_path`` and the episode's clock."""
        state, root = tensordict["humanoid_state"], tensordict["root_on_path"]
        seen = target_window(
            state.numpy().reshape(-1, state.shape[-1]),
            root.numpy().reshape(-1, 3),
            self._motion.states(tensordict, self._ahead),
            self._motion.path(tensordict, self._ahead),
        )
        return tensordict.set(self.out_keys[0], torch.from_numpy(seen).reshape(*state.shape[:-1], self.size))

    def known(self, entries: Mapping[str, Tensor]) -> Tensor:
        """See :class:`~egopose.envs.reference_forecasts.ForecastReader`."""
        targets = torch.from_numpy(self._motion.states(entries, self._ahead))
        path = torch.from_numpy(self._motion.path(entries, self._ahead)).float()
        return torch.cat([targets, path], dim=-1).flatten(1)

    def seen(self, known: Tensor, state: Tensor, root: Tensor) -> dict[str, Tensor]:
        """See :class:`~egopose.envs.reference_forecasts.ForecastReader`."""
        targets, path = known.unflatten(1, (len(self._ahead), -1)).split([self._motion.size, 3], dim=-1)
        return {self.out_keys[0]: target_window(state, root, targets, path, torch)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        shape = (*observation_spec.shape, self.size)
        observation_spec[self.out_keys[0]] = Unbounded(shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec
