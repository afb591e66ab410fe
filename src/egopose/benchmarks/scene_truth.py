"""True motions among boxes: motion capture tracked *with* its root by iterative LQR in the simulator.

What comes out is simulated: its contacts, its forces and its boxes are exact. It is the truth that a reconstruction,
which never sees the root, is judged by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.humanoid.derivatives import Simulator, Single, state_difference
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.trajectory import Followed, Nominal, TrackingCost, TrajectoryOptimiser, feed_forward
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
        horizon, every: frames ahead, and between plans.
        iterations: of iterative LQR at each plan.
        reach: rad that a control may differ from the feed-forward.
        cost: against the mocap's root, joints and velocities.
    """

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


def track(
    humanoid: HumanoidModel, scene: Scene, motion: Motion, settings: TruthSettings, threads: int = 1
) -> SimulatedMotion:
    """The motion as the simulated body can make it.

    Args:
        humanoid: in the scene's worlds, see :func:`egopose.scene.clip.humanoid_in`.
        scene: its boxes.
        motion: to be followed, ``T`` frames at the control rate.
        settings: see :class:`TruthSettings`.
        threads: of the physics.
    """
    tops, headings = box_poses(scene)
    simulator = Simulator(humanoid, _WORLDS, threads)
    simulator.place_boxes(tops, headings)
    optimiser = TrajectoryOptimiser(simulator, settings.cost, reach=settings.reach)
    followed = _followed(humanoid, motion, settings.horizon)
    qpos, qvel = followed.qpos[:, 0], followed.qvel[:, 0]
    states, controls = [(qpos[0], qvel[0])], []
    plan: Nominal | None = None
    gains: Single = np.zeros(0, dtype=np.float32)
    for at in range(0, len(motion) - 1, settings.every):
        ahead = _window(followed, at, settings.horizon)
        nominal = optimiser.simulate(qpos, qvel, ahead)
        if plan is not None:
            by = settings.every
            kept = settings.horizon - by
            older = Nominal(
                np.concatenate([plan.qpos[:, by:-1], ahead.qpos[:, kept:]], axis=1),
                np.concatenate([plan.qvel[:, by:-1], ahead.qvel[:, kept:]], axis=1),
                np.concatenate([plan.ctrl[:, by:], ahead.ctrl[:, kept:]], axis=1),
                plan.cost,
            )
            later = np.concatenate([gains[:, by:], 0 * gains[:, :by]], axis=1)
            nominal = nominal.chosen(optimiser.simulate(qpos, qvel, ahead, older, gains=later))
        for _ in range(settings.iterations):
            plan, gains = optimiser.improve(nominal, ahead)
            if plan.cost[0] >= nominal.cost[0]:
                break
            nominal = plan
        assert plan is not None
        for step in range(min(settings.every, len(motion) - 1 - at)):
            away = state_difference(qpos, qvel, plan.qpos[:, step], plan.qvel[:, step])
            ctrl = plan.ctrl[:, step] + np.einsum("nij,nj->ni", gains[:, step], away)
            qpos, qvel = simulator.step(qpos, qvel, ctrl)
            states.append((qpos[0], qvel[0]))
            controls.append(ctrl[0])
    simulator.close()
    return SimulatedMotion(
        np.array([q for q, _ in states]), np.array([v for _, v in states]), np.array(controls), tops, headings
    )


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


def _window(followed: Followed, at: int, horizon: int) -> Followed:
    states, steps = slice(at, at + horizon + 1), slice(at, at + horizon)
    return Followed(followed.qpos[:, states], followed.qvel[:, states], followed.ctrl[:, steps])
