"""What acts on a simulated body: its controls are played again, and MuJoCo's own forces are kept step by step.

Nothing is estimated here. Every control step starts from the saved state with a cold constraint solver, as in
:class:`egopose.humanoid.physics.BatchedPhysics`, and has to end in the next saved state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.surface_contacts import Met, Surfaces
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: rad, m and their rates: a replay that ends further off was made with another body, other boxes or other physics.
#: On one machine it is exact; another machine rounds otherwise, and each control step starts anew.
_TOLERANCE = 1e-5
#: m, m/s and rad/s: no simulated state is beyond it, see :class:`egopose.humanoid.physics.BatchedPhysics`.
_ABSURD = 1e3


@dataclass(frozen=True, eq=False)
class ReplayedForces:
    """Forces of every step of physics, ``N = (T - 1) substeps`` of them; row n holds from time ``n / rate`` on.

    Bodies are the skeleton's, in its order. Surfaces are the floor, then the K boxes. World axes, z up.

    Args:
        rate: steps of physics a second.
        substeps: steps of physics in a control step.
        mass: kg, of the body.
        gravity: m/s^2, positive.
        qpos: ``[N, nq]`` at the beginning of each step.
        places: ``[N, B, 3]`` m, the bodies' joints.
        com, com_velocity: ``[N, 3]`` m and m/s, centre of mass.
        force: ``[N, B, 1 + K, 3]`` N on each body from each surface.
        moment: ``[N, B, 1 + K, 3]`` N m of these forces about the world's origin.
        normal: ``[N, B, 1 + K]`` N, sum of the contacts' normal forces.
        pressure: ``[N, B, 1 + K, 3]`` N m: contact points times their normal forces, summed. Over ``normal`` it is the
            centre of pressure, on a box's side as on the floor.
        depth: ``[N, B, 1 + K]`` m that the body reaches into the surface; NaN where it does not touch it.
        torques: ``[N, nu]`` N m that the joints exert on the limbs. Stable PD (Tan et al. 2011, eqs. 9-11) counts the
            share of the armature that belongs to it as part of the controller; limits of joints are not in it.
        speeds: ``[N, nu]`` rad/s of the joints.
        drift: the largest difference between a replayed and a saved state.
    """

    rate: float
    substeps: int
    mass: float
    gravity: float
    qpos: Array
    places: Array
    com: Array
    com_velocity: Array
    force: Array
    moment: Array
    normal: Array
    pressure: Array
    depth: Array
    torques: Array
    speeds: Array
    drift: float

    def __len__(self) -> int:
        return len(self.com)

    @property
    def frames(self) -> int:
        """T, states of the simulated motion."""
        return len(self) // self.substeps + 1

    @property
    def weight(self) -> float:
        """N."""
        return self.mass * self.gravity

    @property
    def touching(self) -> NDArray[np.bool_]:
        """``[N, B, 1 + K]`` which bodies touch which surfaces."""
        return np.isfinite(self.depth)

    @property
    def power(self) -> Array:
        """``[N, nu]`` W, mechanical power of the joints: positive where they drive."""
        return self.torques * self.speeds

    @property
    def centre_of_pressure(self) -> Array:
        """``[N, B, 1 + K, 3]`` m; NaN where a surface does not push."""
        pushed = self.normal > 0
        return np.where(pushed[..., None], self.pressure / np.where(pushed, self.normal, 1.0)[..., None], np.nan)

    def per_frame(self, values: Array) -> Array:
        """``[T, ...]``: the mean of ``values [N, ...]`` over a control step's time around each frame.

        The first and the last frame have half of it.
        """
        ends = (window(t, self.substeps, len(self)) for t in range(self.frames))
        return np.stack([values[part].mean(axis=0) for part in ends])

    def any_at_frame(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """``[T, ...]``: whether one of ``flags [N, ...]`` is set in a control step's time around each frame."""
        ends = (window(t, self.substeps, len(self)) for t in range(self.frames))
        return np.stack([flags[part].any(axis=0) for part in ends])


