"""The imitation rewards of Yuan & Kitani 2019 (equations 2-7) and of DeepMimic (Peng et al. 2018, equations 5-9)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.observations import BodyView

#: A view, or a reference's rows of a table of some of a view's attributes.
BodyLike: TypeAlias = BodyView | SimpleNamespace


def rotation_distance(p: Tensor, q: Tensor, metric: str) -> Tensor:
    """``[...]`` size of the rotation ``p * conj(q)`` between unit quaternions ``[..., 4]``, the short way round.

    ``half_angle`` is arccos(w), the authors' measure, with which their published numbers were made; ``angle`` is twice
    that, the true angle.

    Raises:
        ValueError: another metric.
    """
    if metric not in ("half_angle", "angle"):
        raise ValueError(f"rotation_metric must be half_angle or angle, not {metric!r}")
    half = rot.half_angle_between(p, q)
    return half if metric == "half_angle" else 2.0 * half


def _squares(a: Tensor, b: Tensor) -> Tensor:
    """``[N]``: the squared length of ``a - b`` over all axes but the first."""
    return (a - b).flatten(1).square().sum(-1)


def pose(body: BodyLike, reference: BodyLike, scale: float, metric: str) -> Tensor:
    """r_q = exp(-scale sum_j |q_j - q^_j|^2) over the joints' local rotations ``[N]`` (equation 3, scale 2)."""
    size = rotation_distance(body.joint_rotations, reference.joint_rotations, metric)
    return torch.exp(-scale * size.square().sum(-1))


def end_effector(body: BodyLike, reference: BodyLike, scale: float) -> Tensor:
    """r_e = exp(-scale sum_e |e - e^|^2), vectors from the root in the heading frame ``[N]`` (equation 4, scale 20)."""
    return torch.exp(-scale * _squares(body.end_effectors, reference.end_effectors))


def root_pose(body: BodyLike, reference: BodyLike, scale: float, metric: str) -> Tensor:
    """r_p = exp(-scale ((h - h^)^2 + |q_r - q^_r|^2)), root rotations de-headed ``[N]`` (equation 5, scale 300)."""
    height = body.root_height - reference.root_height
    size = rotation_distance(body.root_rotation, reference.root_rotation, metric)
    return torch.exp(-scale * (height.square() + size.square()))


def root_velocity(body: BodyLike, reference: BodyLike, linear: float, angular: float) -> Tensor:
    """r_v = exp(-linear |l - l^|^2 - angular |w - w^|^2), heading frame ``[N]`` (equation 6, scales 1 and 0.1)."""
    dl = _squares(body.root_linear_velocity, reference.root_linear_velocity)
    dw = _squares(body.root_angular_velocity, reference.root_angular_velocity)
    return torch.exp(-linear * dl - angular * dw)


def forecasting_decay(step: Tensor, horizon: int) -> Tensor:
    """beta = (T - t) / T at step t (equation 7), never below zero."""
    return ((horizon - step) / horizon).clamp_min(0.0)


def world_pose(body: BodyLike, reference: BodyLike, scale: float, metric: str) -> Tensor:
    """DeepMimic's r^p = exp(-2 sum_j |q_j - q^_j|^2), the root's world rotation among the joints ``[N]``."""
    joints = rotation_distance(body.joint_rotations, reference.joint_rotations, metric)
    root = rotation_distance(body.root_quaternion, reference.root_quaternion, metric)
    return torch.exp(-scale * (joints.square().sum(-1) + root.square()))


def joint_velocity(body: BodyLike, reference: BodyLike, scale: float) -> Tensor:
    """DeepMimic's r^v = exp(-0.1 sum_j |q'_j - q^'_j|^2) over the joints' velocities ``[N]``."""
    return torch.exp(-scale * _squares(body.joint_velocities, reference.joint_velocities))


def world_end_effector(body: BodyLike, reference: BodyLike, scale: float) -> Tensor:
    """DeepMimic's r^e = exp(-40 sum_e |p_e - p^_e|^2), world positions ``[N]``."""
    return torch.exp(-scale * _squares(body.end_effector_positions, reference.end_effector_positions))


def centre_of_mass(body: BodyLike, reference: BodyLike, scale: float) -> Tensor:
    """DeepMimic's r^c = exp(-10 |p_c - p^_c|^2), world positions ``[N]``."""
    return torch.exp(-scale * _squares(body.centre_of_mass, reference.centre_of_mass))


