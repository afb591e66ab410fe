"""Boxes come where feet stand on them, and the body comes with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.clip_folder import clip_folder

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.humanoid.foot_geometry import sole_edges
from egopose.humanoid.model import HumanoidModel
from egopose.inference import scene_motion
from egopose.inference.scene_motion import among_boxes, fitted
from egopose.motion.contacts import runs_of
from egopose.scene.clip import Clip, read_clip
from egopose.scene.handholds import hands_of
from egopose.scene.root import Support
from egopose.scene.scene_file import Box, Contact, Scene, read_scene, write_scene

FRAMES = 24
#: The walk is at height 0; the stage is said to be 0.1 m high and may be 0.15 m lower or higher.
STAGE = Box("stage", (6.0, 6.0), (1.0, 0.0), 0.1, 0.0, {"height": (-0.15, 0.15), "along": (-0.3, 0.3)})
CONTACTS = tuple(Contact(f"{side}_foot", "stage", 0, FRAMES - 1) for side in ("right", "left"))


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_of(compose_config("reconstruct"))


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Clip:
    clip = read_clip(clip_folder(tmp_path, Scene(boxes=(STAGE,), contacts=CONTACTS), FRAMES))
    runs = [(foot, *run) for foot in (0, 1) for run in runs_of(clip.touching[:, foot])]
    supports = [Support(foot, start, stop, 0.0) for foot, start, stop in sorted(runs, key=lambda run: run[1])]
    monkeypatch.setattr(scene_motion, "supports_of", lambda folder: supports)
    monkeypatch.setattr(scene_motion, "trust_of", lambda folder: np.ones(FRAMES))
    return clip


def test_a_box_comes_to_the_height_at_which_feet_stand_and_stays_in_a_file(
    tmp_path: Path, walk: Clip, humanoid: HumanoidModel
) -> None:
    scene = fitted(tmp_path, walk, humanoid)
    assert scene.boxes[0].height == pytest.approx(0.0, abs=1e-3)
    assert scene.boxes[0].place == STAGE.place  # the feet are well inside: its place says nothing
    assert scene.boxes[0].free["height"] == pytest.approx((-0.05, 0.25), abs=1e-3)
    write_scene(scene, tmp_path / "fitted.yaml")
    assert read_scene(tmp_path / "fitted.yaml").boxes == scene.boxes


def test_a_box_changes_no_further_than_it_is_free(tmp_path: Path, walk: Clip, humanoid: HumanoidModel) -> None:
    firm = replace(STAGE, free={"height": (-0.04, 0.04)})
    scene = fitted(tmp_path, replace(walk, scene=replace(walk.scene, boxes=(firm,))), humanoid)
    assert scene.boxes[0].height == pytest.approx(0.06)


def test_the_body_stands_on_the_boxes_of_its_scene(tmp_path: Path, walk: Clip, humanoid: HumanoidModel) -> None:
    body, ground = among_boxes(tmp_path, walk, humanoid)
    np.testing.assert_allclose(ground, 0.1)
    lowest = sole_edges(humanoid, body)[..., 2].min(axis=1)
    assert lowest.min() > 0.08
    np.testing.assert_allclose(body.qpos[:, 2].mean(), walk.body.qpos[:, 2].mean() + 0.1, atol=0.03)


def test_a_hand_that_leans_on_a_box_comes_nearer_to_it(tmp_path: Path, walk: Clip, humanoid: HumanoidModel) -> None:
    hands = hands_of(humanoid)
    where = hands.points(walk.body)[8:16, 1].mean(axis=0)
    table = Box("table", (0.6, 0.6), (float(where[0]), float(where[1])), float(where[2]) - 0.15, 0.0, {})
    scene = replace(walk.scene, boxes=(replace(STAGE, height=0.0), table))
    leans = replace(scene, contacts=(*scene.contacts, Contact("left_hand", "table", 8, 15)))
    over = [
        hands.points(among_boxes(tmp_path, replace(walk, scene=one), humanoid)[0])[10:14, 1, 2] - table.height
        for one in (scene, leans)
    ]
    assert over[0].min() > 0.1
    assert (over[1] < over[0] - 0.02).all()
    assert (over[1] > hands.radius).all()