def window(frame: int, substeps: int, count: int) -> slice:
    """The steps of physics, of ``count``, that lie within half a control step of a frame."""
    first, last = frame * substeps - substeps // 2, frame * substeps + (substeps + 1) // 2
    first = min(max(first, 0), count - 1)
    return slice(first, max(min(last, count), first + 1))


def replay_forces(
    humanoid: HumanoidModel, qpos: Array, qvel: Array, ctrl: Array, box_tops: Array, box_headings: Array
) -> ReplayedForces:
    """Play the controls again and keep what acts on the body.

    Args:
        humanoid: in a world with K boxes (:func:`egopose.humanoid.boxes.with_boxes`), at the simulation's rate.
        qpos, qvel: ``[T, nq]`` and ``[T, nv]``, the states at the control rate; at least two.
        ctrl: ``[T - 1, nu]`` rad, PD targets held from a frame to the next.
        box_tops: ``[K, 3]`` m, centres of the upper faces.
        box_headings: ``[K]`` rad.

    Raises:
        ValueError: shapes that do not fit the humanoid, a box that cannot be there, or a control step that does not
            end in the next state.
    """
    model = humanoid.mj_model
    _check(humanoid, qpos, qvel, ctrl)
    surfaces, data = Surfaces(humanoid), mujoco.MjData(model)
    surfaces.place(data, box_tops, box_headings)
    keep = _Recorder(humanoid, surfaces, (len(qpos) - 1) * humanoid.substeps)
    drift = 0.0
    for t in range(len(qpos) - 1):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[t], qvel[t], ctrl[t]
        data.qacc_warmstart[:] = 0.0
        for _ in range(humanoid.substeps):
            keep.before(data)
            mujoco.mj_step(model, data)
            keep.after(data)
        off = max(np.abs(data.qpos - qpos[t + 1]).max(), np.abs(data.qvel - qvel[t + 1]).max())
        if not off <= _TOLERANCE:
            cause = "made with another body, other boxes or another rate of physics"
            raise ValueError(f"the controls of frame {t} do not lead to frame {t + 1}: {off:.3g} off; {cause}")
        drift = max(drift, float(off))
    return keep.done(drift)


def with_replayed_forces(motion: Motion, humanoid: HumanoidModel, forces: ReplayedForces) -> Motion:
    """The simulated motion with ``torques``, ``ground_reaction`` and ``contacts`` of feet and of all that was pushed.

    Each frame has the mean over a control step's time around it. ``meta["forces"]`` says so.

    Args:
        motion: ``[T]`` the simulated states as a motion.
        humanoid: that was simulated.
        forces: of its replay.
    """
    touching = forces.any_at_frame(np.any(forces.touching, axis=2))
    return _carrying(motion, humanoid, forces, touching, forces.per_frame)


def every_step(humanoid: HumanoidModel, forces: ReplayedForces, name: str) -> Motion:
    """The simulated motion at every step of physics, ``[N]`` frames, each with the forces that act in that step.

    Args:
        humanoid: that was simulated.
        forces: of its replay.
        name: of the motion.
    """
    motion = Motion(humanoid.skeleton, forces.qpos, forces.rate, name=name)
    return _carrying(motion, humanoid, forces, np.any(forces.touching, axis=2), lambda values: values)


def _carrying(
    motion: Motion,
    humanoid: HumanoidModel,
    forces: ReplayedForces,
    touching: NDArray[np.bool_],
    at: Callable[[Array], Array],
) -> Motion:
    """``touching [T, B]``; ``at`` takes what is known of every step, ``[N, ...]``, to the motion's frames."""
    kept = np.union1d(humanoid.feet, np.flatnonzero(touching.any(axis=0)))
    summed = {name: getattr(forces, name)[:, kept].sum(axis=2) for name in ("force", "moment", "normal", "pressure")}
    mean = {name: at(values) for name, values in summed.items()}
    pushed = mean["normal"] > 0
    own = motion.forward_kinematics()[0][:, kept] * [1.0, 1.0, 0.0]
    centre = mean["pressure"] / np.where(pushed, mean["normal"], 1.0)[..., None]
    point = np.where(pushed[..., None], centre, own)
    names = tuple(humanoid.skeleton.names[body] for body in kept)
    moment = np.where(pushed[..., None], mean["moment"] - np.cross(point, mean["force"]), 0.0)
    return replace(
        motion,
        torques=at(forces.torques),
        ground_reaction=GroundReaction(names, mean["force"], point, moment),
        contacts=touching[:, kept],
        contact_names=names,
        meta={**motion.meta, "forces": {"method": "simulation", "physics_hz": forces.rate, "drift": forces.drift}},
    )


