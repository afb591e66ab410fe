"""From a policy and the wearer's video to motion: one pass over whole takes, all takes side by side.

Yuan & Kitani 2019, sections 3.1 and 3.3: the first state is the regressor's, placed where the person stands and faces;
from there the policy's mean action drives the humanoid. Where the fail-safe triggers at frame t, the humanoid restarts
at frame t + 1 from the regressor's state, at its own place and heading. Two things are beyond the paper. The humanoid
may restart at the place and heading of the path that is followed (:mod:`egopose.inference.followed_path`). With a
planner, the mean action is where planning begins, and V(s_t) is what the best plan is worth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp import rotations as torch_rotations
from egopose.envs.test_time import Controller, prepare_for_test
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.humanoid.model import HumanoidModel
from egopose.inference.acting import Acting, acting
from egopose.inference.counterfactuals import CounterfactualRollouts
from egopose.inference.failsafe import FailSafe
from egopose.inference.followed_path import FollowedPath
from egopose.inference.planners import AnyPlanner
from egopose.models.pose_regression import state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Estimate:
    """One take as the policy moved through it.

    Attributes:
        start: global frame of the first row; the rows are frames ``start .. start + T - 1``.
        qpos: ``[T, nq]``.
        value: ``[T]`` V(s_t); with a planner what its best plan was worth.
        confidence: ``[T]`` that over its running mean, see :class:`~egopose.inference.failsafe.FailSafe`.
        triggered: ``[T]`` frames at which the fail-safe triggered.
        resets: ``[T]`` frames whose state is the regressor's because the fail-safe triggered or the physics broke just
            before. The first frame is not counted.
        fallen: ``[T]`` frames in which the head is too low for the take.
        diverged: how often the physics broke.
    """

    start: int
    qpos: Array
    value: Array
    confidence: Array
    triggered: NDArray[np.bool_]
    resets: NDArray[np.bool_]
    fallen: NDArray[np.bool_]
    diverged: int

    @property
    def n_resets(self) -> int:
        """N_reset of the take."""
        return int(self.resets.sum())

    def columns(self) -> dict[str, Array]:
        """Per-frame figures ``[T]`` by name, for a table."""
        return {
            "value": self.value,
            "confidence": self.confidence,
            "triggered": self.triggered.astype(np.float64),
            "reset": self.resets.astype(np.float64),
            "fallen": self.fallen.astype(np.float64),
        }

    def motion(self, humanoid: HumanoidModel, name: str) -> Motion:
        """The estimate as a :class:`Motion` of the humanoid's skeleton, with its confidence."""
        return Motion(
            humanoid.skeleton,
            self.qpos,
            1.0 / humanoid.control_dt,
            name,
            confidence=self.confidence,
            meta={"source": "estimated by egopose"},
        )


