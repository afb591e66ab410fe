"""Looking ahead by Gauss-Newton: the policy's own future, brought nearer to the motion that is followed.

Random shooting (:mod:`egopose.inference.planner`) finds what keeps a body up, but chance seldom finds what brings all
of its joints nearer. Here the perturbation at each knot of each joint is tried alone, which gives the derivatives of
all distances from the target motion (:mod:`egopose.inference.gauss_newton`). Several steps are tried side by side,
beside the plan so far and no perturbation, and the best one is taken. A body that falls in it gets rounds of random
shooting.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.problem import Followed
from egopose.inference.candidates import Futures, Tried
from egopose.inference.gauss_newton import (
    Distance,
    DistanceWeights,
    check_steps,
    knot_lines,
    single_changes,
    steps_of,
)
from egopose.inference.planner import Planner
from egopose.inference.planner_settings import PlannerSettings
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

_BROKEN = 1e6  # lost by a candidate whose physics break: more than any distance


@dataclass(frozen=True)
class PlanWeights(DistanceWeights):
    """Weights of squares, of each frame.

    Args:
        offsets: 1/rad^2, of each perturbation.
        smooth: 1/rad^2, of each perturbation's change from frame to frame.
        last: factor of the last frame, for what comes after it.
        value: of the critic's value at the end, as cost that a unit of it is worth.
    """

    offsets: float
    smooth: float
    last: float
    value: float


@dataclass(frozen=True)
class GaussNewtonSettings(PlannerSettings):
    """``conf/planner/gauss_newton.yaml``, which gives every value and its source.

    Args:
        changed: frames of the horizon in which perturbations have knots; the rest shows what comes of them.
        iterations: of Gauss-Newton in a plan.
        difference: rad, of a knot that is tried.
        reach: rad that a step may change a perturbation by.
        dampings: of the steps that are tried, 1/rad^2.
        weights: see :class:`PlanWeights`.
    """

    changed: int
    iterations: int
    difference: float
    reach: float
    dampings: tuple[float, ...]
    weights: PlanWeights

    @property
    def control_steps(self) -> float:
        """Simulated for a frame of each body while none falls."""
        tried = self.samples + 2 + len(self.dampings)
        return self.iterations * tried * self.horizon / self.every

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.iterations < 1:
            raise InputError("planner", "iterations", "must be at least 1")
        if not 1 <= self.changed <= self.horizon:
            raise InputError("planner", "changed", "must lie between 1 and the horizon")
        check_steps("planner", self.difference, self.reach, self.dampings)

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> GaussNewtonSettings:
        """Raises InputError: a value is missing, unknown or wrong."""
        weights = from_mapping(PlanWeights, values["weights"], "conf/planner: weights")
        lists = {name: tuple(values[name]) for name in ("joints", "dampings")}
        return from_mapping(cls, {**values, **lists, "weights": weights}, "conf/planner")


class GaussNewtonPlanner(Planner):
    """Plans for N bodies side by side, see :class:`egopose.inference.planner.Planner`.

    Raises:
        InputError: as there; the target motion has no path; or ``samples`` is not one more than knots times hinges.
    """

    settings: GaussNewtonSettings

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        settings: GaussNewtonSettings,
        followed: Followed | None = None,
    ) -> None:
        super().__init__(env, actor, critic, settings, followed)
        if self.path is None:
            raise InputError("planner", "path", "the target motion has no path: planner=ahead")
        humanoid, lines = (
            self._base.problem.humanoid,
            knot_lines(settings.horizon, settings.knot_spacing, settings.changed),
        )
        hinges = humanoid.mj_model.nu
        if settings.samples != 1 + len(lines) * hinges:
            raise InputError(
                "planner", "samples", f"must be 1 + {len(lines)} knots x {hinges} hinges = {1 + len(lines) * hinges}"
            )
        self._lines = torch.from_numpy(lines).float()
        alone = torch.from_numpy(single_changes(lines, hinges, settings.difference)).float()
        self._alone = torch.cat([torch.zeros(1, *alone.shape[1:]), alone])[:, None]
        self._distance = Distance(humanoid, settings.weights, self._places.shape[1])
        self._taken = torch.zeros_like(self._plan[:, 0])  # a frame ago

    def perturbation(self, base: EgoPoseEnv) -> Tensor:
        self._taken = super().perturbation(base)
        return self._taken

    def forget(self, worlds: Tensor) -> None:
        super().forget(worlds)
        self._taken[worlds] = 0.0

    def _searched(self, now: Mapping[str, Tensor]) -> Tried | None:
        settings, tried = self.settings, None
        plan = self._plan[:, : settings.horizon].clone()
        best, current = plan, torch.stack([torch.zeros_like(plan), plan])
        for _ in range(settings.iterations):
            changed = best + self._alone
            futures = self._simulated(now, changed)
            if futures is None:
                break
            more = self._tried(now, torch.cat([current, best + self._steps(futures, changed)]))
            if more is None:
                break
            tried = more if tried is None else tried.joined(more)
            best = tried.candidates[tried.score.argmax(0), torch.arange(len(plan))]
        else:
            assert tried is not None
            return self._rescued(now, tried)
        self.plans_cut += tried is not None
        return tried

    def _steps(self, futures: Futures, candidates: Tensor) -> Tensor:
        """``[D, N, H, nu]`` steps by the ``futures`` of the plan, and of it with each knot changed alone."""
        settings, worlds = self.settings, candidates.shape[1]
        residuals = self._residuals(futures, candidates)
        sound = (futures.broken.view(candidates.shape[:2]) == 0).numpy()
        steps = np.zeros((len(settings.dampings), worlds, *self._lines.shape[:1], candidates.shape[-1]))
        for world in range(worlds):
            step = steps_of(
                residuals[:, world], sound[:, world], settings.difference, settings.dampings, settings.reach
            )
            steps[:, world] = step.reshape(len(step), *steps.shape[2:])
        return torch.einsum("kl,dnkj->dnlj", self._lines, torch.from_numpy(steps).float())

    def _residuals(self, futures: Futures, candidates: Tensor) -> Array:
        """``[K, N, R]`` whose squares add up to a candidate's cost."""
        weights, (count, worlds, steps, size) = self.settings.weights, candidates.shape
        assert self.path is not None
        rows = futures.row.view(steps, count * worlds)[:, :worlds].flatten()
        place, heading = (part.numpy() for part in self.path.at(rows))
        turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), heading)
        at = rows.numpy()
        qpos, qvel = self._qpos[at].copy(), self._qvel[at].copy()
        qpos[:, :2] = place
        qpos[:, 3:7] = rot.multiply(turn, qpos[:, 3:7])
        qvel[:, :3] = rot.rotate(turn, qvel[:, :3])
        shift = np.column_stack([place, np.zeros(len(place))])
        places = rot.rotate(turn[:, None], self._places[at]) + shift[:, None]
        wanted = [part.reshape(steps, 1, worlds, *part.shape[1:]) for part in (qpos, qvel, places)]
        shape = (steps, count, worlds)
        now = futures.qpos.reshape(*shape, -1), futures.qvel[1:].reshape(*shape, -1)
        bodies = self._base.physics.poses(futures.qpos.reshape(-1, futures.qpos.shape[-1]))["xpos"]
        apart = np.concatenate(
            [
                self._distance.of_state(
                    *now, *(np.broadcast_to(w, n.shape) for w, n in zip(wanted, now, strict=False))
                ),
                self._distance.of_bodies(bodies.reshape(*shape, *bodies.shape[1:]), wanted[2]),
                self._distance.of_change(np.diff(futures.qvel, axis=0)).reshape(*shape, -1),
            ],
            axis=-1,
        )
        apart[-1] *= np.sqrt(weights.last)
        added = candidates.double().numpy()
        before = np.broadcast_to(self._taken.numpy()[None, :, None], (count, worlds, 1, size))
        change = np.diff(added, axis=2, prepend=before)
        parts = (
            apart.transpose(1, 2, 0, 3),
            np.sqrt(weights.offsets) * added,
            np.sqrt(weights.smooth) * change,
        )
        return np.concatenate([part.reshape(count, worlds, -1) for part in parts], axis=-1)

    def _scored(self, futures: Futures, candidates: Tensor) -> Tried:
        tried, weights = super()._scored(futures, candidates), self.settings.weights
        cost = torch.from_numpy((self._residuals(futures, candidates) ** 2).sum(-1)).float()
        kept = weights.value * futures.value.view(cost.shape) - _BROKEN * futures.broken.view(cost.shape)
        return Tried(candidates, kept - cost, tried.returns, tried.low)
