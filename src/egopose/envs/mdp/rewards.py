"""The imitation rewards of Yuan & Kitani 2019 (equations 2-7) and of DeepMimic (Peng et al. 2018, equations 5-9).

A reward is a table of terms, ``conf/reward``: ``{term: {weight, scale}}``. A term is a pure function of one
:class:`~egopose.envs.mdp.step_view.StepView`, registered under its name by :func:`reward_term`; one that the table does
not name weighs nothing.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.step_view import StepView

#: Parts of a :class:`StepView` that cost something to work out, made only where a term needs them.
PARTS = ("contacts", "torques", "target", "scene")


@dataclass(frozen=True)
class Term:
    """A reward term and what it reads.

    Args:
        function: ``function(view, *, scale, ...) -> [N]``.
        reads: attributes of :class:`~egopose.envs.mdp.observations.BodyView` it reads of body and reference.
        needs: the :data:`PARTS` of the view it reads.
        in_world: whether it changes where body and reference stand elsewhere or face another way.
    """

    function: Callable[..., Tensor]
    reads: tuple[str, ...]
    needs: tuple[str, ...]
    in_world: bool


#: Every term there is, by name.
TERMS: dict[str, Term] = {}


def reward_term(
    *, reads: tuple[str, ...] = (), needs: tuple[str, ...] = (), in_world: bool = False
) -> Callable[[Callable[..., Tensor]], Callable[..., Tensor]]:
    """Register a function as the term of its name; see :class:`Term`.

    Raises:
        ValueError: another function has the name, or ``needs`` names no part of the view.
    """

    def register(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        name = function.__name__
        known = TERMS.get(name)
        if known is not None and known.function.__module__ != function.__module__:
            raise ValueError(f"there is a reward term {name!r} already, of {known.function.__module__}")
        if unknown := set(needs) - set(PARTS):
            raise ValueError(f"a reward term can need {', '.join(PARTS)}, not {sorted(unknown)[0]!r}")
        TERMS[name] = Term(function, reads, needs, in_world)
        return function

    return register


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


@reward_term(reads=("joint_rotations",))
def pose(view: StepView, *, scale: float, metric: str) -> Tensor:
    """r_q = exp(-scale sum_j |q_j - q^_j|^2) over the joints' local rotations ``[N]`` (equation 3, scale 2)."""
    size = rotation_distance(view.body.joint_rotations, view.reference.joint_rotations, metric)
    return torch.exp(-scale * size.square().sum(-1))


@reward_term(reads=("end_effectors",))
def end_effector(view: StepView, *, scale: float) -> Tensor:
    """r_e = exp(-scale sum_e |e - e^|^2), vectors from the root in the heading frame ``[N]`` (equation 4, scale 20)."""
    return torch.exp(-scale * _squares(view.body.end_effectors, view.reference.end_effectors))


@reward_term(reads=("root_height", "root_rotation"))
def root_pose(view: StepView, *, scale: float, metric: str) -> Tensor:
    """r_p = exp(-scale ((h - h^)^2 + |q_r - q^_r|^2)), root rotations de-headed ``[N]`` (equation 5, scale 300)."""
    height = view.body.root_height - view.reference.root_height
    size = rotation_distance(view.body.root_rotation, view.reference.root_rotation, metric)
    return torch.exp(-scale * (height.square() + size.square()))


@reward_term(reads=("root_linear_velocity", "root_angular_velocity"))
def root_velocity(view: StepView, *, scale: float, angular_scale: float) -> Tensor:
    """r_v = exp(-scale |l - l^|^2 - angular_scale |w - w^|^2), heading frame ``[N]`` (equation 6, scales 1 and 0.1)."""
    dl = _squares(view.body.root_linear_velocity, view.reference.root_linear_velocity)
    dw = _squares(view.body.root_angular_velocity, view.reference.root_angular_velocity)
    return torch.exp(-scale * dl - angular_scale * dw)


def forecasting_decay(step: Tensor, horizon: int) -> Tensor:
    """beta = (T - t) / T at step t (equation 7), never below zero."""
    return ((horizon - step) / horizon).clamp_min(0.0)


@reward_term(reads=("joint_rotations", "root_quaternion"), in_world=True)
def world_pose(view: StepView, *, scale: float, metric: str) -> Tensor:
    """DeepMimic's r^p = exp(-2 sum_j |q_j - q^_j|^2), the root's world rotation among the joints ``[N]``."""
    joints = rotation_distance(view.body.joint_rotations, view.reference.joint_rotations, metric)
    root = rotation_distance(view.body.root_quaternion, view.reference.root_quaternion, metric)
    return torch.exp(-scale * (joints.square().sum(-1) + root.square()))


@reward_term(reads=("joint_velocities",))
def joint_velocity(view: StepView, *, scale: float) -> Tensor:
    """DeepMimic's r^v = exp(-0.1 sum_j |q'_j - q^'_j|^2) over the joints' velocities ``[N]``."""
    return torch.exp(-scale * _squares(view.body.joint_velocities, view.reference.joint_velocities))


@reward_term(reads=("end_effector_positions",), in_world=True)
def world_end_effector(view: StepView, *, scale: float) -> Tensor:
    """DeepMimic's r^e = exp(-40 sum_e |p_e - p^_e|^2), world positions ``[N]``."""
    return torch.exp(-scale * _squares(view.body.end_effector_positions, view.reference.end_effector_positions))


@reward_term(reads=("centre_of_mass",), in_world=True)
def centre_of_mass(view: StepView, *, scale: float) -> Tensor:
    """DeepMimic's r^c = exp(-10 |p_c - p^_c|^2), world positions ``[N]``."""
    return torch.exp(-scale * _squares(view.body.centre_of_mass, view.reference.centre_of_mass))


