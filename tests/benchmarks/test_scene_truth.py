"""Mocap lifted onto boxes, and tracked among them with its root."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.walking import walking

from egopose.benchmarks.scene_contacts import feet_touching, touching, true_contacts
from egopose.benchmarks.scene_truth import TruthSettings, track
from egopose.benchmarks.scene_warp import Platform, boxes_under, lifted, stances
from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.humanoid.foot_geometry import sole_edges, sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.motion import Motion
from egopose.scene.clip import humanoid_in
from egopose.scene.scene_file import Scene


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_of(compose_config("reconstruct"))


def walk(humanoid: HumanoidModel) -> Motion:
    return Motion(humanoid.skeleton, walking().qpos, 30.0)


def test_standing_feet_are_lifted_and_the_pelvis_follows(humanoid: HumanoidModel) -> None:
    motion = walk(humanoid)
    standing = stances(humanoid, motion)
    assert {s.limb for s in standing} == {0, 1}
    heights = [0.1 if k == len(standing) - 1 else 0.0 for k in range(len(standing))]
    up = lifted(humanoid, motion, standing, heights)
    raised = (sole_positions(humanoid, up) - sole_positions(humanoid, motion))[..., 2].reshape(len(motion), 2, 2)
    for stance, height in zip(standing, heights, strict=True):
        middle = raised[stance.start + 1 : stance.stop - 1, stance.limb]
        np.testing.assert_allclose(middle, height, atol=0.025)
    pelvis = up.qpos[:, 2] - motion.qpos[:, 2]
    assert pelvis.min() > -0.01
    assert pelvis.max() <= 0.1
    assert np.abs(np.diff(pelvis, n=2)).max() * 900 < 20  # m/s^2


def test_a_box_lies_under_all_soles_that_stand_on_it(humanoid: HumanoidModel) -> None:
    motion = walk(humanoid)
    standing = stances(humanoid, motion)
    platform = Platform("box", standing[-1].start, standing[-1].stop, 0.2, (0.05, 0.1), yaw=0.3, limb=standing[-1].limb)
    (box,) = boxes_under(humanoid, motion, standing, [platform])
    stance = standing[-1]
    corners = sole_edges(humanoid, motion).reshape(len(motion), 2, -1, 3)[stance.start : stance.stop, stance.limb]
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = (corners[..., :2] - box.place) @ np.array([[c, -s], [s, c]])
    assert (np.abs(local) <= 0.5 * np.array(box.size) - [0.04, 0.09]).all()
    with pytest.raises(ValueError, match="nothing stands"):
        boxes_under(humanoid, motion, standing, [Platform("none", 900, 910, 0.2, (0.0, 0.0))])


def test_a_body_that_nobody_stands_on_is_refused(humanoid: HumanoidModel) -> None:
    with pytest.raises(ValueError, match="nothing ever"):
        lifted(humanoid, walk(humanoid), [], [])


def test_tracking_stays_with_the_mocap_on_a_box(humanoid: HumanoidModel) -> None:
    """The walk's beginning on a box: simulated, within centimetres, and the box carries it."""
    motion = walk(humanoid).slice(0, 10)
    qpos = motion.qpos.copy()
    qpos[:, 2] += 0.3
    platform = Platform("box", 0, 9, 0.3, (0.3, 0.3))
    standing = stances(humanoid, motion, speed=10.0, lowness=None)
    scene = Scene(boxes=tuple(boxes_under(humanoid, motion, standing, [platform])))
    among = humanoid_in(scene, humanoid)
    simulated = track(
        among, scene, Motion(motion.skeleton, qpos, 30.0), TruthSettings(horizon=6, every=3, iterations=1)
    )
    assert len(simulated) == 10
    assert np.linalg.norm(simulated.qpos[:, :3] - qpos[:, :3], axis=1).max() < 0.05
    found = touching(among, simulated)
    assert not found[:, :, 0].any()
    assert feet_touching(among, found).any()
    assert {contact.touches for contact in true_contacts(among, scene, found)} == {"box"}


def test_short_gaps_and_contacts_are_noise(humanoid: HumanoidModel) -> None:
    found = np.zeros((20, len(humanoid.skeleton.names), 1), dtype=bool)
    foot = humanoid.skeleton.index("RightFoot")
    found[[2, 3, 4, 6, 7, 15], foot, 0] = True
    (contact,) = true_contacts(humanoid, Scene(), found)
    assert (contact.effector, contact.touches, contact.first, contact.last) == ("right_foot", "floor", 2, 7)
