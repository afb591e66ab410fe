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
from egopose.humanoid.physics import BatchedPhysics
from egopose.humanoid.trajectory import Followed, Nominal, TrackingCost, TrajectoryOptimiser, feed_forward
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array
from egopose.scene.clip import BODIES, box_poses
from egopose.scene.contacts import FEET
from egopose.scene.scene_file import FLOOR, Contact, Scene
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
            place=30.0, height=60.0, turn=60.0, linear=1.0, angular=0.5, joints=2.0, joint_rates=0.01, control=0.5, last=3.0
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


def touching(humanoid: HumanoidModel, simulated: SimulatedMotion) -> NDArray[np.bool_]:
    """``[T, B, 1 + K]``: which body touches the floor (first) and each box, by playing the motion again.

    The first frame is as the second.

    Raises:
        RuntimeError: the motion does not come back to the bit.
    """
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps, body_ids=humanoid.body_ids, contacts=True)
    physics.place_boxes([0], simulated.box_tops[None], simulated.box_headings[None])
    physics.set_state([0], simulated.qpos[:1], simulated.qvel[:1])
    rows = []
    for t, ctrl in enumerate(simulated.ctrl):
        physics.step(ctrl[None])
        if not np.array_equal(physics.qpos[0], simulated.qpos[t + 1]):
            raise RuntimeError(f"the simulation does not come back at frame {t + 1}")
        rows.append(np.concatenate([physics.floor_contacts[0][:, None], physics.box_contacts[0]], axis=1))
    physics.close()
    found = np.stack([rows[0], *rows])
    out = np.zeros((len(simulated), len(humanoid.skeleton.names), found.shape[2]), dtype=bool)
    out[:, humanoid.touching] = found
    return out


def true_contacts(
    humanoid: HumanoidModel, scene: Scene, found: NDArray[np.bool_], shortest: int = 2
) -> tuple[Contact, ...]:
    """Contacts of hands and feet from ``found [T, B, 1 + K]``; gaps and contacts of one frame are left out."""
    names = [FLOOR, *(box.name for box in scene.boxes)]
    out = []
    for effector, body in BODIES.items():
        rows = found[:, humanoid.skeleton.index(body)]
        for column, name in enumerate(names):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], rows[:, column].astype(np.int8), [0]])))
            runs = [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
            joined: list[tuple[int, int]] = []
            for first, last in runs:
                if joined and first - joined[-1][1] <= shortest:
                    joined[-1] = (joined[-1][0], last)
                else:
                    joined.append((first, last))
            out += [Contact(effector, name, a, b) for a, b in joined if b - a + 1 >= shortest]
    return tuple(sorted(out, key=lambda one: (one.first, one.effector)))


def feet_touching(humanoid: HumanoidModel, found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``[T, 2]``: right and left foot touch anything, of ``found [T, B, 1 + K]``."""
    rows = [humanoid.skeleton.index(BODIES[f"{side}_foot"]) for side in FEET]
    return np.asarray(found[:, rows].any(axis=2))
