"""What a user says of a true scene: boxes roughly, hands' contacts nearly, nothing of feet."""

from __future__ import annotations

import numpy as np

from egopose.benchmarks.scene_sight import guessed_scene
from egopose.scene.scene_file import Box, Contact, Scene

BOX = Box("box", (0.4, 0.6), place=(1.0, 2.0), height=0.5, yaw=0.0, free={})


def test_hands_are_told_nearly_and_feet_are_not() -> None:
    contacts = (
        Contact("right_foot", "box", 0, 60),
        Contact("left_hand", "box", 20, 24),
        Contact("left_hand", "box", 30, 33),
        Contact("left_hand", "floor", 35, 38),
        Contact("left_hand", "box", 59, 60),
    )
    told = [
        guessed_scene(Scene(boxes=(BOX,), contacts=contacts), "fixed", 0.0, np.zeros(2), np.random.default_rng(seed))
        for seed in range(20)
    ]
    ends = set()
    for scene in told:
        assert {contact.effector for contact in scene.contacts} == {"left_hand"}
        spans = {(c.touches, round(c.first / 30)): (c.first, c.last) for c in scene.contacts}
        # It lifts for five frames and still holds; half a second later it holds anew.
        for key, wanted in ((("box", 1), (20, 33)), (("floor", 1), (35, 38)), (("box", 2), (59, 60))):
            assert np.abs(np.subtract(spans[key], wanted)).max() <= 2
        assert all(0 <= c.first <= c.last <= 60 for c in scene.contacts)
        ends.add(spans["box", 1])
    assert len(ends) > 3
