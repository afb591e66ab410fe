"""The up-hint tells of tilt and of nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.walking import walking

from egopose.motion import rotations as rot
from egopose.scene.up_hint import up_hint


def test_it_is_the_angle_by_which_a_body_was_tipped_over() -> None:
    motion = walking().slice(0, 4)
    upright = motion.qpos.copy()
    upright[:, 7:], upright[:, 3:7] = 0.0, [1.0, 0.0, 0.0, 0.0]
    tipped = upright.copy()
    tipped[:, 3:7] = rot.from_axis_angle(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.3, 1.6, 3.1]))
    straight = up_hint(replace(motion, qpos=upright))
    np.testing.assert_allclose(straight, 0.0, atol=1e-6)  # the default skeleton's head is right above its hips
    np.testing.assert_allclose(up_hint(replace(motion, qpos=tipped)), [0.0, 0.3, 1.6, 3.1], atol=1e-6)


def test_neither_place_nor_heading_matters() -> None:
    motion = walking()
    moved = motion.qpos.copy()
    moved[:, :3] += np.linspace(0, 5, len(moved))[:, None]
    turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.linspace(0, 3, len(moved)))
    moved[:, 3:7] = rot.multiply(turn, moved[:, 3:7])
    assert up_hint(replace(motion, qpos=moved)) == pytest.approx(up_hint(motion), abs=1e-9)
