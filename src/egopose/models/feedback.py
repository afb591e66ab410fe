"""Balance feedback: a few gains from the root's tracking error to whole groups of joints.

A fall begins as a lean. What answers it needs few numbers (ankle, hip and trunk against lean, its rate and the
speed of the fall, in the sagittal and the frontal plane: Raibert 1986; Yin, Loken & van de Panne 2007). As 21 weights
among a network's hundred thousand they drown in the gradient's noise; as weights of their own, shared over joints, PPO
finds them in the first minutes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.humanoid.state_layout import StateLayout

#: In either plane, components of the root's rotation (the lean), angular velocity (its rate), linear velocity (speed).
_PLANES = {"pitch": (2, 1, 0), "roll": (1, 0, 1)}


@dataclass(frozen=True)
class FeedbackSettings:
    """``conf/model``'s ``feedback``.

    Args:
        pitch, roll: groups of hinges that move together against a lean forward or sideways, by name.
        speed: how many times quicker than the network's other weights the gains learn.
    """

    pitch: tuple[tuple[str, ...], ...]
    roll: tuple[tuple[str, ...], ...]
    speed: float


class BalanceFeedback(nn.Module):
    """``tracking_error [..., >= S]`` -> addition to the action's mean ``[..., A]`` (rad).

    Args:
        settings: see :class:`FeedbackSettings`.
        dof_names: the ``A`` hinges, in the action's order.

    Raises:
        InputError: a hinge is not there; names it.
    """

    columns: Tensor
    basis: Tensor
    spread: Tensor  # the basis, a row for each of a group's gains

    def __init__(self, settings: FeedbackSettings, dof_names: Sequence[str]) -> None:
        super().__init__()
        size = len(dof_names)
        groups: Mapping[str, tuple[tuple[str, ...], ...]] = {"pitch": settings.pitch, "roll": settings.roll}
        basis, owners = [], []
        for plane, joints in groups.items():
            for group in joints:
                row = torch.zeros(size)
                for name in group:
                    if name not in dof_names:
                        raise InputError("model", f"feedback.{plane}", f"the humanoid has no hinge {name!r}")
                    row[list(dof_names).index(name)] = 1.0
                basis.append(row)
                owners.append(plane)
        if not basis:
            raise InputError("model", "feedback", "names no hinges; null is for none")
        layout = StateLayout(size)
        parts = (layout.root_rotation, layout.root_angular_velocity, layout.root_linear_velocity)
        columns = [[part.start + at for part, at in zip(parts, _PLANES[plane], strict=True)] for plane in owners]
        self.register_buffer("basis", torch.stack(basis))
        self.register_buffer("columns", torch.tensor(columns))
        self.register_buffer("spread", torch.stack(basis).repeat_interleave(3, 0), persistent=False)
        self.speed = settings.speed
        #: ``[groups, 3]``: gains on lean, rate and speed, in units of ``speed``; zero at the start.
        self.gains = nn.Parameter(torch.zeros(len(basis), 3))

    def forward(self, tracking_error: Tensor) -> Tensor:
        """See the class."""
        seen = tracking_error.index_select(-1, self.columns.flatten())
        return (seen * (self.speed * self.gains).flatten()) @ self.spread
