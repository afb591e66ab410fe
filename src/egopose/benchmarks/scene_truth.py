"""True motions among boxes: motion capture tracked *with* its root by iterative LQR in the simulator.

What comes out is simulated: its contacts, its forces and its boxes are exact. It is the truth that a reconstruction,
which never sees the root, is judged by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.derivatives import Simulator, Single, state_difference
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.trajectory import (
    Followed,
    Nominal,
    TrackingCost,
    TrajectoryOptimiser,
    feed_forward,
    shifted,
)
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array
from egopose.scene.clip import box_poses
from egopose.scene.scene_file import Scene
from egopose.scene.simulated import SimulatedMotion

_FORCES = ForceSettings(cutoff_hz=8.0, touch=0.05, lever=0.3, evenness=0.05)  # conf/tracker.yaml
_WORLDS = 512


@dataclass(frozen=True)
class TruthSettings:
    """How the mocap is tracked.

    Args:
        bodies: side by side. After each plan the worse half goes on from where the better half is.
        noise: rad, standard deviation of what leads that half to other states, drawn for each plan.
        horizon, every: frames ahead, and between plans.
        iterations: of iterative LQR at each plan.
        reach: rad that a control may differ from the feed-forward.
        cost: against the mocap's root, joints and velocities.
        seed: of the noise.
    """

    bodies: int = 1
    noise: float = 0.02
    horizon: int = 20
    every: int = 5
    iterations: int = 3
    reach: float = 1.0
    cost: TrackingCost = field(
        default_factory=lambda: TrackingCost(
            place=30.0,
            height=60.0,
            turn=60.0,
            linear=1.0,
            angular=0.5,
            joints=2.0,
            joint_rates=0.01,
            control=0.5,
            last=3.0,
        )
    )
    seed: int = 0


@dataclass(frozen=True)
class _Block:
    """What N bodies did between two plans: states after each step, controls, and whose place each body took."""

    qpos: list[Array]
    qvel: list[Array]
    ctrl: list[Array]
    parent: NDArray[np.int64]


def track(
    humanoid: HumanoidModel, scene: Scene, motion: Motion, settings: TruthSettings, threads: int = 1
) -> SimulatedMotion:
    """The motion as the simulated body can make it: iterative LQR in a receding horizon, the fittest of some bodies.

    Args:
        humanoid: in the scene's worlds, see :func:`egopose.scene.clip.humanoid_in`.
        scene: its boxes.
        motion: to be followed, ``T`` frames at the control rate.
        settings: see :class:`TruthSettings`.
        threads: of the physics.
    """
    tops, headings = box_poses(scene)
    rng, every, count = np.random.default_rng(settings.seed), settings.every, settings.bodies
    simulator = Simulator(humanoid, _WORLDS, threads)
    simulator.place_boxes(tops, headings)
    optimiser = TrajectoryOptimiser(simulator, settings.cost, reach=settings.reach)
    followed = _followed(humanoid, motion, settings.horizon)
    start = followed.qpos[0, :1], followed.qvel[0, :1]
    qpos, qvel = np.repeat(followed.qpos[:, 0], count, axis=0), np.repeat(followed.qvel[:, 0], count, axis=0)
    blocks: list[_Block] = []
    plan: Nominal | None = None
    gains: Single = np.zeros(0, dtype=np.float32)
    for at in range(0, len(motion) - 1, every):
        ahead = _window(followed, at, settings.horizon, count)
        nominal = optimiser.simulate(qpos, qvel, ahead)
        if plan is not None:
            later = np.concatenate([gains[:, every:], 0 * gains[:, :every]], axis=1)
            older = shifted(plan, ahead, every)
            nominal = nominal.chosen(optimiser.simulate(qpos, qvel, ahead, older, gains=later))
        for _ in range(settings.iterations):
            nominal, gains = optimiser.improve(nominal, ahead)
        parent = np.tile(np.argsort(nominal.cost, kind="stable")[: -(-count // 2)], 2)[:count]
        plan, gains = _picked(nominal, parent), gains[parent]
        qpos, qvel = qpos[parent], qvel[parent]
        astray = (
            settings.noise
            * rng.normal(size=(count, plan.ctrl.shape[2]))
            * (np.arange(count) >= -(-count // 2))[:, None]
        )
        block = _Block([], [], [], parent)
        for step in range(min(every, len(motion) - 1 - at)):
            away = state_difference(qpos, qvel, plan.qpos[:, step], plan.qvel[:, step])
            ctrl = plan.ctrl[:, step] + np.einsum("nij,nj->ni", gains[:, step], away) + astray
            qpos, qvel = simulator.step(qpos, qvel, ctrl)
            for kept, value in ((block.qpos, qpos), (block.qvel, qvel), (block.ctrl, ctrl)):
                kept.append(value)
        blocks.append(block)
    simulator.close()
    return _traced(blocks, start, tops, headings)


def _picked(plan: Nominal, rows: NDArray[np.int64]) -> Nominal:
    return Nominal(plan.qpos[rows], plan.qvel[rows], plan.ctrl[rows], plan.cost[rows])


def _traced(blocks: list[_Block], start: tuple[Array, Array], tops: Array, headings: Array) -> SimulatedMotion:
    """The way that led to the first body of the last block, the best one there."""
    row, parts = 0, []
    for block in reversed(blocks):
        parts.append(tuple(np.stack([step[row] for step in steps]) for steps in (block.qpos, block.qvel, block.ctrl)))
        row = int(block.parent[row])
    qpos, qvel, ctrl = (np.concatenate([part[k] for part in reversed(parts)]) for k in range(3))
    return SimulatedMotion(np.concatenate([start[0], qpos]), np.concatenate([start[1], qvel]), ctrl, tops, headings)


def _followed(humanoid: HumanoidModel, motion: Motion, beyond: int) -> Followed:
    """Of the whole clip, and ``beyond`` frames of standing still after it; ``[1, T + beyond, ...]``."""
    qpos = np.concatenate([motion.qpos, np.repeat(motion.qpos[-1:], beyond, axis=0)])
    qvel = finite_difference(qpos, motion.fps)
    torques = with_forces(humanoid, Motion(motion.skeleton, _flat(humanoid, motion), motion.fps), _FORCES).torques
    assert torques is not None
    torques = np.concatenate([torques, np.repeat(torques[-1:], beyond, axis=0)])
    return Followed(qpos[None], qvel[None], feed_forward(humanoid, qpos, qvel, torques, 1.0)[None])


def _flat(humanoid: HumanoidModel, motion: Motion) -> Array:
    """``[T, nq]`` on a flat floor: what stands is at z = 0, so that inverse dynamics finds the floor."""
    lowest = sole_positions(humanoid, motion)[..., 2].min(axis=1)
    qpos = motion.qpos.copy()
    qpos[:, 2] -= gaussian_filter1d(lowest, 0.1 * motion.fps, mode="nearest") * (lowest > 0.1)
    return qpos


def _window(followed: Followed, at: int, horizon: int, count: int) -> Followed:
    """The frames from ``at`` on, the same for ``count`` bodies."""
    states, steps = slice(at, at + horizon + 1), slice(at, at + horizon)
    parts = (followed.qpos[:, states], followed.qvel[:, states], followed.ctrl[:, steps])
    return Followed(*(np.repeat(part, count, axis=0) for part in parts))
