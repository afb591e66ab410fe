"""What a live stream knows of the target motion, written where an environment has its tables of whole takes.

Row 0 is the frame that the body is at, the rows after it are the look-ahead's. Behind the newest known row the last one
stands still. So a body that plans may follow its copies of the environment through the rows as through a take.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.envs.imitation import ImitationProblem
from egopose.envs.mdp.path import turned
from egopose.envs.target_motion import TableMotion
from egopose.envs.transforms import TrackingError, VisualContext
from egopose.inference.causal import Seen
from egopose.models.pose_regression import integrated_path


@dataclass(frozen=True)
class LiveRows:
    """R rows, of known frames from the present one on.

    Attributes:
        visual_context: ``[R, C]``, as in :class:`egopose.inference.causal.Seen`; so are the next two.
        humanoid_state: ``[R, S]``.
        joint_targets: ``[R, nu]`` rad.
        path: ``[R, 3]`` x, y (m) and heading (rad) of the root, by the states' own velocities; None if nobody asks.
    """

    visual_context: Tensor
    humanoid_state: Tensor
    joint_targets: Tensor
    path: Tensor | None

    @classmethod
    def of(cls, frames: Sequence[Seen], count: int, root: Tensor | None, control_dt: float) -> LiveRows:
        """Of ``frames`` and what the last of them tells of those after it.

        Args:
            frames: in a row, from the present one on; at least one.
            count: R. Where less is known the last row is repeated, where more is known the rest is left out.
            root: ``[3]`` x, y (m) and heading (rad) of the present frame; None for no path.
            control_dt: s between frames.
        """
        later = frames[-1].later
        parts = []
        for name in ("visual_context", "humanoid_state", "joint_targets"):
            known = torch.stack([getattr(frame, name) for frame in frames])
            parts.append(known if later is None else torch.cat([known, getattr(later, name)]))
        rows = torch.arange(count).clamp(max=len(parts[0]) - 1)
        path = None if root is None else _path(parts[1], root, control_dt)[rows]
        context, state, targets = (part[rows] for part in parts)
        return cls(context, state, targets, path)

    def write(self, env: TransformedEnv) -> None:
        """Put them into the tables of ``env``, whose take has R frames."""
        problem = env.base_env.problem
        assert isinstance(problem, ImitationProblem)
        for part in env.transform:
            if isinstance(part, TrackingError):
                part.table = self.humanoid_state
            elif isinstance(part, VisualContext):
                part.table = self.visual_context
        if problem.action.reference == "regressor":
            problem.read_actions_from(self.joint_targets)
        if self.path is not None:
            assert isinstance(problem.motion_seen, TableMotion)
            problem.motion_seen.put(self.humanoid_state, self.path)


def _path(states: Tensor, root: Tensor, control_dt: float) -> Tensor:
    """``[R, 3]`` the path of ``states [R, S]`` whose first row is at ``root [3]``, float64."""
    path = torch.from_numpy(integrated_path(states.double().numpy(), 1.0 / control_dt))
    places = root[:2] + turned(path[:, :2], root[2].expand(len(path)))
    return torch.cat([places, (path[:, 2] + root[2])[:, None]], dim=-1)
