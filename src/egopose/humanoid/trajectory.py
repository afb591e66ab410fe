"""Iterative LQR: the best controls of some frames ahead, and how they change with the state (Li & Todorov 2004).

The motion that is followed gives the cost: squared differences of root, joints and velocities, and of the controls from
those that inverse dynamics would take. Around a nominal simulation the step is linear and the cost quadratic, so a
backward pass gives changes of the controls and gains (Tassa, Erez & Todorov 2012, whole bodies in MuJoCo).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.humanoid.derivatives import Differences, Simulator, Single, linearised, state_difference
from egopose.humanoid.model import HumanoidModel
from egopose.motion.rotations import Array

_BROKEN = 1e12  # the cost of a simulation that is not finite


@dataclass(frozen=True)
class TrackingCost:
    """Weights of squared differences.

    Args:
        place, height, turn: of the root: 1/m^2, 1/m^2, 1/rad^2.
        linear, angular: of the root's velocities.
        joints, joint_rates: of each joint.
        control: of each control from the feed-forward, 1/rad^2.
        last: factor of the last frame's weights, for what comes after it.
    """

    place: float
    height: float
    turn: float
    linear: float
    angular: float
    joints: float
    joint_rates: float
    control: float
    last: float

    def weights(self, nv: int) -> Array:
        """``[2 nv]`` of a state's difference."""
        joints = nv - 6
        position = [self.place, self.place, self.height, *[self.turn] * 3, *[self.joints] * joints]
        return np.array([*position, *[self.linear] * 3, *[self.angular] * 3, *[self.joint_rates] * joints])


@dataclass(frozen=True)
class Nominal:
    """A simulated trajectory of N bodies over H frames.

    Args:
        qpos, qvel: ``[N, H + 1, nq]``, ``[N, H + 1, nv]``.
        ctrl: ``[N, H, nu]`` rad.
        cost: ``[N]``.
    """

    qpos: Array
    qvel: Array
    ctrl: Array
    cost: Array

    def chosen(self, other: Nominal) -> Nominal:
        """Of each body the one that costs less; this where they cost the same."""
        better = other.cost < self.cost
        pick = better[:, None, None]
        return Nominal(
            np.where(pick, other.qpos, self.qpos),
            np.where(pick, other.qvel, self.qvel),
            np.where(pick, other.ctrl, self.ctrl),
            np.where(better, other.cost, self.cost),
        )


@dataclass(frozen=True)
class Followed:
    """What N bodies follow over H frames.

    Args:
        qpos, qvel: ``[N, H + 1, nq]``, ``[N, H + 1, nv]``, the present frame first.
        ctrl: ``[N, H, nu]`` rad, the feed-forward of each step.
    """

    qpos: Array
    qvel: Array
    ctrl: Array


def feed_forward(humanoid: HumanoidModel, qpos: Array, qvel: Array, torques: Array, velocity: float) -> Array:
    """``[..., H, nu]`` rad, PD targets that would lead along a motion if nothing went wrong.

    Args:
        humanoid: for the gains.
        qpos, qvel: ``[..., H + 1, nq]``, ``[..., H + 1, nv]``.
        torques: ``[..., H + 1, nu]`` N m of inverse dynamics.
        velocity: factor of ``kd / kp`` times the joints' velocity, against the controllers' lag.
    """
    mean = 0.5 * (torques[..., 1:, :] + torques[..., :-1, :])
    lag = velocity * humanoid.kd / humanoid.kp
    return np.asarray(qpos[..., 1:, 7:] + lag * qvel[..., 1:, 6:] + mean / humanoid.kp)


def shifted(plan: Nominal, followed: Followed, by: int) -> Nominal:
    """A plan ``by`` frames later: what follows its end is the feed-forward about the motion itself."""
    kept = plan.ctrl.shape[1] - by
    return Nominal(
        np.concatenate([plan.qpos[:, by:-1], followed.qpos[:, kept:]], axis=1),
        np.concatenate([plan.qvel[:, by:-1], followed.qvel[:, kept:]], axis=1),
        np.concatenate([plan.ctrl[:, by:], followed.ctrl[:, kept:]], axis=1),
        plan.cost,
    )


