"""Searching a motion that physics allows: it plays again to the bit, stands, and finds where a box is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.clip_folder import clip_folder

from egopose.checkpoint.pretrained import FOLDER
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.data.reference import reference_states
from egopose.envs.scene_ranges import SceneRanges
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.motion_cost import TERMS, CostWeights, MotionCost
from egopose.inference.reference_tracker import ReferenceTracker
from egopose.inference.sampled_motion import Found, FreeBoxes, MotionSampler, SamplingSettings
from egopose.inference.scene_motion import recovered
from egopose.pipeline.agent import Policy, load_policy
from egopose.scene.clip import Clip, box_poses, humanoid_in, read_clip, wanted_contacts
from egopose.scene.root import Support
from egopose.scene.scene_file import Box, Contact, Scene
from egopose.scene.standing import standing

FRAMES = 20


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_of(compose_config("reconstruct"))


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy(FOLDER / "tracker")


def settings(**more: object) -> SamplingSettings:
    values = compose_config("reconstruct")["sampling"]
    return SamplingSettings.from_config({**values, "samples": 24, "kept": 6, "passes": 2, "threads": 1, **more})


def sampler(
    clip: Clip, humanoid: HumanoidModel, policy: Policy, chosen: SamplingSettings, boxes: FreeBoxes | None = None
) -> MotionSampler:
    among = humanoid_in(clip.scene, humanoid)
    states = reference_states(humanoid, clip.body)
    reference = {name: states[name].numpy() for name in ("qpos", "qvel", "xpos")}
    cost = MotionCost(
        among, reference, wanted_contacts(clip.scene, humanoid, len(clip)), np.ones(len(clip)), chosen.cost
    )
    on = 0 if clip.scene.boxes else -1
    supports = (Support(0, 0, len(clip), 0.0), Support(1, 0, len(clip), 0.0))
    stands = standing(supports, [on, on], reference["xpos"][:, [1, 2], :2], len(clip), clip.body.fps)
    tops, headings = box_poses(clip.scene)
    none = np.zeros((len(tops), 4))
    sizes = np.array([box.size for box in clip.scene.boxes]).reshape(-1, 2)
    still = FreeBoxes(tops, headings, sizes, none, none, none, np.zeros(4), np.zeros(len(tops), dtype=np.int64))
    tracker = ReferenceTracker(policy, humanoid, reference["qpos"], reference["qvel"])
    start = reference["qpos"][0], reference["qvel"][0]
    return MotionSampler(among, tracker, stands, cost, boxes or still, chosen, *start)


def walk(folder: Path, scene: Scene | None = None) -> Clip:
    return read_clip(clip_folder(folder, scene, FRAMES))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory, humanoid: HumanoidModel, policy: Policy) -> tuple[Clip, Found]:
    clip = walk(tmp_path_factory.mktemp("walk"))
    search = sampler(clip, humanoid, policy, settings())
    out = search.search(range(2))
    search.close()
    return clip, out


def played(humanoid: HumanoidModel, found: Found) -> np.ndarray:
    """``[T, nq]``: the controls in physics again."""
    motion = found.motion
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps)
    physics.set_state([0], motion.qpos[:1], motion.qvel[:1])
    if len(motion.box_headings):
        physics.place_boxes([0], motion.box_tops[None], motion.box_headings[None])
    out = [physics.qpos[0].copy()]
    for ctrl in motion.ctrl:
        physics.step(ctrl[None])
        out.append(physics.qpos[0].copy())
    physics.close()
    return np.stack(out)


def test_what_is_found_plays_again_to_the_bit(humanoid: HumanoidModel, found: tuple[Clip, Found]) -> None:
    clip, out = found
    np.testing.assert_array_equal(played(humanoid_in(clip.scene, humanoid), out), out.motion.qpos)
    assert len(out.motion) == len(clip)


def test_a_walk_is_walked(found: tuple[Clip, Found]) -> None:
    clip, out = found
    off = out.motion.qpos - clip.body.qpos
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.2
    assert np.sqrt((off[:, 7:] ** 2).mean()) < 0.2
    assert out.cost.shape == (FRAMES - 1, len(TERMS))
    assert out.totals[0] == pytest.approx(out.cost.sum())


def test_a_second_pass_is_never_worse(tmp_path: Path, humanoid: HumanoidModel, policy: Policy) -> None:
    clip = walk(tmp_path)
    search = sampler(clip, humanoid, policy, settings())
    first, second = search.search(range(1)), search.search(range(1, 2))
    search.close()
    assert second.totals[0] <= first.totals[0] + 1e-9


def test_the_same_seed_finds_the_same(
    tmp_path: Path, humanoid: HumanoidModel, policy: Policy, found: tuple[Clip, Found]
) -> None:
    again = sampler(walk(tmp_path), humanoid, policy, settings(threads=2))
    np.testing.assert_array_equal(again.search(range(2)).motion.qpos, found[1].motion.qpos)
    again.close()


def test_a_box_under_the_walk_is_found_where_feet_say(tmp_path: Path, humanoid: HumanoidModel, policy: Policy) -> None:
    """The reference walks at height 0; boxes of 0 to 0.3 m are tried, and one near 0 moves it least."""
    touch = tuple(Contact(f"{side}_foot", "stage", 0, FRAMES - 1) for side in ("right", "left"))
    scene = Scene(boxes=(Box("stage", (6.0, 6.0), (1.0, 0.0), 0.15, 0.0, {"height": (-0.15, 0.15)}),), contacts=touch)
    clip = walk(tmp_path, scene)
    tops, headings = box_poses(scene)
    room = np.array([[0.0, 0.0, 0.15, 0.0]])
    boxes = FreeBoxes(
        tops, headings, np.array([[6.0, 6.0]]), -room, room, np.zeros((1, 4)), np.full(4, 0.15), np.array([0])
    )
    search = sampler(clip, humanoid, policy, settings(samples=32), boxes)
    out = search.search(range(2))
    search.close()
    assert out.motion.box_tops[0, 2] < 0.08
    np.testing.assert_array_equal(played(humanoid_in(scene, humanoid), out), out.motion.qpos)


def test_every_term_of_the_cost_is_zero_at_the_reference_and_not_beside_it(
    tmp_path: Path, humanoid: HumanoidModel
) -> None:
    clip = walk(tmp_path)
    among = humanoid_in(clip.scene, humanoid)
    states = reference_states(humanoid, clip.body)
    reference = {name: states[name].numpy() for name in ("qpos", "qvel", "xpos")}
    ones = CostWeights(**dict.fromkeys(TERMS, 1.0))
    cost = MotionCost(among, reference, wanted_contacts(clip.scene, humanoid, len(clip)), np.ones(len(clip)), ones)
    physics = BatchedPhysics(among.mj_model, 2, among.substeps, body_ids=among.body_ids, contacts=True, torques=True)
    qpos, qvel = np.tile(reference["qpos"][5], (2, 1)), np.tile(reference["qvel"][5], (2, 1))
    qpos[1, 7:] += 0.1
    qpos[1, 2] -= 0.3
    qvel[1] += 1.0
    physics.set_state(slice(None), qpos, qvel)
    terms = cost(5, physics, np.tile(reference["qvel"][5], (2, 1)), np.zeros((2, FRAMES, 3)))
    physics.close()
    told = dict(zip(TERMS, terms.T, strict=True))
    for name in ("joints", "bodies", "turn", "rates", "root", "low", "tremble"):
        assert told[name][0] == pytest.approx(0.0, abs=1e-12), name
    for name in ("joints", "bodies", "rates", "root", "low", "tremble"):
        assert told[name][1] > 1e-3, name
    assert told["joints"][1] == pytest.approx(0.01)
    assert told["root"][1] == pytest.approx(0.09)
    assert 0.1 < told["low"][1] < 0.4
    assert told["tremble"][1] == pytest.approx(1.0 / humanoid.control_dt**2)


@pytest.mark.parametrize(
    ("key", "value"), [("samples", 4), ("piece", 0), ("memory", 0.0), ("deviation", {"Tail": 0.1})]
)
def test_settings_that_cannot_be_are_refused(
    key: str, value: object, tmp_path: Path, humanoid: HumanoidModel, policy: Policy
) -> None:
    with pytest.raises(InputError, match="kept" if key == "samples" else key):
        sampler(walk(tmp_path), humanoid, policy, settings(**{key: value})).close()


def test_a_policy_that_follows_nothing_is_refused(tmp_path: Path, humanoid: HumanoidModel, policy: Policy) -> None:

    blind = replace(policy, config={**policy.config, "task": {}})
    with pytest.raises(InputError, match="ahead"):
        recovered(tmp_path, walk(tmp_path), humanoid, blind, settings(), False)


def test_boxes_of_the_worlds_move_as_those_of_a_scene_that_is_fitted() -> None:
    """Along the heading by x, across it by y; no face sinks into the floor."""
    tops, headings = np.array([[1.0, 2.0, 0.3], [0.0, 0.0, 0.1]]), np.array([np.pi / 2, 0.4])
    change = np.random.default_rng(0).uniform(-0.4, 0.4, (5, 2, 4))
    nothing = np.zeros((2, 4))
    boxes = FreeBoxes(tops, headings, np.ones((2, 2)), nothing, nothing, nothing, np.zeros(4), np.zeros(2, int))
    ranges = SceneRanges(*map(torch.from_numpy, (tops, headings, nothing, nothing)), 10.0)
    placed = boxes.placed(change)
    for one, other in zip(placed, ranges.changed(torch.from_numpy(change)), strict=True):
        np.testing.assert_array_equal(one, other.numpy())
    np.testing.assert_allclose(placed[0][:, 0, 0], 1.0 - change[:, 0, 1])
    np.testing.assert_allclose(placed[0][:, 0, 1], 2.0 + change[:, 0, 0])
    assert placed[0][..., 2].min() == 0.0
