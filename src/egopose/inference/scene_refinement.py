"""The motion that sampling found in a prepared clip, brought closer to the clip's reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.scene_motion import standing_of
from egopose.inference.scene_stages import trust_of
from egopose.inference.window_refinement import Reference, RefinementSettings, WindowRefiner
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Policy
from egopose.scene.clip import Clip, humanoid_in
from egopose.scene.simulated import SimulatedMotion, as_simulated


@dataclass(frozen=True)
class Refined:
    """A motion and :meth:`~egopose.inference.window_refinement.WindowRefiner.cost` of it, and of the one before."""

    motion: SimulatedMotion
    before: float
    after: float


def refined(
    folder: Path,
    clip: Clip,
    humanoid: HumanoidModel,
    policy: Policy,
    settings: RefinementSettings,
    found: SimulatedMotion,
    advance: Callable[[int], None] = lambda _: None,
) -> Refined:
    """The best of the motion that was found and of what refinement makes of it.

    The first sweep is made twice: with the offsets of ``found``, and with none. The better one is swept again.

    Args:
        folder: of the preparation.
        clip: read from it.
        humanoid: without boxes.
        policy: a tracker.
        settings: see :class:`~egopose.inference.window_refinement.RefinementSettings`.
        found: by sampling; its boxes stay where it has them.
        advance: told frames done, of ``(settings.sweeps + 1)`` times the clip's.
    """
    states = reference_states(humanoid, clip.body)
    qpos, qvel = states["qpos"].numpy(), states["qvel"].numpy()
    tracker = ReferenceTracker(policy, humanoid, qpos, qvel)
    reference = _reference(folder, clip, humanoid, found, qpos, qvel)
    refiner = WindowRefiner(humanoid_in(as_simulated(clip.scene, found), humanoid), tracker, reference, settings)
    before = refiner.cost(found)
    best = Refined(found, before, before)
    if settings.sweeps:
        swept = [
            refiner.refine(found.qpos[0], found.qvel[0], refiner.offsets_of(found), advance),
            refiner.refine(reference.qpos[0], qvel[0], None, advance),
        ]
        costs = [refiner.cost(motion) for motion, _ in swept]
        motion, offsets = swept[int(np.argmin(costs))]
        best = _better(best, motion, min(costs))
        for _ in range(settings.sweeps - 1):
            motion, offsets = refiner.refine(motion.qpos[0], motion.qvel[0], offsets, advance)
            best = _better(best, motion, refiner.cost(motion))
    refiner.close()
    return best


def _reference(
    folder: Path, clip: Clip, humanoid: HumanoidModel, found: SimulatedMotion, qpos: Array, qvel: Array
) -> Reference:
    """The clip's body moved to where the boxes are that sampling found."""
    stands = standing_of(folder, clip, humanoid)
    sizes = np.array([box.size for box in clip.scene.boxes]).reshape(-1, 2)
    moves = stands.moves(found.box_tops[None], found.box_headings[None], sizes)[0]
    moved = qpos.copy()
    moved[:, :3] += moves
    ground = stands.ground(found.box_tops[None])[0]
    return Reference(moved, qvel, moves, ground, trust_of(folder), found.box_tops, found.box_headings)


def _better(best: Refined, motion: SimulatedMotion, cost: float) -> Refined:
    return Refined(motion, best.before, cost) if cost < best.after else best