class TrajectoryOptimiser:
    """Iterative LQR for N bodies side by side.

    Args:
        simulator: of all steps.
        cost: see :class:`TrackingCost`.
        steps: shares of the controls' changes that a line search tries.
        reach: rad that a control may differ from the feed-forward.
        sizes: of the differences.
    """

    def __init__(
        self,
        simulator: Simulator,
        cost: TrackingCost,
        steps: tuple[float, ...] = (1.0, 0.6, 0.3, 0.1),
        reach: float = 0.6,
        sizes: Differences | None = None,
    ) -> None:
        self.simulator, self.cost, self.steps, self.reach = simulator, cost, steps, reach
        self.sizes = sizes or Differences()

    def simulate(
        self,
        qpos: Array,
        qvel: Array,
        followed: Followed,
        about: Nominal | None = None,
        change: Array | None = None,
        gains: Single | None = None,
    ) -> Nominal:
        """Simulate N bodies from ``qpos [N, nq]``, ``qvel [N, nv]`` under the controls of ``about``.

        Args:
            qpos, qvel: where they start.
            followed: for the cost and the bounds of the controls.
            about: whose controls are taken, changed by ``change [N, H, nu]`` and by ``gains [N, H, nu, 2 nv]`` times
                the state's difference from it; None for the feed-forward.
            change, gains: None for none.
        """
        weights = self.cost.weights(qvel.shape[-1])
        reach, horizon = self.reach, followed.ctrl.shape[1]
        positions, velocities, controls = [qpos], [qvel], []
        cost = np.zeros(len(qpos))
        for t in range(horizon):
            ahead = followed.ctrl[:, t]
            ctrl = ahead if about is None else about.ctrl[:, t]
            if about is not None and gains is not None:
                away = state_difference(qpos, qvel, about.qpos[:, t], about.qvel[:, t])
                ctrl = ctrl + np.einsum("nij,nj->ni", gains[:, t], away)
            if change is not None:
                ctrl = ctrl + change[:, t]
            ctrl = np.clip(ctrl, ahead - reach, ahead + reach)
            wrong = state_difference(qpos, qvel, followed.qpos[:, t], followed.qvel[:, t])
            cost += (weights * wrong**2).sum(-1) + self.cost.control * ((ctrl - ahead) ** 2).sum(-1)
            qpos, qvel = self.simulator.step(qpos, qvel, ctrl)
            positions.append(qpos)
            velocities.append(qvel)
            controls.append(ctrl)
        wrong = state_difference(qpos, qvel, followed.qpos[:, horizon], followed.qvel[:, horizon])
        cost += self.cost.last * (weights * wrong**2).sum(-1)
        cost = np.where(np.isfinite(cost), cost, _BROKEN)
        return Nominal(np.stack(positions, 1), np.stack(velocities, 1), np.stack(controls, 1), cost)

    def improve(self, nominal: Nominal, followed: Followed) -> tuple[Nominal, Single]:
        """One iteration: the better of the nominal and what a line search finds, and gains ``[N, H, nu, 2 nv]``."""
        count, horizon, nu = nominal.ctrl.shape
        starts = (nominal.qpos[:, :-1], nominal.qvel[:, :-1], nominal.ctrl)
        qpos, qvel, ctrl = (part.reshape(count * horizon, -1) for part in starts)
        state, control = linearised(self.simulator, qpos, qvel, ctrl, self.sizes)
        wrong = state_difference(nominal.qpos, nominal.qvel, followed.qpos, followed.qvel)
        change, gains = self.backward(
            state.reshape(count, horizon, *state.shape[1:]),
            control.reshape(count, horizon, -1, nu),
            wrong,
            nominal.ctrl - followed.ctrl,
        )
        tried = self._line_search(nominal, followed, change, gains)
        return nominal.chosen(tried), gains

    def _line_search(self, nominal: Nominal, followed: Followed, change: Array, gains: Single) -> Nominal:
        """The best of all shares of ``change``, simulated side by side."""
        copies, count = len(self.steps), len(nominal.cost)

        def each(rows: NDArray[np.floating]) -> Array:
            return np.concatenate([rows] * copies)

        shares = np.repeat(self.steps, count)[:, None, None]
        tried = self.simulate(
            each(nominal.qpos[:, 0]),
            each(nominal.qvel[:, 0]),
            Followed(each(followed.qpos), each(followed.qvel), each(followed.ctrl)),
            Nominal(each(nominal.qpos), each(nominal.qvel), each(nominal.ctrl), each(nominal.cost)),
            shares * each(change),
            each(gains).astype(np.float32),
        )
        best = tried.cost.reshape(copies, count).argmin(0) * count + np.arange(count)
        return Nominal(tried.qpos[best], tried.qvel[best], tried.ctrl[best], tried.cost[best])

    @torch.no_grad()
    def backward(self, state: Single, control: Single, wrong: Array, added: Array) -> tuple[Array, Single]:
        """Riccati's recursion: changes ``[N, H, nu]`` of the controls and gains ``[N, H, nu, 2 nv]``.

        Args:
            state, control: A ``[N, H, 2 nv, 2 nv]`` and B ``[N, H, 2 nv, nu]`` along the nominal.
            wrong: ``[N, H + 1, 2 nv]`` differences of the nominal from the target motion.
            added: ``[N, H, nu]`` of its controls from the feed-forward.
        """
        weights = torch.from_numpy(self.cost.weights(wrong.shape[-1] // 2)).float()
        a_all, b_all = torch.from_numpy(state), torch.from_numpy(control)
        error, extra = torch.from_numpy(wrong).float(), torch.from_numpy(added).float()
        curvature = torch.diag(self.cost.last * weights).expand(len(a_all), -1, -1)
        slope = self.cost.last * weights * error[:, -1]
        changes: list[Tensor] = []
        gains: list[Tensor] = []
        eye = torch.eye(b_all.shape[-1])
        for t in range(a_all.shape[1] - 1, -1, -1):
            a, b = a_all[:, t], b_all[:, t]
            forced, moved_on = curvature @ b, curvature @ a
            quu, qux = b.mT @ forced + self.cost.control * eye, b.mT @ moved_on
            qu = (b.mT @ slope[..., None])[..., 0] + self.cost.control * extra[:, t]
            qx = (a.mT @ slope[..., None])[..., 0] + weights * error[:, t]
            solved = -torch.cholesky_solve(torch.cat([qux, qu[..., None]], dim=-1), _factor(quu))
            # A step that broke has derivatives beyond all numbers: that body's controls stay, the others' do not mind.
            sound = solved.isfinite().all(-1).all(-1)
            solved = torch.where(sound[:, None, None], solved, 0.0)
            gain, change = solved[..., :-1], solved[..., -1]
            changes.append(change)
            gains.append(gain)
            curvature = a.mT @ moved_on + torch.diag(weights) + qux.mT @ gain
            curvature = 0.5 * (curvature + curvature.mT)
            slope = qx + (gain.mT @ qu[..., None])[..., 0]
        return torch.stack(changes[::-1], 1).double().numpy(), torch.stack(gains[::-1], 1).numpy()


def _factor(matrices: Tensor) -> Tensor:
    """Cholesky factors of ``matrices [N, n, n]``, with as much of their largest entry on the diagonal as they need.

    In single precision a hundred-thousandth is enough, but where a body breaks.
    """
    eye = torch.eye(matrices.shape[-1])
    largest = matrices.diagonal(dim1=-2, dim2=-1).abs().amax(-1)[:, None, None]
    share = torch.full((len(matrices), 1, 1), 1e-5)
    for _ in range(5):
        factor, failed = torch.linalg.cholesky_ex(matrices + share * largest * eye)
        if not failed.any():
            break
        share = torch.where(failed[:, None, None] > 0, 30.0 * share, share)
    return factor