def _check(humanoid: HumanoidModel, qpos: Array, qvel: Array, ctrl: Array) -> None:
    model, frames = humanoid.mj_model, len(qpos)
    wanted = {"qpos": (frames, model.nq), "qvel": (frames, model.nv), "ctrl": (frames - 1, model.nu)}
    for (name, shape), array in zip(wanted.items(), (qpos, qvel, ctrl), strict=True):
        if array.shape != shape or frames < 2:
            raise ValueError(f"{name} is {list(array.shape)}; {list(shape)} fits this body, with at least two frames")
        # MuJoCo would write a file of warnings where the process stands.
        if not np.abs(array).max() < _ABSURD:
            raise ValueError(
                f"{name} is not finite or absurdly large in frame {int(np.argmax(np.abs(array).max(axis=1)))}"
            )


class _Recorder:
    """Arrays of :class:`ReplayedForces`, filled as physics goes on."""

    def __init__(self, humanoid: HumanoidModel, surfaces: Surfaces, count: int) -> None:
        model = self._model = humanoid.mj_model
        self._humanoid, self._surfaces, self._row = humanoid, surfaces, 0
        self._dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self._inertia = humanoid.kd * model.opt.timestep
        self._wrench = np.zeros(6)
        shapes: dict[str, tuple[int, ...]] = {"qpos": (model.nq,), "places": (surfaces.shape[0], 3), "com": (3,)}
        shapes |= {"com_velocity": (3,), "torques": (model.nu,), "speeds": (model.nu,)}
        shapes |= dict.fromkeys(("force", "moment", "pressure"), (*surfaces.shape, 3))
        shapes |= dict.fromkeys(("normal", "depth"), surfaces.shape)
        self._kept = {name: np.zeros((count, *shape)) for name, shape in shapes.items()}
        self._kept["depth"][:] = np.nan

    def before(self, data: mujoco.MjData) -> None:
        row = {name: values[self._row] for name, values in self._kept.items()}
        row["qpos"][:], row["speeds"][:] = data.qpos, data.qvel[self._dofs]

    def after(self, data: mujoco.MjData) -> None:
        """Positions and forces in ``data`` are those of the step's beginning."""
        row = {name: values[self._row] for name, values in self._kept.items()}
        root = int(self._humanoid.body_ids[0])
        mujoco.mj_subtreeVel(self._model, data)
        row["places"][:] = data.xpos[self._humanoid.body_ids]
        row["com"][:], row["com_velocity"][:] = data.subtree_com[root], data.subtree_linvel[root]
        row["torques"][:] = data.qfrc_actuator[self._dofs] - self._inertia * data.qacc[self._dofs]
        for met in self._surfaces.met(data):
            self._add(data, met, row)
        self._row += 1

    def _add(self, data: mujoco.MjData, met: Met, row: dict[str, Array]) -> None:
        at = met.body, met.surface
        mujoco.mj_contactForce(self._model, data, met.number, self._wrench)
        force, turning = met.sign * self._wrench[:3] @ met.axes, met.sign * self._wrench[3:] @ met.axes
        row["force"][at] += force
        row["moment"][at] += np.cross(met.place, force) + turning
        row["normal"][at] += self._wrench[0]
        row["pressure"][at] += self._wrench[0] * met.place
        row["depth"][at] = np.fmax(row["depth"][at], met.depth)

    def done(self, drift: float) -> ReplayedForces:
        model, humanoid = self._model, self._humanoid
        return ReplayedForces(
            rate=1.0 / model.opt.timestep,
            substeps=humanoid.substeps,
            mass=float(model.body_mass[humanoid.body_ids].sum()),
            gravity=-float(model.opt.gravity[2]),
            drift=drift,
            **self._kept,
        )
