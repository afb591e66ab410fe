"""The imitation rewards of Yuan & Kitani 2019 (equations 2-7) and of DeepMimic (Peng et al. 2018, equations 5-9)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.envs.mdp import observations as obs
from egopose.envs.mdp import rotations as rot


@dataclass(frozen=True)
class BodyLayout:
    """Which bodies a reward looks at.

    Args:
        parents: ``[J]`` index of the parent of every body but the root.
        end_effectors: ``[E]`` indices of hands, feet and head.
    """

    parents: Tensor
    end_effectors: Tensor


def rotation_size(q: Tensor, metric: str) -> Tensor:
    """``[...]`` size of rotations ``q [..., 4]``, the short way round.

    ``half_angle`` is arccos(w), the authors' measure, with which their published numbers were made; ``angle`` is twice
    that, the true angle.

    Raises:
        ValueError: another metric.
    """
    if metric not in ("half_angle", "angle"):
        raise ValueError(f"rotation_metric must be half_angle or angle, not {metric!r}")
    half = rot.half_angle(q)
    return half if metric == "half_angle" else 2.0 * half


def _difference(a: Tensor, b: Tensor, metric: str) -> Tensor:
    return rotation_size(rot.multiply(a, rot.conjugate(b)), metric)


def pose(state: TensorDictBase, reference: TensorDictBase, parents: Tensor, scale: float, metric: str) -> Tensor:
    """r_q = exp(-scale sum_j |q_j - q^_j|^2) over the joints' local rotations ``[N]`` (equation 3, scale 2)."""
    size = _difference(obs.joint_rotations(state, parents), obs.joint_rotations(reference, parents), metric)
    return torch.exp(-scale * size.square().sum(-1))


def end_effector(state: TensorDictBase, reference: TensorDictBase, bodies: Tensor, scale: float) -> Tensor:
    """r_e = exp(-scale sum_e |e - e^|^2), vectors from the root in the heading frame ``[N]`` (equation 4, scale 20)."""
    difference = obs.end_effectors(state, bodies) - obs.end_effectors(reference, bodies)
    return torch.exp(-scale * difference.square().sum((-1, -2)))


def root_pose(state: TensorDictBase, reference: TensorDictBase, scale: float, metric: str) -> Tensor:
    """r_p = exp(-scale ((h - h^)^2 + |q_r - q^_r|^2)), root rotations de-headed ``[N]`` (equation 5, scale 300)."""
    height = state["qpos"][:, 2] - reference["qpos"][:, 2]
    size = _difference(rot.dehead(state["qpos"][:, 3:7]), rot.dehead(reference["qpos"][:, 3:7]), metric)
    return torch.exp(-scale * (height.square() + size.square()))


def root_velocity(state: TensorDictBase, reference: TensorDictBase, linear: float, angular: float) -> Tensor:
    """r_v = exp(-linear |l - l^|^2 - angular |w - w^|^2), heading frame ``[N]`` (equation 6, scales 1 and 0.1)."""
    dl = obs.root_linear_velocity(state) - obs.root_linear_velocity(reference)
    dw = obs.root_angular_velocity(state) - obs.root_angular_velocity(reference)
    return torch.exp(-linear * dl.square().sum(-1) - angular * dw.square().sum(-1))


def forecasting_decay(step: Tensor, horizon: int) -> Tensor:
    """beta = (T - t) / T at step t (equation 7), never below zero."""
    return ((horizon - step) / horizon).clamp_min(0.0)


def world_pose(state: TensorDictBase, reference: TensorDictBase, parents: Tensor, scale: float, metric: str) -> Tensor:
    """DeepMimic's r^p = exp(-2 sum_j |q_j - q^_j|^2), the root's world rotation among the joints ``[N]``."""
    joints = _difference(obs.joint_rotations(state, parents), obs.joint_rotations(reference, parents), metric)
    root = _difference(state["qpos"][:, 3:7], reference["qpos"][:, 3:7], metric)
    return torch.exp(-scale * (joints.square().sum(-1) + root.square()))


def joint_velocity(state: TensorDictBase, reference: TensorDictBase, scale: float) -> Tensor:
    """DeepMimic's r^v = exp(-0.1 sum_j |q'_j - q^'_j|^2) over the joints' velocities ``[N]``."""
    return torch.exp(-scale * (state["qvel"][:, 6:] - reference["qvel"][:, 6:]).square().sum(-1))


def world_end_effector(state: TensorDictBase, reference: TensorDictBase, bodies: Tensor, scale: float) -> Tensor:
    """DeepMimic's r^e = exp(-40 sum_e |p_e - p^_e|^2), world positions ``[N]``."""
    return torch.exp(-scale * (state["xpos"][:, bodies] - reference["xpos"][:, bodies]).square().sum((-1, -2)))


def centre_of_mass(state: TensorDictBase, reference: TensorDictBase, scale: float) -> Tensor:
    """DeepMimic's r^c = exp(-10 |p_c - p^_c|^2), world positions ``[N]``."""
    return torch.exp(-scale * (state["com"] - reference["com"]).square().sum(-1))


def weighted_mean(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """``[N]``: the weighted sum of the terms over the sum of the weights (equation 2, kept within [0, 1])."""
    total = sum(weights.values())
    return torch.stack([terms[k] * (w / total) for k, w in weights.items()]).sum(0)


class Reward(Protocol):
    """What the environment asks of a reward."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        ...

    def __call__(
        self, state: TensorDictBase, reference: TensorDictBase, layout: BodyLayout, step: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
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

    def __post_init__(self) -> None:
        _check_weights(self.weights, self.names)

    def __call__(
        self, state: TensorDictBase, reference: TensorDictBase, layout: BodyLayout, step: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        s, metric = self.scales, self.rotation_metric
        terms = {
            "pose": pose(state, reference, layout.parents, s["pose"], metric),
            "end_effector": end_effector(state, reference, layout.end_effectors, s["end_effector"]),
            "root_pose": root_pose(state, reference, s["root_pose"], metric),
            "root_velocity": root_velocity(state, reference, s["root_linear_velocity"], s["root_angular_velocity"]),
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

    def __post_init__(self) -> None:
        _check_weights(self.weights, self.names)

    def __call__(
        self, state: TensorDictBase, reference: TensorDictBase, layout: BodyLayout, step: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        s = self.scales
        terms = {
            "pose": world_pose(state, reference, layout.parents, s["pose"], self.rotation_metric),
            "velocity": joint_velocity(state, reference, s["velocity"]),
            "end_effector": world_end_effector(state, reference, layout.end_effectors, s["end_effector"]),
            "centre_of_mass": centre_of_mass(state, reference, s["centre_of_mass"]),
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
