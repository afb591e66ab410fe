"""What the policy and the rewards see of the body: the humanoid state z of Yuan & Kitani 2019, section 3."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.humanoid.link_rates import LinkRates, Rates
from egopose.humanoid.state_layout import StateLayout

Array = NDArray[np.float64]
BodyState: TypeAlias = TensorDictBase | Mapping[str, Tensor]


@dataclass(frozen=True)
class BodyLayout:
    """Which bodies the rewards look at.

    Args:
        parents: ``[J]`` index of the parent of every body but the root.
        end_effectors: ``[E]`` indices of hands, feet and head.
        touching: what touches the scene, or None where nothing asks.
        rates: velocities of the links, or None where nothing asks.
    """

    parents: Tensor
    end_effectors: Tensor
    touching: TouchingPoints | None = None
    rates: LinkRates | None = None


@dataclass(frozen=True)
class TouchingPoints:
    """The end effectors that touch a scene: right foot, left foot, right hand, left hand.

    Args:
        bodies: ``[4]`` indices among the bodies.
        points: ``[4, 3]`` m, the middle of the sole or the hand in the body's own frame.
        head: index of the head.
    """

    bodies: Tensor
    points: Tensor
    head: int


class BodyView:
    """A body state and what follows from it, each worked out once, when first asked for.

    Args:
        state: body state, batch ``[N]``.
        layout: needed by :attr:`joint_rotations`, :attr:`end_effectors` and :attr:`end_effector_positions`.
    """

    def __init__(self, state: BodyState, layout: BodyLayout | None = None) -> None:
        self.qpos, self.qvel = state["qpos"], state["qvel"]
        self._state, self._layout = state, layout

    @property
    def layout(self) -> BodyLayout:
        """Raises ValueError: made without one."""
        if self._layout is None:
            raise ValueError("this view of the body was made without a layout")
        return self._layout

    @property
    def xpos(self) -> Tensor:
        """``[N, B, 3]`` m, of the bodies in the world."""
        return self._state["xpos"]

    @cached_property
    def root_height(self) -> Tensor:
        """``[N]`` m."""
        return self.qpos[:, 2]

    @cached_property
    def root_quaternion(self) -> Tensor:
        """``[N, 4]`` in the world."""
        return self.qpos[:, 3:7]

    @cached_property
    def heading(self) -> Tensor:
        """``[N, 4]``, see :func:`rotations.heading`."""
        return rot.heading(self.root_quaternion)

    @cached_property
    def yaw(self) -> Tensor:
        """``[N]`` rad, the angle of :attr:`heading`, within [-pi, pi]; zero faces along the world's x."""
        return rot.yaw(self.root_quaternion)

    @cached_property
    def place(self) -> Tensor:
        """``[N, 2]`` m, x and y of the root in the world."""
        return self.qpos[:, :2]

    @cached_property
    def heading_matrix(self) -> Tensor:
        """``[N, 3, 3]``: a row vector of the world times it is in the heading frame."""
        return rot.matrix(self.heading)

    @cached_property
    def root_rotation(self) -> Tensor:
        """``[N, 4]`` de-headed, ``conj(heading) * q``: w is never negative, z is zero, whichever sign q comes with."""
        return rot.turn_back(self.heading, self.root_quaternion)

    @cached_property
    def root_linear_velocity(self) -> Tensor:
        """``[N, 3]`` m/s in the heading frame."""
        return rot.rotate_back(self.heading, self.qvel[:, :3])

    @cached_property
    def root_angular_velocity(self) -> Tensor:
        """``[N, 3]`` rad/s in the heading frame. MuJoCo's ``qvel[3:6]`` is in the root frame."""
        return torch.matmul(rot.matrix(self.root_rotation), self.qvel[:, 3:6, None]).squeeze(-1)

    @cached_property
    def joint_velocities(self) -> Tensor:
        """``[N, nu]`` rad/s."""
        return self.qvel[:, 6:]

    @cached_property
    def joint_rotations(self) -> Tensor:
        """``[N, J, 4]``: each body but the root relative to its parent, ``conj(xquat[parent]) * xquat[child]``."""
        quats = self._state["xquat"]
        return rot.multiply(rot.conjugate(quats.index_select(1, self.layout.parents)), quats[:, 1:])

    @cached_property
    def end_effector_positions(self) -> Tensor:
        """``[N, E, 3]`` m in the world."""
        return self.xpos.index_select(1, self.layout.end_effectors)

    @cached_property
    def end_effectors(self) -> Tensor:
        """``[N, E, 3]`` m: vectors from the root to each end effector, in the heading frame."""
        return torch.matmul(self.end_effector_positions - self.qpos[:, None, :3], self.heading_matrix)

    @cached_property
    def centre_of_mass(self) -> Tensor:
        """``[N, 3]`` m in the world."""
        return self._state["com"]

    @cached_property
    def joint_angles(self) -> Tensor:
        """``[N, nu]`` rad."""
        return self.qpos[:, 7:]

    @property
    def boxes(self) -> Tensor:
        """``[N, K, 7]`` place (m, centre of the upper face) and quaternion of the world's boxes, where it has some."""
        return torch.cat([self._state["box_tops"], self._state["box_quaternions"]], dim=-1)

    @property
    def xquat(self) -> Tensor:
        """``[N, B, 4]`` of the bodies in the world."""
        return self._state["xquat"]

    @cached_property
    def link_velocities(self) -> tuple[Tensor, Tensor]:
        """Linear ``[N, B, 3]`` m/s and angular ``[N, B, 3]`` rad/s of the bodies, in the world.

        Raises ValueError: the layout tells no rates.
        """
        rates = self._rates(slice(None))
        return torch.from_numpy(rates.linear), torch.from_numpy(rates.angular)

    def centre_of_mass_velocity(self, rows: Tensor) -> Tensor:
        """``[n, 3]`` m/s in the world, of ``rows [n]``; raises ValueError as :attr:`link_velocities`."""
        return torch.from_numpy(self._rates(rows.numpy()).centre_of_mass)

    def _rates(self, rows: Any) -> Rates:
        if self.layout.rates is None:
            raise ValueError("this layout of the body tells no velocities of links")
        return self.layout.rates(self.qpos.numpy()[rows], self.qvel.numpy()[rows])

    @property
    def touching(self) -> TouchingPoints:
        """Raises ValueError: the layout names no end effectors that touch a scene."""
        if self.layout.touching is None:
            raise ValueError("this layout of the body names nothing that touches a scene")
        return self.layout.touching

    @cached_property
    def touching_points(self) -> Tensor:
        """``[N, 4, 3]`` m in the world, see :class:`TouchingPoints`."""
        part = self.touching
        turned = rot.rotate(self.xquat.index_select(1, part.bodies), part.points.expand(len(self.qpos), -1, -1))
        return self.xpos.index_select(1, part.bodies) + turned

    @cached_property
    def up_angle(self) -> Tensor:
        """``[N]`` rad between the way from the root to the head and the vertical."""
        way = self.xpos[:, self.touching.head] - self.xpos[:, 0]
        return torch.atan2(way[:, :2].norm(dim=-1), way[:, 2])

    @cached_property
    def humanoid_state(self) -> Tensor:
        """See :func:`humanoid_state`."""
        return torch.cat(
            [
                self.qpos[:, 2:3],
                self.root_rotation,
                self.qpos[:, 7:],
                self.root_linear_velocity,
                self.qvel[:, 3:],
            ],
            dim=-1,
        )


