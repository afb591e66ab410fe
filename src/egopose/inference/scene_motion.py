"""From a prepared clip to a motion that physics allows: the sampler, set up with the clip's reference and scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.inference.motion_cost import MotionCost
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.sampled_motion import FreeBoxes, MotionSampler, SamplingSettings
from egopose.inference.scene_stages import sole_points, supports_of, trust_of
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Policy
from egopose.scene.clip import Clip, box_poses, humanoid_in, wanted_contacts
from egopose.scene.scene_file import FREE, Scene
from egopose.scene.standing import Standing, standing
from egopose.scene.supports import touched

#: Frames before a motion stands on a box, from which on the box matters to it: what the tracker sees ahead, and more.
_AHEAD = 12
#: m: a box this near to a part of the body may be touched.
_NEAR = 0.25


def motion_sampler(
    folder: Path, clip: Clip, humanoid: HumanoidModel, policy: Policy, settings: SamplingSettings, free: bool
) -> MotionSampler:
    """The sampler of a prepared clip.

    Args:
        folder: of the preparation.
        clip: read from it.
        humanoid: without boxes.
        policy: a tracker.
        settings: see :class:`SamplingSettings`.
        free: whether boxes may change within their ranges; else they stay at the scene's first guess.

    Raises:
        InputError: the policy follows no motion, or the clip stands on nothing.
    """
    if "ahead" not in policy.config["task"]:
        raise InputError(policy.path, "task.ahead", "this policy follows no motion: give a tracker's checkpoint")
    scene = clip.scene
    among = humanoid_in(scene, humanoid)
    states = reference_states(humanoid, clip.body)
    reference = {name: states[name].numpy() for name in ("qpos", "qvel", "xpos")}
    stands = standing_of(folder, clip, humanoid)
    cost = MotionCost(among, reference, wanted_contacts(scene, humanoid, len(clip)), trust_of(folder), settings.cost)
    tracker = ReferenceTracker(policy, humanoid, reference["qpos"], reference["qvel"])
    boxes = free_boxes(scene, stands, reference["xpos"], free)
    return MotionSampler(among, tracker, stands, cost, boxes, settings, reference["qpos"][0], reference["qvel"][0])


def standing_of(folder: Path, clip: Clip, humanoid: HumanoidModel) -> Standing:
    """What the clip's reference stands on.

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


def free_boxes(scene: Scene, stands: Standing, places: Array, free: bool) -> FreeBoxes:
    """The scene's boxes and what of them may change; ``places [T, B, 3]`` m are the reference's bodies."""
    tops, headings = box_poses(scene)
    ranges = np.array([[box.free.get(name, (0.0, 0.0)) for name in FREE] for box in scene.boxes]).reshape(-1, 4, 2)
    ranges = ranges if free else np.zeros_like(ranges)
    sizes = np.array([box.size for box in scene.boxes]).reshape(-1, 2)
    needed = np.array([_needed(k, tops, sizes, stands, places) for k in range(len(tops))], dtype=np.int64)
    return FreeBoxes(tops, headings, sizes, ranges[..., 0], ranges[..., 1], needed)


def _needed(box: int, tops: Array, sizes: Array, stands: Standing, places: Array) -> int:
    """The frame from which on the box may touch the body, or the body's way leads onto it."""
    on: NDArray[np.intp] = np.flatnonzero(stands.share[:, stands.box == box].sum(axis=1) > 0.01)
    reach = 0.5 * float(np.linalg.norm(sizes[box])) + _NEAR
    near = np.flatnonzero((np.linalg.norm(places[..., :2] - tops[box, :2], axis=2) < reach).any(axis=1))
    frames: Sequence[int] = [*(on - _AHEAD)[:1].tolist(), *near[:1].tolist(), len(places)]
    return max(min(frames), 0)
