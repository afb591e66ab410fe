"""Hands that hold: read off a scene's contacts, put onto boxes, and solved for with the feet."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.scene.footholds import on_footholds
from egopose.scene.handholds import Handhold, handholds, hands_of, held_places
from egopose.scene.scene_file import FLOOR, Box, Contact, Scene

BOX = Box("box", (0.4, 0.6), place=(1.0, 2.0), height=0.5, yaw=np.pi / 2, free={})
TOPS, HEADINGS, SIZES = np.array([[1.0, 2.0, 0.5]]), np.array([np.pi / 2]), np.array([[0.4, 0.6]])


def test_contacts_of_hands_are_handholds_and_those_of_feet_are_not() -> None:
    scene = Scene(
        boxes=(BOX,),
        contacts=(
            Contact("left_hand", "box", 3, 5),
            Contact("right_foot", "box", 0, 9),
            Contact("right_hand", FLOOR, 7, 7),
        ),
    )
    assert handholds(scene) == (Handhold(1, 3, 6, 0), Handhold(0, 7, 8, -1))


def test_the_middle_of_a_hand_is_its_capsules() -> None:
    humanoid, motion = default_humanoid(), walking("deepmimic_walk")
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    data.qpos[:] = motion.qpos[5]
    mujoco.mj_kinematics(model, data)
    hands = hands_of(humanoid)
    for number, name in enumerate(("RightHand", "LeftHand")):
        geom = model.body_geomadr[model.body(name).id]
        np.testing.assert_allclose(hands.points(motion)[5, number], data.geom_xpos[geom], atol=1e-6)
        assert model.geom_size[geom, 0] == hands.radius


def points_at(*places: tuple[float, float, float]) -> np.ndarray:
    """Both hands at each place, a frame each."""
    return np.repeat(np.array(places)[:, None], 2, axis=1)


def test_a_hand_beside_a_box_is_brought_over_it_and_onto_its_face() -> None:
    # The box is a quarter turned: along x it reaches .3 m from its middle, along y .2 m.
    points = points_at((1.5, 2.1, 0.8), (1.1, 2.1, 0.3))
    holds = [Handhold(0, 0, 1, 0), Handhold(1, 1, 2, 0), Handhold(0, 1, 2, -1)]
    found = held_places(holds, points, 0.03, TOPS, HEADINGS, SIZES)
    np.testing.assert_allclose(found, [[1.27, 2.1, 0.53], [1.1, 2.1, 0.53], [1.1, 2.1, 0.03]])


@pytest.mark.parametrize("hand", [0, 1])
def test_a_hand_that_holds_comes_to_its_place_and_the_other_stays(hand: int) -> None:
    humanoid, motion = default_humanoid(), walking("deepmimic_walk")
    hands = hands_of(humanoid)
    before = hands.points(motion)
    place = before[5:11, hand].mean(axis=0) + np.array([0.05, 0.0, 0.1])
    hold = (Handhold(hand, 5, 11, -1), place)
    trust = np.ones(len(motion))
    without, found = (hands.points(on_footholds(humanoid, motion, [], trust, holds=holds)) for holds in ((), (hold,)))
    away = [np.linalg.norm(points[7:9, hand] - place, axis=1).max() for points in (without, found)]
    assert away[1] < 0.6 * away[0]
    assert np.linalg.norm(found[7:9, 1 - hand] - without[7:9, 1 - hand], axis=1).max() < 0.05
