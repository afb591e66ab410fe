"""From a prepared clip to a motion that physics allows: the sampler, set up with the clip's reference and scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.humanoid.model import HumanoidModel
from egopose.inference.motion_cost import MotionCost
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.sampled_motion import Found, FreeBoxes, MotionSampler, SamplingSettings
from egopose.inference.scene_stages import sole_points, supports_of, trust_of
from egopose.motion.io._npz import read_arrays
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Policy
from egopose.scene.balance import lean, leaned
from egopose.scene.clip import Clip, box_poses, humanoid_in, wanted_contacts
from egopose.scene.footholds import on_footholds
from egopose.scene.scene_file import FREE, Scene
from egopose.scene.standing import Standing, standing
from egopose.scene.supports import touched

#: Frames before a motion stands on a box, from which on the box matters to it: what the tracker sees ahead, and more.
_AHEAD = 12
#: m and rad, that a box is off along, across, in height and yaw where feet tell of it: heights were 2 to 6 cm off.
_SPREAD = np.array([0.08, 0.08, 0.05, 0.1])
#: m: a box this near to a part of the body may be touched.
_NEAR = 0.25


def recovered(
    folder: Path,
    clip: Clip,
    humanoid: HumanoidModel,
    policy: Policy,
    settings: SamplingSettings,
    free: bool,
    advance: Callable[[int], None] = lambda _: None,
) -> Found:
    """A motion near a prepared clip's that physics allows, among its boxes.

    Two references are tried in the first pass: the poses as they are, and leaned until their feet carry them. The one
    whose bodies do better is searched further.

    Args:
        folder: of the preparation.
        clip: read from it.
        humanoid: without boxes.
        policy: a tracker.
        settings: see :class:`SamplingSettings`.
        free: whether boxes may change within their ranges; else they stay at the scene's first guess.
        advance: told frames done, of ``(settings.passes + 1)`` times the clip's.

    Raises:
        InputError: the policy follows no motion, or the clip stands on nothing.
    """
    if "ahead" not in policy.config["task"]:
        raise InputError(policy.path, "task.ahead", "this policy follows no motion: give a tracker's checkpoint")
    samplers = [
        _sampler(folder, replace(clip, body=body), humanoid, policy, settings, free)
        for body in (clip.body, _leaned(folder, clip, humanoid))
    ]
    found = [sampler.search(range(1), advance) for sampler in samplers]
    best = int(np.argmin([one.totals[0] for one in found]))
    out = found[best]
    if settings.passes > 1:
        out = samplers[best].search(range(1, settings.passes), advance)
    for sampler in samplers:
        sampler.close()
    return out


def _sampler(
    folder: Path, clip: Clip, humanoid: HumanoidModel, policy: Policy, settings: SamplingSettings, free: bool
) -> MotionSampler:
    among = humanoid_in(clip.scene, humanoid)
    states = reference_states(humanoid, clip.body)
    reference = {name: states[name].numpy() for name in ("qpos", "qvel", "xpos")}
    stands = standing_of(folder, clip, humanoid)
    wanted = wanted_contacts(clip.scene, humanoid, len(clip))
    cost = MotionCost(among, reference, wanted, trust_of(folder), settings.cost)
    tracker = ReferenceTracker(policy, humanoid, reference["qpos"], reference["qvel"])
    boxes = free_boxes(clip.scene, stands, reference["xpos"], free)
    return MotionSampler(among, tracker, stands, cost, boxes, settings, reference["qpos"][0], reference["qvel"][0])


def _leaned(folder: Path, clip: Clip, humanoid: HumanoidModel) -> Motion:
    """The clip's body turned about its feet until they carry it."""
    feet, com = sole_points(humanoid, clip.body).mean(axis=2), reference_states(humanoid, clip.body)["com"].numpy()
    sight = read_arrays(folder / "orientation.npz", ("to_world",))["to_world"][:, :, 2]
    flight = read_arrays(folder / "root.npz", ("flight",))["flight"].astype(bool)
    # Where contacts were missed, the lower foot carries.
    lower = np.arange(feet.shape[1]) == feet[..., 2].argmin(axis=1)[:, None]
    stands = clip.touching | (lower & ~clip.touching.any(axis=1, keepdims=True) & ~flight[:, None])
    turn = lean(feet, stands, com, sight, clip.body.fps)
    pivot = (stands[..., None] * feet).sum(axis=1) / np.maximum(stands.sum(axis=1), 1)[:, None]
    pivot = np.where(stands.any(axis=1)[:, None], pivot, feet.mean(axis=1))
    body = replace(clip.body, qpos=leaned(clip.body.qpos, turn, pivot))
    return on_footholds(humanoid, body, supports_of(folder), trust_of(folder))


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
    seen = np.array([_suits(k, tops, headings, sizes, stands) for k in range(len(tops))]).reshape(-1, 4)
    low, high = ranges[..., 0], ranges[..., 1]
    return FreeBoxes(tops, headings, sizes, low, high, np.clip(seen, low, high), _SPREAD, needed)


def _suits(box: int, tops: Array, headings: Array, sizes: Array, stands: Standing) -> Array:
    """``[4]`` the change with which the reference's feet stand on the box; no further level than they must."""
    on = np.flatnonzero(stands.box == box)
    if not len(on):
        return np.zeros(4)
    moves = stands.moves_of_supports(tops[None], headings[None], sizes)[0, on].mean(axis=0)
    cos, sin = np.cos(headings[box]), np.sin(headings[box])
    return -np.array([cos * moves[0] + sin * moves[1], cos * moves[1] - sin * moves[0], moves[2], 0.0])


def _needed(box: int, tops: Array, sizes: Array, stands: Standing, places: Array) -> int:
    """The frame from which on the box may touch the body, or the body's way leads onto it."""
    on: NDArray[np.intp] = np.flatnonzero(stands.share[:, stands.box == box].sum(axis=1) > 0.01)
    reach = 0.5 * float(np.linalg.norm(sizes[box])) + _NEAR
    near = np.flatnonzero((np.linalg.norm(places[..., :2] - tops[box, :2], axis=2) < reach).any(axis=1))
    frames: Sequence[int] = [*(on - _AHEAD)[:1].tolist(), *near[:1].tolist(), len(places)]
    return max(min(frames), 0)
