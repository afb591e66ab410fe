"""From a prepared clip to a motion that physics allows: boxes where the feet say, then a body near its poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.scene_stages import sole_points, supports_of, trust_of
from egopose.inference.window_refinement import Reference, RefinementSettings, WindowRefiner
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Policy
from egopose.scene.clip import Clip, box_poses, humanoid_in
from egopose.scene.footholds import BoxTops, on_footholds
from egopose.scene.handholds import handholds, hands_of, held_places
from egopose.scene.scene_file import FREE, Box, Scene
from egopose.scene.simulated import SimulatedMotion
from egopose.scene.standing import Standing, in_box_axes, standing
from egopose.scene.supports import touched


@dataclass(frozen=True)
class Recovered:
    """What physics made of a clip.

    Args:
        motion: simulated.
        cost: of it, see :meth:`~egopose.inference.window_refinement.WindowRefiner.cost`, after each sweep.
    """

    motion: SimulatedMotion
    cost: tuple[float, ...]


def recovered(
    folder: Path,
    clip: Clip,
    humanoid: HumanoidModel,
    policy: Policy,
    settings: RefinementSettings,
    advance: Callable[[int], None] = lambda _: None,
) -> Recovered:
    """A motion near a prepared clip's that physics allows, among the boxes of its scene.

    The best of all sweeps is the motion.

    Args:
        folder: of the preparation.
        clip: read from it; its boxes stay where they are.
        humanoid: without boxes.
        policy: a tracker.
        settings: see :class:`~egopose.inference.window_refinement.RefinementSettings`.
        advance: told frames done, of ``settings.sweeps`` times the clip's.

    Raises:
        InputError: the policy follows no motion, or the clip stands on nothing.
    """
    if "ahead" not in policy.config["task"]:
        raise InputError(policy.path, "task.ahead", "this policy follows no motion: give a tracker's checkpoint")
    body, ground = among_boxes(folder, clip, humanoid)
    states = reference_states(humanoid, body)
    qpos, qvel = states["qpos"].numpy(), states["qvel"].numpy()
    reference = Reference(qpos, qvel, trust_of(folder), *box_poses(clip.scene))
    tracker = ReferenceTracker(policy, humanoid, qpos, qvel, ground)
    refiner = WindowRefiner(humanoid_in(clip.scene, humanoid), tracker, reference, settings)
    costs: list[float] = []
    best, offsets = None, None
    for _ in range(settings.sweeps):
        motion, offsets = refiner.refine(qpos[0], qvel[0], offsets, advance)
        costs.append(refiner.cost(motion))
        best = motion if best is None or costs[-1] < min(costs[:-1]) else best
    refiner.close()
    assert best is not None
    return Recovered(best, tuple(costs))


def among_boxes(folder: Path, clip: Clip, humanoid: HumanoidModel) -> tuple[Motion, Array]:
    """The clip's body among the boxes of its scene, and ``[T]`` m the height of what it stands on.

    Feet are on and over the boxes, and hands hold what the scene's contacts say.

    Raises:
        InputError: it stands on nothing.
    """
    stands, sizes = standing_of(folder, clip, humanoid), _sizes(clip.scene)
    tops, headings = box_poses(clip.scene)
    ground = stands.ground(tops[None])[0]
    held = handholds(clip.scene)
    if not len(tops) and not held:
        return clip.body, ground
    qpos = clip.body.qpos.copy()
    qpos[:, :3] += stands.moves(tops[None], headings[None], sizes)[0]
    pairs = zip(supports_of(folder), stands.surfaces(tops[None])[0].tolist(), strict=True)
    supports = [replace(support, height=height) for support, height in pairs]
    boxes, moved, hands = BoxTops(tops, headings, sizes), replace(clip.body, qpos=qpos), hands_of(humanoid)
    places = held_places(held, hands.points(moved), hands.radius, tops, headings, sizes)
    holds = tuple(zip(held, places, strict=True))
    return on_footholds(humanoid, moved, supports, trust_of(folder), boxes=boxes, holds=holds), ground


def fitted(folder: Path, clip: Clip, humanoid: HumanoidModel) -> Scene:
    """The scene with each box where the clip's feet stand on it, as far as the scene leaves it free.

    What may still change shrinks to what is left of it. A box on which no foot stands stays.

    Raises:
        InputError: the clip stands on nothing.
    """
    stands = standing_of(folder, clip, humanoid)
    tops, headings = box_poses(clip.scene)
    changes = [_suits(k, tops, headings, _sizes(clip.scene), stands) for k in range(len(tops))]
    return replace(clip.scene, boxes=tuple(map(_changed, clip.scene.boxes, changes)))


def standing_of(folder: Path, clip: Clip, humanoid: HumanoidModel) -> Standing:
    """What the clip's body stands on.

    Raises:
        InputError: it stands on nothing.
    """
    supports = supports_of(folder)
    if not supports:
        raise InputError(folder / "root.npz", "supports", "the body stands on nothing: say contacts in the scene file")
    names = [box.name for box in clip.scene.boxes]
    on = [names.index(what) if what in names else -1 for what in touched(clip.scene, supports)]
    feet = sole_points(humanoid, clip.body).mean(axis=2)[..., :2]
    return standing(supports, on, feet, len(clip), clip.body.fps)


def _sizes(scene: Scene) -> Array:
    return np.array([box.size for box in scene.boxes]).reshape(-1, 2)


def _suits(box: int, tops: Array, headings: Array, sizes: Array, stands: Standing) -> Array:
    """``[4]`` the change with which feet stand on the box; no further level than they must."""
    on = np.flatnonzero(stands.box == box)
    if not len(on):
        return np.zeros(4)
    moves = stands.moves_of_supports(tops[None], headings[None], sizes)[0, on].mean(axis=0)
    return -np.array([*in_box_axes(moves[:2], headings[box]), moves[2], 0.0])


def _changed(box: Box, wanted: Array) -> Box:
    change, left = dict.fromkeys(FREE, 0.0), {}
    for name, value in zip(FREE, wanted.tolist(), strict=True):
        if name in box.free:
            low, high = box.free[name]
            change[name] = min(max(value, low), high)
            left[name] = (min(low - change[name], 0.0), max(high - change[name], 0.0))
    assert box.place is not None
    assert box.height is not None
    assert box.yaw is not None
    along, across, up, turn = change.values()
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    x, y = box.place[0] + cos * along - sin * across, box.place[1] + sin * along + cos * across
    return replace(
        box,
        place=(round(x, 4), round(y, 4)),
        height=round(max(box.height + up, 0.0), 4),
        yaw=round(box.yaw + turn, 4),
        free=left,
    )
