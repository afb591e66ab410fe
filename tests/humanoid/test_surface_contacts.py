"""How deep bodies reach into the floor and boxes, by lowering a body into them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.jump import UPRIGHT, bare, jumping, scene_at
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.humanoid.replayed_forces import replay_forces
from egopose.humanoid.surface_contacts import depths
from egopose.scene.clip import box_poses, humanoid_in


@settings(deadline=None, max_examples=20)
@given(lift=st.floats(-0.03, 0.03), height=st.floats(0.1, 1.0), on=st.booleans())
def test_a_lowered_body_is_as_deep_as_it_was_lowered(lift: float, height: float, on: bool) -> None:
    humanoid = humanoid_in(scene_at(height), bare())
    qpos = humanoid.mj_model.qpos0.copy()[None]
    qpos[0, :3] = [0.0 if on else -2.0, 0.0, UPRIGHT + lift + (height if on else 0.0)]
    found = depths(humanoid, qpos, *box_poses(scene_at(height)))[0]
    feet = [humanoid.skeleton.index(f"{side}Foot") for side in ("Right", "Left")]
    others = np.delete(found, feet, axis=0)
    assert np.isnan(others).all()
    if lift > 1e-6:
        assert np.isnan(found).all()
    elif lift < -1e-6:
        assert found[feet, int(on)] == pytest.approx(-lift, abs=1e-6)
        assert np.isnan(np.delete(found, int(on), axis=1)).all()


def test_depths_are_those_of_the_replay() -> None:
    humanoid, motion = humanoid_in(scene_at(0.3), bare()), jumping()
    forces = replay_forces(humanoid, motion.qpos, motion.qvel, motion.ctrl, motion.box_tops, motion.box_headings)
    found = depths(humanoid, motion.qpos[:-1], motion.box_tops, motion.box_headings)
    np.testing.assert_allclose(found, forces.depth[:: humanoid.substeps], atol=1e-9)
