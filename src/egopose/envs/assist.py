"""A helping hand at the root while a policy learns to balance: a wrench holds height and lean, and goes to zero."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.aids import AssistSettings, ramp
from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.observations import BodyState, BodyView


class RootAssistance:
    """PD from the root's height and lean to a force and a torque on it, limited, times a share that goes to zero.

    Towards the reference's root at the frame to be reached; its heading and place on the floor are left free, as
    nothing in the observation tells them. The reference is known in training only: so is the wrench. (An external
    force that is taken away as a character learns: Yu, Turk & Liu 2018, "Learning symmetric and low-energy
    locomotion", section 4.)

    Args:
        settings: see :class:`AssistSettings`.
        reference: ``qpos``, ``qvel`` of all frames ``[F]``.
    """

    def __init__(self, settings: AssistSettings, reference: TensorDictBase) -> None:
        self.settings = settings
        whole = BodyView({key: torch.as_tensor(reference[key]).double() for key in ("qpos", "qvel")})
        self._height, self._climb = whole.root_height, whole.qvel[:, 2].contiguous()
        self._lean, self._turning = whole.root_rotation, whole.root_angular_velocity

    def share(self, taken: Tensor) -> Tensor:
        """``[n]`` of the wrench that is left after ``taken [n]`` control steps; exactly zero from ``steps`` on."""
        return ramp(1.0, 0.0, self.settings.steps, taken)

    def wrench(self, state: BodyState, frame: Tensor, taken: Tensor) -> Tensor:
        """Force (N) and torque (N m) on the root in the world ``[n, 6]``, to be held over the next control step.

        Args:
            state: ``qpos [n, nq]`` and ``qvel [n, nv]`` of the bodies now.
            frame: ``[n]`` global frames to be reached.
            taken: ``[n]`` control steps the run has taken.
        """
        share, settings = self.share(taken), self.settings
        out = torch.zeros(len(frame), 6, dtype=torch.float64)
        if not bool(share.any()):
            return out
        now = BodyView(state)
        lift = settings.stiffness * (self._height[frame] - now.root_height)
        lift = lift + settings.damping * (self._climb[frame] - now.qvel[:, 2])
        out[:, 2] = lift.clamp(-settings.force_limit, settings.force_limit)
        off = _rotation_vector(rot.multiply(self._lean[frame], rot.conjugate(now.root_rotation)))
        turn = settings.turning_stiffness * off
        turn = turn + settings.turning_damping * (self._turning[frame] - now.root_angular_velocity)
        turn[:, 2] = 0.0
        size = turn.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        turn = turn * (settings.torque_limit / size).clamp_max(1.0)
        out[:, 3:] = rot.rotate(now.heading, turn)
        return out * share[:, None]


def _rotation_vector(q: Tensor) -> Tensor:
    """Axis times angle ``[n, 3]`` (rad), the short way round, of unit quaternions ``[n, 4]``."""
    q = torch.where(q[:, :1] < 0, -q, q)
    size = q[:, 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(size, q[:, :1])
    return q[:, 1:] * torch.where(size > 1e-9, angle / size.clamp_min(1e-9), 2.0)