@reward_term(reads=("yaw",), in_world=True)
def heading(view: StepView, *, scale: float) -> Tensor:
    """exp(-scale dpsi^2) of the angle (rad, the short way round) between the roots' headings in the world ``[N]``.

    The paper's terms are in each body's own heading frame, where a turn that was not made costs nothing later.
    """
    return torch.exp(-scale * rot.wrapped(view.body.yaw - view.reference.yaw).square())


@reward_term(reads=("place",), in_world=True)
def path(view: StepView, *, scale: float) -> Tensor:
    """exp(-scale |p - p^|^2) of the roots' places (m, level) in the world ``[N]``."""
    return torch.exp(-scale * _squares(view.body.place, view.reference.place))


@dataclass(frozen=True)
class RewardTable:
    """A reward as a table of terms.

    Args:
        weights: term -> weight, 0 or more; a term of weight 0 is worked out and logged.
        parameters: term -> keyword arguments of its function.
        combine: ``mean``: the weighted sum over the sum of weights, within [0, 1] where the terms are (Yuan & Kitani
            2019, equation 2); ``sum``: the weighted sum (Yu, Park & Lee 2021).
        decay_horizon: T of :func:`forecasting_decay` in steps (forecasting); None for no decay.

    Raises:
        ValueError: an unknown term, a parameter its function does not take or lacks, or weights that leave nothing.
    """

    weights: Mapping[str, float]
    parameters: Mapping[str, Mapping[str, Any]]
    combine: str = "mean"
    decay_horizon: int | None = None
    _functions: dict[str, Callable[[StepView], Tensor]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.combine not in ("mean", "sum"):
            raise ValueError(f"combine must be mean or sum, not {self.combine!r}")
        for name, weight in self.weights.items():
            if not weight >= 0:
                raise ValueError(f"terms.{name}.weight must be 0 or more, not {weight}")
        if not sum(self.weights.values()) > 0:
            raise ValueError("terms must hold one whose weight is above 0")
        functions = {name: _bound(name, self.parameters.get(name, {})) for name in self.weights}
        object.__setattr__(self, "_functions", functions)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        return tuple(self.weights)

    @property
    def reads(self) -> tuple[str, ...]:
        """Attributes of :class:`~egopose.envs.mdp.observations.BodyView` that some term reads, each once."""
        return tuple(dict.fromkeys(name for term in self.weights for name in TERMS[term].reads))

    @property
    def in_world(self) -> tuple[str, ...]:
        """The terms that depend on where the body stands and faces; none where all is in the heading frame."""
        return tuple(term for term in self.weights if TERMS[term].in_world)

    def part(self, terms: Collection[str]) -> RewardTable:
        """The table of these terms alone; each adds to the reward what it adds in the whole table.

        Raises:
            ValueError: none of them weighs anything.
        """
        whole = sum(self.weights.values()) if self.combine == "mean" else 1.0
        weights = {term: weight / whole for term, weight in self.weights.items() if term in terms}
        return RewardTable(weights, self.parameters, "sum", self.decay_horizon)

    @property
    def needs(self) -> frozenset[str]:
        """The :data:`PARTS` of a step that some term reads."""
        return frozenset(part for term in self.weights for part in TERMS[term].needs)

    def __call__(self, view: StepView) -> tuple[Tensor, dict[str, Tensor]]:
        """The reward ``[N]`` of a step, and its terms ``[N]`` by name."""
        terms = {name: function(view) for name, function in self._functions.items()}
        whole = sum(self.weights.values()) if self.combine == "mean" else 1.0
        total = torch.zeros_like(next(iter(terms.values())))
        for name, weight in self.weights.items():
            total = torch.add(total, terms[name], alpha=weight / whole)
        if self.decay_horizon is not None:
            total = total * forecasting_decay(view.step, self.decay_horizon)
        return total, terms


def _bound(name: str, parameters: Mapping[str, Any]) -> Callable[[StepView], Tensor]:
    """The term's function with its parameters in place."""
    if name not in TERMS:
        raise ValueError(f"terms.{name} is no reward term; there are {', '.join(sorted(TERMS))}")
    function = TERMS[name].function
    takes = {p.name: p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY}
    for given in parameters:
        if given not in takes:
            raise ValueError(f"terms.{name}.{given} is no parameter; there are weight, {', '.join(takes)}")
    for wanted, parameter in takes.items():
        if wanted not in parameters and parameter.default is parameter.empty:
            raise ValueError(f"terms.{name}.{wanted} is missing")
    return partial(function, **parameters)


def build_reward(config: Mapping[str, Any]) -> RewardTable:
    """The reward a ``conf/reward`` file describes.

    Its ``rotation_metric`` goes to every term that measures rotations and names no ``metric`` of its own.

    Raises:
        ValueError: see :class:`RewardTable`; a term that is no mapping or has no weight.
    """
    weights, parameters = {}, {}
    for name, row in config["terms"].items():
        if row is None:  # taken out of a table that this one builds on
            continue
        if not isinstance(row, Mapping) or "weight" not in row:
            raise ValueError(f"terms.{name} must be {{weight: ..., scale: ...}}, not {row!r}")
        weights[name] = float(row["weight"])
        parameters[name] = {key: value for key, value in row.items() if key != "weight"}
        if name in TERMS and "metric" in inspect.signature(TERMS[name].function).parameters:
            parameters[name].setdefault("metric", config["rotation_metric"])
    return RewardTable(weights, parameters, config["combine"], config.get("decay_horizon"))
