"""What a recovered motion among boxes is off by, in cases worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.evaluation.scene_metrics import SceneMotion, aligned, box_errors, penetration, scene_figures
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.scene.scene_file import Box, Scene

BOXES = Scene(boxes=(Box("low", (0.4, 0.6), (1.0, 0.5), 0.3, 0.2), Box("high", (0.5, 0.5), (2.0, -0.5), 0.5, -0.3)))


def true_motion(scene: Scene = BOXES) -> SceneMotion:
    motion = walking()
    touching = np.zeros((len(motion), 2), dtype=bool)
    touching[::2, 0] = True
    return SceneMotion(Motion(motion.skeleton, motion.qpos, motion.fps), touching, scene)


def elsewhere(true: SceneMotion, turn: float, shift: tuple[float, float], up: float = 0.0) -> SceneMotion:
    """The same motion and boxes in a world that is turned by ``-turn`` and begins at another place."""
    about = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(-turn))
    qpos = true.motion.qpos.copy()
    qpos[:, :3] = rot.rotate(about, qpos[:, :3]) + np.array([*shift, up])
    qpos[:, 3:7] = rot.multiply(about, qpos[:, 3:7])
    c, s = np.cos(-turn), np.sin(-turn)
    boxes = []
    for box in true.scene.boxes:
        x, y = np.array([[c, -s], [s, c]]) @ box.place + shift
        boxes.append(replace(box, place=(float(x), float(y)), yaw=box.yaw - turn))
    motion = Motion(true.motion.skeleton, qpos, true.motion.fps)
    return SceneMotion(motion, true.touching, replace(true.scene, boxes=tuple(boxes)))


@settings(max_examples=10, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.booleans())
def test_another_world_changes_nothing(turn: float, x: float, y: float, known: bool) -> None:
    true = true_motion()
    figures = scene_figures(default_humanoid(), elsewhere(true, turn, (x, y)), true, turn if known else None)
    for name in ("mpjpe_mm", "w_mpjpe100_mm", "wa_mpjpe100_mm", "root_percent", "box_place_m", "box_height_m"):
        assert figures[name] == pytest.approx(0.0, abs=1e-6), name
    assert figures["success"] == figures["contact_accuracy"] == 1.0
    assert figures["boxes_missing"] == figures["boxes_invented"] == 0.0


def test_a_motion_too_high_is_off_by_that_in_every_frame() -> None:
    true = true_motion()
    figures = scene_figures(default_humanoid(), elsewhere(true, 0.0, (0.0, 0.0), up=0.2), true, 0.0)
    joints = true.motion.forward_kinematics()[0]
    path = np.linalg.norm(np.diff(joints[:, 0], axis=0), axis=1).sum()
    assert figures["root_furthest_m"] == pytest.approx(0.2)
    assert figures["root_percent"] == pytest.approx(100 * 0.2 / path)
    assert figures["mpjpe_mm"] == pytest.approx(0.0, abs=1e-6)
    assert figures["success"] == 1.0
    assert scene_figures(default_humanoid(), elsewhere(true, 0.0, (0.0, 0.0), up=0.51), true, 0.0)["success"] == 0.0


def test_a_motion_that_stands_still_is_off_by_the_way() -> None:
    true = true_motion()
    qpos = true.motion.qpos.copy()
    qpos[:, :2] = qpos[0, :2]
    found = replace(true, motion=replace(true.motion, qpos=qpos))
    figures = scene_figures(default_humanoid(), found, true, 0.0)
    way = np.linalg.norm(true.motion.qpos[-1, :2] - true.motion.qpos[0, :2])
    assert figures["root_furthest_m"] == pytest.approx(way, rel=0.02)
    assert figures["success"] == float(way <= 0.5)
    assert figures["mpjpe_mm"] == pytest.approx(0.0, abs=1e-6)
    assert figures["wa_mpjpe100_mm"] < figures["w_mpjpe100_mm"]


def test_contacts_count_by_foot_and_frame() -> None:
    true = true_motion()
    wrong = true.touching.copy()
    wrong[:, 1] = True
    figures = scene_figures(default_humanoid(), replace(true, touching=wrong), true, 0.0)
    assert figures["contact_accuracy"] == pytest.approx(0.5)


def test_boxes_of_one_name_belong_together_and_others_by_distance() -> None:
    moved = [replace(BOXES.boxes[0], place=(1.3, 0.9), height=0.1), replace(BOXES.boxes[1], name="box1")]
    errors = box_errors(Scene(boxes=tuple(moved)), BOXES, 0.0, np.zeros(2))
    assert errors["box_place_m"] == pytest.approx(0.25)
    assert errors["box_height_m"] == pytest.approx(0.1)
    assert errors["boxes_missing"] == errors["boxes_invented"] == 0.0


def test_boxes_far_away_are_others_and_those_without_a_place_none() -> None:
    far = Scene(boxes=(Box("somewhere", (0.5, 0.5), (9.0, 9.0), 0.4, 0.0), Box("nowhere", (0.5, 0.5))))
    errors = box_errors(far, BOXES, 0.0, np.zeros(2))
    assert np.isnan(errors["box_place_m"])
    assert errors["boxes_missing"] == 2.0
    assert errors["boxes_invented"] == 1.0


def test_penetration_is_the_shortest_way_out() -> None:
    scene = Scene(boxes=(Box("box", (1.0, 2.0), (0.0, 0.0), 0.5, np.pi / 2),))
    points = np.array(
        [
            [[0.0, 0.0, 0.45]],  # 5 cm under the upper face
            [[0.9, 0.0, 0.1]],  # 10 cm from the side: the box lies across, 2 m along x
            [[0.0, 0.6, 0.1]],  # beside it
            [[3.0, 0.0, -0.02]],  # in the floor
            [[0.0, 0.0, 0.6]],  # above
        ]
    )
    assert penetration(points, scene) == pytest.approx([0.05, 0.1, 0.0, 0.02, 0.0])


def test_headings_of_the_first_frames_stand_in_for_a_turn_that_is_not_known() -> None:
    true = true_motion()
    _, turn, _ = aligned(elsewhere(true, 3.1, (0.0, 0.0)).motion, true.motion)
    assert turn == pytest.approx(3.1, abs=1e-6)


def test_other_frames_rates_and_contacts_are_refused() -> None:
    true = true_motion()
    short = SceneMotion(true.motion.slice(0, 9), true.touching[:9], true.scene)
    with pytest.raises(ValueError, match="9 frames"):
        scene_figures(default_humanoid(), short, true)
    with pytest.raises(ValueError, match="touching"):
        SceneMotion(true.motion, true.touching[1:], true.scene)