@torch.no_grad()
def estimate_takes(
    env: TransformedEnv,
    actor: Controller,
    critic: Controller,
    states: Tensor,
    guard: FailSafe,
    lookahead: int | None = None,
    counterfactuals: CounterfactualRollouts | None = None,
    planner: AnyPlanner | None = None,
    restart: FollowedPath | None = None,
    watch: Callable[[Array], None] | None = None,
) -> list[Estimate]:
    """Run every world's fragment from its first frame to its last.

    The normaliser is frozen and the context networks see the take as far as ``lookahead`` lets them, both for good.

    Args:
        env: over :class:`EgoPoseEnv` with ``WholeFragments`` starts and falls that do not end the episode; world i's
            fragment is take i.
        actor, critic: policy and value network.
        states: ``[F, 2 nq - 3]`` the regressor's humanoid state of every global frame.
        guard: the fail-safe, of as many worlds.
        lookahead: future frames that trainable contexts may see; None for the whole take. ``states`` and contexts that
            come with the observation are the caller's.
        counterfactuals: is told the states in which the fail-safe triggered.
        planner: of as many bodies; None for the policy alone.
        restart: the path at whose place and heading bodies restart, with a row for every global frame; the planner's
            own, where there is a planner. None: they restart at their own.
        watch: is shown the bodies ``[N, nq]`` of each frame as soon as they are known.

    Returns:
        One :class:`Estimate` a world; fragments may differ in length.
    """
    base = env.base_env
    assert isinstance(base, EgoPoseEnv)
    prepare_for_test(env, actor, critic, lookahead=lookahead)
    first = env.reset()
    start, stop = first["episode_start"].squeeze(-1), first["episode_stop"].squeeze(-1)
    lengths = stop - start
    worlds = torch.arange(len(start))
    _restart(base, worlds, states[start], base.body_state()["qpos"])
    # Counterfactuals take rows of TensorDicts.
    body_acts = acting(env, actor, critic) if counterfactuals is None else Acting(env, actor, critic)
    observation = body_acts.observed()

    rows: dict[str, list[Tensor]] = {
        name: [] for name in ("qpos", "value", "triggered", "resets", "fallen", "diverged")
    }
    placed, diverged = torch.zeros_like(worlds, dtype=torch.bool), torch.zeros_like(worlds, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for t in range(int(lengths.max())):
            body = base.body_state()
            if restart is not None and planner is None:  # a planner moves its path on by itself
                restart.advance(base.frame, body["qpos"])
            observation = body_acts.act(observation)
            value = observation["state_value"].squeeze(-1)
            if planner is not None:
                observation["action"] = observation["action"] + planner.perturbation(base)
                value = planner.value
            triggered = guard.update(value, body["xpos"][:, base.problem.humanoid.head, 2], t < lengths)
            if restart is not None:
                now = restart.at((start + t).clamp(max=len(states) - 1))
                facing = torch_rotations.yaw(body["qpos"][:, 3:7])
                triggered |= (t < lengths) & guard.strayed(body["qpos"][:, :2], facing, *now)
            frame = (body["qpos"], value, triggered, placed, observation["fallen"].squeeze(-1), diverged)
            for name, column in zip(rows, frame, strict=True):
                rows[name].append(column)
            if watch is not None:
                watch(body["qpos"].numpy())
            if counterfactuals is not None and triggered.any():
                counterfactuals.keep(base, observation, triggered.nonzero().squeeze(-1))
            if t + 1 == int(lengths.max()):
                break
            observation = body_acts.step(observation)
            diverged = observation["diverged"].squeeze(-1)
            placed = (triggered | diverged) & (t + 1 < lengths)
            again = placed.nonzero().squeeze(-1)
            if len(again):
                where = body["qpos"][again]
                if restart is not None:
                    where = _on_path(where, *restart.at(start[again] + t + 1, again))
                _restart(base, again, states[start[again] + t + 1], where)
                if planner is not None:
                    planner.forget(again)
                observation = body_acts.observed()
    table = {name: torch.stack(column, dim=1).numpy() for name, column in rows.items()}
    confidence = torch.stack(guard.confidence, dim=1).numpy()
    return [
        Estimate(
            start=int(start[i]),
            qpos=table["qpos"][i, :n],
            value=table["value"][i, :n].astype(np.float64),
            confidence=confidence[i, :n],
            triggered=table["triggered"][i, :n],
            resets=table["resets"][i, :n],
            fallen=table["fallen"][i, :n],
            diverged=int(table["diverged"][i, :n].sum()),
        )
        for i, n in enumerate(lengths.tolist())
    ]


def restart_path(restart: str, env: TransformedEnv, planner: AnyPlanner | None) -> FollowedPath | None:
    """The path at which bodies of ``env`` restart, by ``failsafe.restart``; None for ``own``.

    It is the planner's. Without a planner nothing draws a body to its path, and the path is not drawn to the body.

    Raises:
        InputError: what the bodies follow has no path.
    """
    if restart == "own":
        return None
    if planner is not None:
        path = planner.path
    else:
        problem = env.base_env.problem
        whole = problem.followed().path
        path = None if whole is None else FollowedPath(whole, problem.humanoid.control_dt)
    if path is None:
        raise InputError("failsafe", "restart", "the target motion has no path to restart at: failsafe.restart=own")
    return path


def _on_path(qpos: Tensor, place: Tensor, heading: Tensor) -> Tensor:
    """``qpos [n, nq]`` standing at ``place [n, 2]`` m and facing ``heading [n]`` rad; the rest does not matter."""
    quaternion = torch.zeros(len(qpos), 4, dtype=qpos.dtype)
    quaternion[:, 0], quaternion[:, 3] = torch.cos(0.5 * heading), torch.sin(0.5 * heading)
    return torch.cat([place, qpos[:, 2:3], quaternion, qpos[:, 7:]], dim=-1)


def _restart(base: EgoPoseEnv, worlds: Tensor, states: Tensor, qpos: Tensor) -> None:
    """Put ``worlds [n]`` into the regressor's ``states [n, ...]`` at the place and heading of ``qpos [n, nq]``, feet
    out of the floor."""
    where, humanoid = qpos.numpy(), base.problem.humanoid
    placed, velocity = state_to_qpos(states.numpy(), where[:, :2], rot.heading(where[:, 3:7]), humanoid.joint_range)
    base.place(worlds, torch.from_numpy(out_of_floor(humanoid, placed)), torch.from_numpy(velocity))