def humanoid_state_rows(qpos: Array, qvel: Array) -> Array:
    """:func:`humanoid_state` of ``qpos [N, nq]`` and ``qvel [N, nv]`` as arrays, at a fifth of the time for few rows.

    With the heading's cosine and sine (c, s) = (w, z) / |(w, z)| of half its angle, the de-headed root quaternion is
    (|(w, z)|, c x + s y, c y - s x, 0). Rows round alike however many there are.
    """
    layout = StateLayout(qpos.shape[1] - 7)
    w, x, y, z = qpos[:, 3:7].T
    w = w + 1e-16  # as in rotations.heading: below rounding, unless (w, z) vanishes
    size = np.sqrt(w * w + z * z)
    c, s = w / size, z / size
    cos, sin = c * c - s * s, 2.0 * c * s
    along, across = qvel[:, 0], qvel[:, 1]
    out = np.empty((len(qpos), layout.size))
    rotation, linear = out[:, layout.root_rotation], out[:, layout.root_linear_velocity]
    out[:, layout.root_height] = qpos[:, 2:3]
    rotation[:, 0], rotation[:, 1], rotation[:, 2], rotation[:, 3] = size, c * x + s * y, c * y - s * x, 0.0
    out[:, layout.joint_angles] = qpos[:, 7:]
    linear[:, 0], linear[:, 1], linear[:, 2] = cos * along + sin * across, cos * across - sin * along, qvel[:, 2]
    out[:, layout.root_angular_velocity] = qvel[:, 3:6]
    out[:, layout.joint_velocities] = qvel[:, 6:]
    return out


def humanoid_state(state: BodyState) -> Tensor:
    """z ``[N, 2 nq - 3]`` (115 numbers at 58 degrees of freedom), float64.

    Its parts are named by :class:`egopose.humanoid.state_layout.StateLayout`.
    """
    return BodyView(state).humanoid_state
