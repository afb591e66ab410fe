"""The rewards of a reconstruction among boxes: Yu, Park & Lee 2021, section 5.1, equations 6-12.

Each term reads the frame's :class:`~egopose.envs.mdp.clip_hints.ClipHints` under ``view.reference.hints``. Pose and
velocity are of the joints alone. The paper sums squares over all numbers; its authors' program takes their mean
(``norm: mean``), without which 52 joints that are each 0.1 rad off earn 0.2 % of the term.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.clip_hints import FEET, ClipHints
from egopose.envs.mdp.observations import BodyView
from egopose.envs.mdp.rewards import reward_term
from egopose.envs.mdp.step_view import StepView

GRAVITY = 9.81  # m/s^2


def _hints(view: StepView) -> ClipHints:
    hints: ClipHints = view.reference.hints  # type: ignore[union-attr]
    return hints


def _squared(values: Tensor, norm: str) -> Tensor:
    """``[N]`` mean or sum of the squares of ``values [N, D]``. Raises ValueError: another norm."""
    if norm not in ("mean", "sum"):
        raise ValueError(f"norm must be mean or sum, not {norm!r}")
    return values.square().mean(-1) if norm == "mean" else values.square().sum(-1)


@reward_term(reads=("joint_angles",))
def clip_pose(view: StepView, *, scale: float, norm: str) -> Tensor:
    """r_q = exp(-scale |q^ - q|^2) of the joints' angles ``[N]``, times the pose's trust (equation 6, scale 12)."""
    away = _squared(view.body.joint_angles - view.reference.joint_angles, norm)
    return _hints(view).trust * torch.exp(-scale * away)


@reward_term(reads=("joint_velocities",))
def clip_velocity(view: StepView, *, scale: float, norm: str) -> Tensor:
    """r_v = exp(-scale |v^ - v|^2) of the joints' velocities ``[N]`` (equation 6, scale 0.6)."""
    return torch.exp(-scale * _squared(view.body.joint_velocities - view.reference.joint_velocities, norm))


@reward_term()
def up_hint(view: StepView, *, scale: float) -> Tensor:
    """r_ori = exp(-scale |theta^ - theta|^2), angles of pelvis to head against up ``[N]`` (equation 7, scale 5)."""
    return torch.exp(-scale * (view.body.up_angle - _hints(view).up).square())


def touching_now(view: StepView) -> Tensor:
    """``[N, 4, 1 + K]`` bool: what of floor and boxes each end effector touches."""
    assert view.contacts is not None
    assert isinstance(view.body, BodyView)
    bodies = view.body.touching.bodies
    floor, boxes = view.contacts.floor.index_select(1, bodies), view.contacts.boxes.index_select(1, bodies)
    return torch.cat([floor[..., None], boxes], dim=-1)


def contact_mismatch(view: StepView) -> Tensor:
    """``[N, 4]`` bool: the end effector touches something and should not, or the other way round."""
    return touching_now(view).any(-1) ^ _hints(view).touches.any(-1)


@reward_term(needs=("contacts",))
def contact_match(view: StepView, *, scale: float) -> Tensor:
    """r_contact = exp(-scale sum_l xor(c^_l, c_l)) of both feet and both hands ``[N]`` (equation 8, scale 2)."""
    return torch.exp(-scale * contact_mismatch(view).double().sum(-1))


@reward_term(needs=("torques",))
def torque_use(view: StepView, *, scale: float, norm: str) -> Tensor:
    """r_reg = exp(-scale |tau|^2) ``[N]``, each torque over its joint's limit (equation 9, scale 1).

    In N m, as in the authors' program, it would always be zero.
    """
    assert view.torques is not None
    limits = view.reference.torque_limit  # type: ignore[union-attr]
    return torch.exp(-scale * _squared(view.torques / limits, norm))


