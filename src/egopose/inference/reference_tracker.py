"""The tracker as a controller of many bodies that follow one reference motion, and as a judge of their states.

The tracker knows no boxes: it was trained on a floor. So it is told heights over what the reference stands on.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase

from egopose.collection.stepping import Entries, parts_of, run_parts
from egopose.envs.mdp.observations import humanoid_state_rows
from egopose.envs.target_window import target_window
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Policy


class ReferenceTracker:
    """PD targets by the policy's mean action, and how well its critic thinks that bodies will do.

    Args:
        policy: a tracker, see :mod:`egopose.tasks.tracking`.
        humanoid: that it moves.
        qpos, qvel: ``[T, nq]``, ``[T, nv]`` of the reference.
        ground: ``[T]`` m: the height of what it stands on; None for the floor.
    """

    def __init__(
        self, policy: Policy, humanoid: HumanoidModel, qpos: Array, qvel: Array, ground: Array | None = None
    ) -> None:
        task: dict[str, Any] = policy.config["task"]
        self._ahead = np.array(task["ahead"])
        self._scale = float(task["action"]["scale"])
        lag = humanoid.kd / humanoid.kp * float(task["action"]["velocity_feedforward"])
        self._base = qpos[:, 7:] + lag * qvel[:, 6:]
        self._range = humanoid.joint_range.T
        self._states = humanoid_state_rows(qpos, qvel)
        self._ground = np.zeros(len(qpos)) if ground is None else ground
        self._path = np.column_stack([qpos[:, :2], rot.yaw(qpos[:, 3:7])])
        actor = policy.actor
        assert isinstance(actor, ProbabilisticTensorDictSequential)
        # Only the mean action is needed, so the distribution is left out.
        self._actor = [part for step in actor.module[:-1] for part in parts_of(step)]
        self._critic = parts_of(policy.critic)
        self._normalizer, self._discount = policy.normalizer, float(policy.config["algo"]["gamma"])

    def __len__(self) -> int:
        return len(self._states)

    def targets(self, frame: int, qpos: Array, qvel: Array) -> Array:
        """``[n, nu]`` rad: PD targets that lead bodies ``qpos [n, nq]``, ``qvel [n, nv]`` from ``frame`` on."""
        seen = self._run(self._actor, frame, qpos, qvel)
        base = self._base[min(frame + 1, len(self) - 1)]
        return np.clip(base + self._scale * seen["loc"].double().numpy(), self._range[0], self._range[1])

    def shortfall(self, frame: int, qpos: Array, qvel: Array) -> Array:
        """``[n]`` from 0: by how much the critic expects less than the best reward, a frame; see :meth:`targets`."""
        value = self._run(self._critic, frame, qpos, qvel)["state_value"]
        return np.asarray(1.0 - (1.0 - self._discount) * value.squeeze(-1).double().numpy())

    @torch.no_grad()
    def _run(self, parts: list[TensorDictModuleBase], frame: int, qpos: Array, qvel: Array) -> Entries:
        ground = self._ground[frame]
        state = humanoid_state_rows(qpos, qvel)
        state[:, 0] -= ground
        rows = np.minimum(frame + self._ahead, len(self) - 1)
        targets = np.broadcast_to(self._states[rows], (len(qpos), len(rows), state.shape[1])).copy()
        targets[..., 0] -= ground
        path = np.broadcast_to(self._path[rows], (len(qpos), len(rows), 3))
        root = np.column_stack([qpos[:, :2], rot.yaw(qpos[:, 3:7])])
        window = torch.from_numpy(target_window(state, root, targets, path))
        seen = self._normalizer.normalize(torch.from_numpy(state)).float()
        entries = Entries(humanoid_state=seen, target_window=window)
        run_parts(parts, entries)
        return entries