def weighted_mean(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """``[N]``: the weighted sum of the terms over the sum of the weights (equation 2, kept within [0, 1])."""
    total = sum(weights.values())
    mean = torch.zeros_like(next(iter(terms.values())))
    for name, weight in weights.items():
        mean = torch.add(mean, terms[name], alpha=weight / total)
    return mean


class Reward(Protocol):
    """What the environment asks of a reward."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        ...

    @property
    def reads(self) -> tuple[str, ...]:
        """Attributes of :class:`BodyView` it reads of body and reference."""
        ...

    def __call__(self, body: BodyLike, reference: BodyLike, step: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The reward ``[N]`` at ``step [N]`` of the episode, and its terms ``[N]`` by name."""
        ...


def _check_weights(weights: Mapping[str, float], names: tuple[str, ...]) -> None:
    if set(weights) != set(names) or min(weights.values()) < 0 or not sum(weights.values()) > 0:
        raise ValueError(
            f"weights must be non-negative for exactly {', '.join(names)}, not all zero; got {dict(weights)}"
        )


@dataclass(frozen=True)
class HeadingFrameReward:
    """Yuan & Kitani's reward. Ablations (b) and (c) of their Table 2 are weights of zero.

    Args:
        weights: of ``pose``, ``end_effector``, ``root_pose``, ``root_velocity``.
        scales: exponents of ``pose``, ``end_effector``, ``root_pose``, ``root_linear_velocity``,
            ``root_angular_velocity``.
        rotation_metric: see :func:`rotation_size`.
        decay_horizon: T of equation 7 in steps (forecasting), None for estimation.

    Raises:
        ValueError: weights that are negative, missing or all zero.
    """

    weights: Mapping[str, float]
    scales: Mapping[str, float]
    rotation_metric: str = "half_angle"
    decay_horizon: int | None = None
    names = ("pose", "end_effector", "root_pose", "root_velocity")
    reads = (
        "joint_rotations",
        "end_effectors",
        "root_height",
        "root_rotation",
        "root_linear_velocity",
        "root_angular_velocity",
    )

    def __post_init__(self) -> None:
        _check_weights(self.weights, self.names)

    def __call__(self, body: BodyLike, reference: BodyLike, step: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        s, metric = self.scales, self.rotation_metric
        terms = {
            "pose": pose(body, reference, s["pose"], metric),
            "end_effector": end_effector(body, reference, s["end_effector"]),
            "root_pose": root_pose(body, reference, s["root_pose"], metric),
            "root_velocity": root_velocity(body, reference, s["root_linear_velocity"], s["root_angular_velocity"]),
        }
        total = weighted_mean(terms, self.weights)
        if self.decay_horizon is not None:
            total = total * forecasting_decay(step, self.decay_horizon)
        return total, terms


@dataclass(frozen=True)
class WorldFrameReward:
    """DeepMimic's reward, ablation (d) of Yuan & Kitani's Table 2: everything in the world frame.

    Args:
        weights, scales: of ``pose``, ``velocity``, ``end_effector``, ``centre_of_mass``.
        rotation_metric: see :func:`rotation_size`.

    Raises:
        ValueError: weights that are negative, missing or all zero.
    """

    weights: Mapping[str, float]
    scales: Mapping[str, float]
    rotation_metric: str = "angle"
    names = ("pose", "velocity", "end_effector", "centre_of_mass")
    reads = ("joint_rotations", "root_quaternion", "joint_velocities", "end_effector_positions", "centre_of_mass")

    def __post_init__(self) -> None:
        _check_weights(self.weights, self.names)

    def __call__(self, body: BodyLike, reference: BodyLike, step: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        s = self.scales
        terms = {
            "pose": world_pose(body, reference, s["pose"], self.rotation_metric),
            "velocity": joint_velocity(body, reference, s["velocity"]),
            "end_effector": world_end_effector(body, reference, s["end_effector"]),
            "centre_of_mass": centre_of_mass(body, reference, s["centre_of_mass"]),
        }
        return weighted_mean(terms, self.weights), terms


def build_reward(cfg: Mapping[str, Any]) -> Reward:
    """The reward a ``conf/reward`` file describes.

    Raises:
        ValueError: an unknown ``kind``, weights that do not fit it.
    """
    weights, scales = dict(cfg["weights"]), dict(cfg["scales"])
    if cfg["kind"] == "heading_frame":
        return HeadingFrameReward(weights, scales, cfg["rotation_metric"], cfg.get("decay_horizon"))
    if cfg["kind"] == "world_frame":
        return WorldFrameReward(weights, scales, cfg["rotation_metric"])
    raise ValueError(f"reward kind must be heading_frame or world_frame, not {cfg['kind']!r}")
