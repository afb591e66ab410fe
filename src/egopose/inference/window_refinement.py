"""A simulated motion that keeps close to its reference: Gauss-Newton on windows, with the tracker in the loop.

The tracker drives a body towards the reference and holds it loosely. Offsets to its PD targets are found that bring the
body nearer, for a window of frames ahead at a time. An offset is a line between knots. Each knot's is tried alone in a
world of its own, which gives the derivatives of all distances from the reference. Several step lengths are tried side
by side, the best one is kept, and the body takes some frames of it before the next window. The tracker reacts to what
offsets do, so bodies stay up and distances change smoothly with offsets: without it a contact that comes a frame later
made derivatives useless. A second sweep begins with the offsets of the first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.gauss_newton import (
    Distance,
    DistanceWeights,
    check_steps,
    knot_lines,
    single_changes,
    steps_of,
)
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.motion.rotations import Array
from egopose.scene.simulated import SimulatedMotion


@dataclass(frozen=True)
class RefinementWeights(DistanceWeights):
    """Weights of squares, of each frame.

    Args:
        offsets: 1/rad^2, of each offset.
        smooth: 1/rad^2, of each control's change from frame to frame.
        last: factor of a window's last frame, for what comes after it.
        value: cost of what the tracker's critic expects to be lost of the best reward after it.
    """

    offsets: float
    smooth: float
    last: float
    value: float


@dataclass(frozen=True)
class RefinementSettings:
    """``conf/reconstruct.yaml``, ``refinement``.

    Args:
        window: frames ahead.
        knots: frames between two knots.
        changed: frames of a window in which offsets have knots; the rest shows what comes of them.
        advance: frames that a body takes before the next window.
        iterations: of Gauss-Newton in a window.
        sweeps: over the clip.
        difference: rad, of a knot that is tried.
        reach: rad that a step may change an offset by.
        dampings: of the steps that are tried, 1/rad^2.
        threads: of the physics.
        weights: see :class:`RefinementWeights`.
    """

    window: int
    knots: int
    changed: int
    advance: int
    iterations: int
    sweeps: int
    difference: float
    reach: float
    dampings: tuple[float, ...]
    threads: int
    weights: RefinementWeights

    def __post_init__(self) -> None:
        for name in ("window", "knots", "changed", "advance", "iterations", "sweeps", "threads"):
            if getattr(self, name) < 1:
                raise InputError("refinement", name, "must be at least 1")
        for name, most in (("changed", "window"), ("advance", "changed")):
            if getattr(self, name) > getattr(self, most):
                raise InputError("refinement", name, f"{getattr(self, name)} frames are more than {most}")
        check_steps("refinement", self.difference, self.reach, self.dampings)

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/reconstruct.yaml") -> RefinementSettings:
        """Raises InputError: a value is missing, unknown or wrong."""
        weights = from_mapping(RefinementWeights, values["weights"], f"{source}: refinement.weights")
        return from_mapping(cls, {**values, "weights": weights}, f"{source}: refinement")


@dataclass(frozen=True)
class Reference:
    """What a body is brought near, in the world of its boxes.

    Args:
        qpos, qvel: ``[T, nq]``, ``[T, nv]``.
        trust: ``[T]`` how far each frame is to be believed, 0 to 1.
        box_tops, box_headings: ``[K, 3]`` m, ``[K]`` rad.
    """

    qpos: Array
    qvel: Array
    trust: Array
    box_tops: Array
    box_headings: Array


@dataclass(frozen=True)
class _Futures:
    """What n worlds did in a window: ``residuals [n, R]``, ``cost [n]``, ``qpos``, ``qvel``, ``ctrl [n, L, ...]``."""

    residuals: Array
    cost: Array
    qpos: Array
    qvel: Array
    ctrl: Array


class WindowRefiner:
    """Brings a body near a reference.

    Args:
        humanoid: among the boxes.
        tracker: drives the body towards the same reference.
        reference: see :class:`Reference`.
        settings: see :class:`RefinementSettings`.
    """

    def __init__(
        self, humanoid: HumanoidModel, tracker: ReferenceTracker, reference: Reference, settings: RefinementSettings
    ) -> None:
        self._humanoid, self._tracker, self._reference, self.settings = humanoid, tracker, reference, settings
        self._nu = humanoid.mj_model.nu
        knots = -(-settings.changed // settings.knots)
        count = max(1 + knots * self._nu, 1 + len(settings.dampings))
        self._physics = BatchedPhysics(
            humanoid.mj_model, count, humanoid.substeps, settings.threads, body_ids=humanoid.body_ids
        )
        if len(reference.box_headings):
            tops, headings = np.tile(reference.box_tops, (count, 1, 1)), np.tile(reference.box_headings, (count, 1))
            self._physics.place_boxes(np.arange(count), tops, headings)
        self._places = self._physics.poses(reference.qpos)["xpos"]
        self._distance = Distance(humanoid, settings.weights, self._places.shape[1])

    def close(self) -> None:
        """Stop the physics."""
        self._physics.close()

    def cost(self, motion: SimulatedMotion) -> float:
        """Of a motion: the mean over frames of what :meth:`refine` makes small; offsets and the critic left out."""
        total = 0.0
        for t in range(1, len(motion)):
            apart = self._apart(t, motion.qpos[t : t + 1], motion.qvel[t : t + 1], motion.qvel[t - 1 : t])
            total += float((apart**2).sum())
        return total / (len(motion) - 1)

    def refine(
        self, qpos: Array, qvel: Array, offsets: Array | None = None, advance: Callable[[int], None] = lambda _: None
    ) -> tuple[SimulatedMotion, Array]:
        """One sweep over the clip.

        Args:
            qpos, qvel: ``[nq]``, ``[nv]``, where the body begins.
            offsets: ``[T - 1, nu]`` rad to begin with; None for none.
            advance: told frames done.

        Returns:
            The motion, and its offsets ``[T - 1, nu]``.
        """
        settings, frames = self.settings, len(self._reference.qpos)
        offsets = np.zeros((frames - 1, self._nu)) if offsets is None else offsets.copy()
        positions, velocities = [qpos[None]], [qvel[None]]
        controls: list[Array] = []
        first = 0
        while first < frames - 1:
            length = min(settings.window, frames - 1 - first)
            span, before = slice(first, first + length), controls[-1][-1] if controls else None
            best, taken = self._window(first, positions[-1][-1], velocities[-1][-1], offsets[span], before)
            offsets[span] = taken
            # A body's last frames are those of its last window.
            done = length if first + length == frames - 1 else settings.advance
            positions.append(best.qpos[0, :done])
            velocities.append(best.qvel[0, :done])
            controls.append(best.ctrl[0, :done])
            first += done
            advance(done)
        reference = self._reference
        motion = SimulatedMotion(
            np.concatenate(positions),
            np.concatenate(velocities),
            np.concatenate(controls),
            reference.box_tops,
            reference.box_headings,
        )
        return motion, offsets

    def _window(
        self, first: int, qpos: Array, qvel: Array, offsets: Array, before: Array | None
    ) -> tuple[_Futures, Array]:
        """The best future of a window, and its offsets ``[L, nu]``."""
        settings = self.settings
        shape = knot_lines(len(offsets), settings.knots, min(settings.changed, len(offsets)))
        alone = single_changes(shape, self._nu, settings.difference)
        alone = np.concatenate([np.zeros((1, *offsets.shape)), alone])
        best = None
        for _ in range(settings.iterations):
            tried = self._simulate(first, qpos, qvel, offsets + alone, before)
            steps = steps_of(
                tried.residuals, np.isfinite(tried.cost), settings.difference, settings.dampings, settings.reach
            ).reshape(len(settings.dampings), len(shape), self._nu)
            changed = offsets + np.einsum("kl,nkj->nlj", shape, steps)
            changed = np.concatenate([offsets[None], changed])
            found = self._simulate(first, qpos, qvel, changed, before)
            pick = int(found.cost.argmin())
            best, offsets = _only(found, pick), changed[pick]
            if pick == 0:
                break
        assert best is not None
        return best, offsets

    def _simulate(self, first: int, qpos: Array, qvel: Array, offsets: Array, before: Array | None) -> _Futures:
        """Worlds that begin alike and differ in ``offsets [n, L, nu]``; ``before [nu]`` is the control a frame ago."""
        count, length = offsets.shape[:2]
        weights, physics, ends = self.settings.weights, self._physics, len(self._reference.qpos) - 1
        worlds = slice(0, count)
        physics.set_state(worlds, np.tile(qpos, (count, 1)), np.tile(qvel, (count, 1)))
        rows, positions, velocities, controls = [], [], [], []
        broken = np.zeros(count, dtype=bool)
        last = None if before is None else np.tile(before, (count, 1))
        for step in range(length):
            frame = first + step
            slower = physics.qvel[worlds].copy()
            ctrl = self._tracker.targets(frame, physics.qpos[worlds], physics.qvel[worlds]) + offsets[:, step]
            ctrl = np.clip(ctrl, *self._humanoid.joint_range.T)
            physics.begin_step(ctrl, worlds)
            broken |= physics.end_step(worlds)
            positions.append(physics.qpos[worlds].copy())
            velocities.append(physics.qvel[worlds].copy())
            controls.append(ctrl)
            apart = self._apart(frame + 1, positions[-1], velocities[-1], slower)
            more = weights.last if step == length - 1 and frame + 1 < ends else 1.0
            rows += [np.sqrt(more) * apart, np.sqrt(weights.offsets) * offsets[:, step]]
            if last is not None:
                led = self._reference.qpos[[frame, frame + 1], 7:]
                rows.append(np.sqrt(weights.smooth) * (ctrl - last - (led[1] - led[0])))
            last = ctrl
        residuals = np.concatenate(rows, axis=1)
        cost = (residuals**2).sum(axis=1)
        if first + length < ends:
            cost = cost + weights.value * self._tracker.shortfall(
                first + length, physics.qpos[worlds], physics.qvel[worlds]
            )
        cost = np.where(broken | ~np.isfinite(cost), np.inf, cost)
        return _Futures(residuals, cost, np.stack(positions, 1), np.stack(velocities, 1), np.stack(controls, 1))

    def _apart(self, frame: int, qpos: Array, qvel: Array, before: Array) -> Array:
        """``[n, R]`` weighted differences from ``frame``; ``before [n, nv]`` are the velocities a frame ago."""
        reference, trust = self._reference, np.sqrt(self._reference.trust[frame])
        wanted = np.broadcast_to(reference.qpos[frame], qpos.shape), np.broadcast_to(reference.qvel[frame], qvel.shape)
        state = self._distance.of_state(qpos, qvel, *wanted)
        places = self._distance.of_bodies(self._physics.poses(qpos)["xpos"], self._places[frame])
        change = self._distance.of_change((qvel - before) - (reference.qvel[frame] - reference.qvel[frame - 1]))
        return np.concatenate([trust * state, trust * places, change], axis=1)


def _only(futures: _Futures, world: int) -> _Futures:
    one = slice(world, world + 1)
    return _Futures(*(part[one] for part in vars(futures).values()))