def distance_to_zone(points: Tensor, scene: Tensor, half: Tensor, edge: Tensor) -> Tensor:
    """``[N, E, K]`` m from points to a rectangle about the middle of each box's upper face.

    Args:
        points: ``[N, E, 3]`` m in the world.
        scene: ``[N, K, 7]`` of the boxes.
        half: ``[E, K, 2]`` m, half of the rectangle's length and width.
        edge: ``[E]`` bool, whose zone is the rectangle's border instead of its area.
    """
    own = rot.rotate_back(scene[:, None, :, 3:], points[:, :, None] - scene[:, None, :, :3])
    outside = own[..., :2].abs() - half
    level = outside.clamp_min(0.0).norm(dim=-1)
    inside = -outside.amax(-1).clamp_max(0.0)
    return torch.hypot(torch.where(edge[:, None], level + inside, level), own[..., 2])


@reward_term(needs=("scene",))
def target_zone(view: StepView, *, scale: float, hands: str) -> Tensor:
    """r_dist = c exp(-scale sum_l mindist(Z_l, p_l)^2) ``[N]`` (equation 10, scale 15).

    The sum is over the contacts with boxes that are on. The zone is the centre quarter of the upper face. With
    ``hands: edge`` the hands' zone is the face's border: the paper's way out where a body should hold on to a box.
    """
    if hands not in ("centre", "edge"):
        raise ValueError(f"hands must be centre or edge, not {hands!r}")
    assert view.scene is not None
    hints = _hints(view)
    wanted = hints.touches[..., 1:]
    edge = torch.tensor([False] * FEET + [hands == "edge"] * FEET)
    half = torch.where(edge[:, None, None], 0.5, 0.25) * hints.box_sizes
    away = distance_to_zone(view.body.touching_points, view.scene, half, edge)
    total = (away.square() * wanted).flatten(1).sum(-1)
    return wanted.flatten(1).any(-1) * torch.exp(-scale * total)


@reward_term(needs=("scene",))
def alignment(view: StepView, *, scale: float) -> Tensor:
    """r_align = c exp(-scale |1 - u_pelvis . u_obj|^2) ``[N]`` (equation 11, scale 1).

    The pelvis's frontal axis against the box's own x, of the first box that should be touched.
    """
    assert view.scene is not None
    wanted = _hints(view).touches[..., 1:].any(1)
    if not wanted.shape[-1]:
        return torch.zeros(len(wanted), dtype=torch.float64)
    forward = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    first = wanted.int().argmax(-1)
    box = view.scene[torch.arange(len(wanted)), first, 3:]
    ways = [rot.rotate(q, forward.expand(len(q), 3)) for q in (view.body.root_quaternion, box)]
    return wanted.any(-1) * torch.exp(-scale * (1.0 - (ways[0] * ways[1]).sum(-1)).square())


@reward_term(needs=("contacts", "scene"))
def landing(view: StepView, *, scale: float) -> Tensor:
    """r_com = exp(-scale |d_ee - d_obj|^2) while the body flies and should ``[N]`` (equation 12, scale 5).

    d_ee is from the centre of mass to the landing end effector in the clip's pose of the landing, d_obj from where the
    mass will then be to the middle of the box. Nothing tells where on the floor a body lands: there d_obj is a height.
    """
    assert view.contacts is not None
    assert view.scene is not None
    hints, body = _hints(view), view.body
    touched = view.contacts.floor.any(-1) | view.contacts.boxes.flatten(1).any(-1)
    flies = (hints.landing_after > 0) & ~touched
    reward = torch.zeros(len(flies), dtype=torch.float64)
    rows = flies.nonzero().squeeze(-1)
    if not len(rows):
        return reward
    seconds = hints.landing_after[rows, None] * view.reference.control_dt  # type: ignore[union-attr]
    fall = torch.tensor([0.0, 0.0, -0.5 * GRAVITY], dtype=torch.float64)
    arrives = body.centre_of_mass[rows] + body.centre_of_mass_velocity(rows) * seconds + fall * seconds.square()
    floor = arrives * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    places = torch.cat([floor[:, None], view.scene[rows, :, :3]], dim=1)
    place = places[torch.arange(len(rows)), hints.landing_on[rows]]
    away = (arrives - place).norm(dim=-1) - hints.landing_reach[rows]
    return reward.index_copy(0, rows, torch.exp(-scale * away.square()))
