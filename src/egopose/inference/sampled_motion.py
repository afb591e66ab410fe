"""A motion that a body can make, near one that a film shows: by sampling (Liu et al. 2010, SAMCON).

Hundreds of worlds simulate the clip side by side. The tracker drives every body towards the reference, and each world
adds offsets of its own to the PD targets. Every few frames the worlds whose bodies are best go on, in several copies,
and the others stop. The best world at the clip's end is the motion. It is found again from narrower offsets about those
of the best world, which itself stays in the race.

Boxes that are free in place or height differ from world to world, so the boxes with which bodies do best are found
likewise. A box is drawn anew for every copy until a body should come to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.envs.scene_ranges import moved_boxes
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.motion_cost import CostWeights, MotionCost
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.motion.rotations import Array
from egopose.scene.simulated import SimulatedMotion
from egopose.scene.standing import Standing

_BROKEN = 1e6  # cost of a world whose physics break


@dataclass(frozen=True)
class SamplingSettings:
    """``conf/reconstruct.yaml``, ``sampling``.

    Args:
        samples: worlds side by side.
        kept: of them that go on after each piece, in ``samples / kept`` copies.
        piece: frames between two choices.
        passes: over the clip; each begins with the offsets of the best world before it.
        deviation: rad, of the offsets of the first pass, by part of the body: joints whose name holds the key.
        narrowing: factor of the deviation from pass to pass.
        memory: s, in which a frame's cost counts 63 % less in the choice.
        value: cost, in the choice, of what the tracker's critic expects to be lost of the best reward.
        threads: of the physics.
        seed: of all draws.
        cost: see :class:`~egopose.inference.motion_cost.CostWeights`.
    """

    samples: int
    kept: int
    piece: int
    passes: int
    deviation: dict[str, float]
    narrowing: float
    memory: float
    value: float
    threads: int
    seed: int
    cost: CostWeights

    def __post_init__(self) -> None:
        if not 0 < self.kept <= self.samples:
            raise InputError("sampling", "kept", f"{self.kept} must lie between 1 and samples, {self.samples}")
        for name in ("piece", "passes", "threads"):
            if getattr(self, name) < 1:
                raise InputError("sampling", name, "must be at least 1")
        if not self.memory > 0:
            raise InputError("sampling", "memory", "must be positive, s")

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> SamplingSettings:
        """Raises InputError: a value is missing, unknown or wrong."""
        cost = from_mapping(CostWeights, values["cost"], "conf/reconstruct.yaml: sampling.cost")
        return from_mapping(cls, {**values, "cost": cost}, "conf/reconstruct.yaml: sampling")


@dataclass(frozen=True)
class FreeBoxes:
    """The boxes of the worlds.

    Args:
        tops: ``[K, 3]`` m, centres of the upper faces by the first guess.
        headings: ``[K]`` rad.
        sizes: ``[K, 2]`` m.
        low, high: ``[K, 4]`` the most they can change along and across their heading, in height (m) and yaw (rad).
        seen: ``[K, 4]`` the change that suits the reference, and ``spread [4]`` how far that may be off.
        needed: ``[K]`` the frame in which a body should come to each; before it a box is drawn anew again and again.
    """

    tops: Array
    headings: Array
    sizes: Array
    low: Array
    high: Array
    seen: Array
    spread: Array
    needed: NDArray[np.int64]

    def placed(self, change: Array) -> tuple[Array, Array]:
        """Tops ``[n, K, 3]`` and headings ``[n, K]`` of boxes changed by ``change [n, K, 4]``."""
        guess = torch.from_numpy(self.tops), torch.from_numpy(self.headings)
        tops, headings = moved_boxes(*guess, torch.from_numpy(change))
        return tops.numpy(), headings.numpy()

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """``[count, K, 4]`` changes about those that suit the reference, within their ranges."""
        return np.clip(self.seen + self.spread * rng.normal(size=(count, *self.low.shape)), self.low, self.high)


@dataclass(frozen=True)
class Found:
    """What sampling has found.

    Args:
        motion: the best world's.
        cost: ``[T - 1, C]`` of its frames, by the terms of :data:`egopose.inference.motion_cost.TERMS`.
        change: ``[K, 4]`` of its boxes.
        changes: ``[kept, K, 4]`` of the boxes of the worlds that were kept last, the best first.
        totals: ``[kept]`` their costs.
    """

    motion: SimulatedMotion
    cost: Array
    change: Array
    changes: Array
    totals: Array


class MotionSampler:
    """Searches a motion near a reference.

    Args:
        humanoid: among the boxes, with contact sensors on every body.
        tracker: of the reference.
        standing: of the reference.
        cost: of what bodies do.
        boxes: see :class:`FreeBoxes`.
        settings: see :class:`SamplingSettings`.
        qpos, qvel: ``[nq]``, ``[nv]``, where bodies begin, before they are moved to their boxes.
    """

    def __init__(
        self,
        humanoid: HumanoidModel,
        tracker: ReferenceTracker,
        standing: Standing,
        cost: MotionCost,
        boxes: FreeBoxes,
        settings: SamplingSettings,
        qpos: Array,
        qvel: Array,
    ) -> None:
        self._humanoid, self._tracker, self._standing, self._cost = humanoid, tracker, standing, cost
        self._boxes, self.settings, self._qpos, self._qvel = boxes, settings, qpos, qvel
        self._physics = BatchedPhysics(
            humanoid.mj_model,
            settings.samples,
            humanoid.substeps,
            settings.threads,
            body_ids=humanoid.body_ids,
            contacts=True,
            torques=True,
        )
        hinges = [joint.name for joint in humanoid.skeleton.joints for _ in joint.dofs]
        self._deviation = np.array(
            [next((d for part, d in settings.deviation.items() if part in name), 0.0) for name in hinges]
        )
        if not self._deviation.any():
            raise InputError("sampling", "deviation", "no key is part of a hinge's name")
        self._rng = np.random.default_rng(settings.seed)
        self._mean = np.zeros((-(-(len(tracker) - 1) // settings.piece), len(hinges)))
        self._change: Array | None = None

    def search(self, passes: range, advance: Callable[[int], None] = lambda _: None) -> Found:
        """The best motion of some passes, which go on from those before; ``advance`` is told frames done."""
        found = None
        for number in passes:
            found = self._pass(number, advance)
        assert found is not None
        return found

    def close(self) -> None:
        """Stop the physics."""
        self._physics.close()

    def _pass(self, number: int, advance: Callable[[int], None]) -> Found:
        """One pass about the offsets and boxes of the best world so far."""
        mean, best = self._mean, self._change
        deviation = self._deviation * self.settings.narrowing**number
        # Last with the boxes of the best world alone: only then does the motion play again to the bit.
        free = 0.0 if number and number == self.settings.passes - 1 else self.settings.narrowing ** (2 * number)
        settings, physics, boxes = self.settings, self._physics, self._boxes
        count, frames = settings.samples, len(self._tracker)
        ways = _Ways(count)
        change = self._draw(count, best, free)
        moves, ground, tops, headings = self._laid(change)
        qpos, qvel = np.tile(self._qpos, (count, 1)), np.tile(self._qvel, (count, 1))
        qpos[:, :3] += moves[:, 0]
        score, total, offset = np.zeros(count), np.zeros(count), np.zeros((count, len(deviation)))
        forget = np.exp(-self._humanoid.control_dt / settings.memory)
        self._put(qpos, qvel, tops, headings)
        for piece, first in enumerate(range(0, frames - 1, settings.piece)):
            last = min(first + settings.piece, frames - 1)
            aim = mean[piece] + deviation * self._rng.normal(size=offset.shape) * self._rng.random((count, 1))
            aim[0] = mean[piece]  # the best world of the pass before goes on as it was
            for frame in range(first, last):
                part = (frame - first + 1) / (last - first)
                ctrl = self._tracker.targets(frame, physics.qpos, physics.qvel, moves, ground)
                ctrl = np.clip(ctrl + (1 - part) * offset + part * aim, *self._humanoid.joint_range.T)
                before = physics.qvel.copy()
                broken = physics.step(ctrl)
                terms = self._cost(frame + 1, physics, before, moves)
                cost = terms.sum(axis=1) + _BROKEN * broken
                score, total = forget * score + cost, total + cost
                ways.add(physics.qpos, physics.qvel, ctrl, terms)
            ways.end_piece(aim)
            offset = aim
            advance(last - first)
            if last < frames - 1:
                state = physics.qpos, physics.qvel
                future = self._tracker.shortfall(last, *state, moves, ground)
                order = np.argsort(score + settings.value * future, kind="stable")[: settings.kept]
                parents = np.resize(order, count)
                parents[0] = 0  # see above
                ways.chosen(parents)
                waits = boxes.needed > last
                fresh = self._draw(count, best, free)
                change = np.where(waits[None, :, None], fresh, change[parents])
                if best is not None:
                    change[0] = best
                moves, ground, tops, headings = self._laid(change)
                score, total, offset = score[parents], total[parents], offset[parents]
                self._put(physics.qpos[parents], physics.qvel[parents], tops, headings)
        order = np.argsort(total, kind="stable")[: settings.kept]
        winner = int(order[0])
        (states, velocities, controls, terms, aims), ancestor = ways.of(winner)
        motion = SimulatedMotion(
            np.concatenate([qpos[ancestor, None], states]),
            np.concatenate([qvel[ancestor, None], velocities]),
            controls,
            tops[winner],
            headings[winner],
        )
        self._mean, self._change = aims, change[winner]
        return Found(motion, terms, change[winner], change[order], total[order])

    def _draw(self, count: int, best: Array | None, free: float) -> Array:
        """``[count, K, 4]`` changes of boxes: anywhere at first, then within ``free`` of the ranges about the best."""
        drawn = self._boxes.drawn(self._rng, count)
        if best is not None:
            drawn = best + free * (drawn - best)
            drawn[0] = best
        return drawn

    def _laid(self, change: Array) -> tuple[Array, Array, Array, Array]:
        tops, headings = self._boxes.placed(change)
        moves = self._standing.moves(tops, headings, self._boxes.sizes)
        return moves, self._standing.ground(tops), tops, headings

    def _put(self, qpos: Array, qvel: Array, tops: Array, headings: Array) -> None:
        worlds = np.arange(len(qpos))
        self._physics.set_state(worlds, qpos, qvel)
        if len(self._boxes.headings):
            self._physics.place_boxes(worlds, tops, headings)


class _Ways:
    """What the worlds did in each piece, and from which world each began it."""

    def __init__(self, count: int) -> None:
        self._now: list[tuple[Array, ...]] = []
        self._pieces: list[tuple[Array, ...]] = []
        self._parents: list[NDArray[np.int64]] = [np.arange(count)]

    def add(self, *parts: Array) -> None:
        """A frame of all worlds: arrays ``[N, ...]``."""
        self._now.append(tuple(part.copy() for part in parts))

    def end_piece(self, aim: Array) -> None:
        """The frames so far make up a piece, led to offsets ``aim [N, nu]``."""
        self._pieces.append((*(np.stack(column, axis=1) for column in zip(*self._now, strict=True)), aim.copy()))
        self._now = []

    def chosen(self, parents: NDArray[np.int64]) -> None:
        """The next piece of each world goes on from ``parents [N]``."""
        self._parents.append(parents.copy())

    def of(self, world: int) -> tuple[tuple[Array, ...], int]:
        """The way that led to ``world``: frames joined and offsets ``[P, nu]``; and the world in which it began."""
        rows, aims = [], []
        for piece, parents in zip(reversed(self._pieces), reversed(self._parents), strict=True):
            rows.append([part[world] for part in piece[:-1]])
            aims.append(piece[-1][world])
            world = int(parents[world])
        joined = [np.concatenate(column[::-1]) for column in zip(*rows, strict=True)]
        return (*joined, np.stack(aims[::-1])), world
