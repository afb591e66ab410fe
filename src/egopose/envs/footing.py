"""Where the feet stand and how they move, as an observation.

Balance is about this, and joint angles tell it only through the kinematics of the legs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from egopose.envs.mdp import rotations as rot

if TYPE_CHECKING:
    from egopose.humanoid.model import HumanoidModel

_PROBE = 0.01  # s that the joints move on to tell their points' velocity


@dataclass(frozen=True)
class LegChain:
    """The way from each foot up to the root; ``L`` legs of alike build, ``P`` points under each foot.

    Args:
        points: ``[L, P, 3]`` m, in the foot's frame.
        offsets: of each body from the foot up, ``[L, 3]`` m in its parent's frame.
        axes: of each body's hinges from the last to the first, ``[L, 3]`` in the body's frame.
        columns: of these hinges among the joint angles, ``[L]`` each.
        size: joint angles there are.
    """

    points: Tensor
    offsets: tuple[Tensor, ...]
    axes: tuple[tuple[Tensor, ...], ...]
    columns: tuple[tuple[Tensor, ...], ...]
    size: int

    @classmethod
    def of(cls, humanoid: HumanoidModel) -> LegChain:
        """The legs of a humanoid.

        Raises:
            ValueError: they are not of alike build, or a body is turned or its hinge moved in its parent's frame.
        """
        model = humanoid.mj_model
        offsets, axes, columns = [], [], []
        bodies = [int(humanoid.body_ids[foot]) for foot in humanoid.feet]
        root = int(humanoid.body_ids[0])
        while bodies[0] != root:
            hinges = [list(range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])) for b in bodies]
            plain = all(abs(model.body_quat[b] - (1, 0, 0, 0)).max() < 1e-9 for b in bodies)
            centred = all(abs(model.jnt_pos[j]).max() < 1e-9 for joints in hinges for j in joints)
            if len({len(joints) for joints in hinges}) != 1 or not (plain and centred):
                raise ValueError("the legs' bodies must be alike, and their hinges at their origins")
            offsets.append(_floats([model.body_pos[b] for b in bodies]))
            pairs = [list(reversed(joints)) for joints in hinges]
            axes.append(tuple(_floats([model.jnt_axis[j] for j in level]) for level in zip(*pairs, strict=True)))
            columns.append(
                tuple(
                    torch.tensor([int(model.jnt_qposadr[j]) - 7 for j in level]) for level in zip(*pairs, strict=True)
                )
            )
            bodies = [int(model.body_parentid[b]) for b in bodies]
        return cls(_floats(humanoid.sole_points), tuple(offsets), tuple(axes), tuple(columns), model.nu)

    def positions(self, angles: Tensor) -> Tensor:
        """``[..., L, P, 3]`` m: the points in the root's frame at joint angles ``[..., size]`` rad."""
        points = self.points
        for offset, axes, columns in zip(self.offsets, self.axes, self.columns, strict=True):
            for axis, column in zip(axes, columns, strict=True):
                points = _turned(points, axis, angles[..., column])
            points = points + offset.unsqueeze(-2)
        return points


def _floats(values: object) -> Tensor:
    return torch.stack([torch.as_tensor(row, dtype=torch.float32) for row in values])  # type: ignore[attr-defined]


def _turned(points: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Points ``[..., L, P, 3]`` turned by ``angle [..., L]`` rad about ``axis [L, 3]`` (Rodrigues)."""
    angle, axis = angle[..., None, None], axis.unsqueeze(-2)
    along = (points * axis).sum(dim=-1, keepdim=True) * axis
    across = torch.linalg.cross(axis.expand_as(points), points)
    return along + (points - along) * angle.cos() + across * angle.sin()


class Footing(Transform):
    """Points under the feet: where they are from the root and how they move, in the heading frame; how high they are.

    Written as ``[..., 7 L P]``: positions / 0.3 m, velocities / 2 m/s, heights / 0.1 m, clipped to +-5. To stand before
    :class:`egopose.envs.transforms.StateNormalizer`, which changes the state it is worked out from.

    Args:
        legs: of the humanoid.
        key: of what it writes.
    """

    def __init__(self, legs: LegChain, key: str = "footing") -> None:
        super().__init__(in_keys=["humanoid_state"], out_keys=[key])
        self.legs = legs

    def _apply_transform(self, obs: Tensor) -> Tensor:
        size = self.legs.size
        turn, angles = obs[..., 1:5], obs[..., 5 : 5 + size]
        linear, angular, joints = obs[..., 5 + size : 8 + size], obs[..., 8 + size : 11 + size], obs[..., 11 + size :]
        points = self.legs.positions(torch.stack([angles, angles + _PROBE * joints], dim=-2)).flatten(-3, -2)
        here, there = points.unbind(-3)
        # Of the joints, of the root's turning (in its own frame), and of its way.
        moving = (there - here) / _PROBE + torch.linalg.cross(angular.unsqueeze(-2).expand_as(here), here)
        frame = rot.matrix(turn).transpose(-1, -2)
        here, moving = here @ frame, moving @ frame + linear.unsqueeze(-2)
        height = here[..., 2] + obs[..., :1]
        seen = torch.cat([(here / 0.3).flatten(-2), (moving / 2.0).flatten(-2), height / 0.1], dim=-1)
        return seen.clamp_(-5.0, 5.0)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes :attr:`out_keys` from the raw ``humanoid_state``."""
        return tensordict.set(self.out_keys[0], self._apply_transform(tensordict["humanoid_state"]))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        assert isinstance(observation_spec, Composite)
        legs, points, _ = self.legs.points.shape
        shape = (*observation_spec.shape, 7 * legs * points)
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=observation_spec.device)
        return observation_spec
