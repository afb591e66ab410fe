"""What a regressor of head signals reads: bounded, with the mount, and mirrored as the motion is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.seen_ground import any_path

from egopose.models.head_signal_input import SIGNAL_FEATURES, mirrored_features, signal_features
from egopose.vision.head_signal import HeadSignal, signal_of_motion
from egopose.vision.mounts import MOUNTS


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_mirrored_motion_has_the_mirrored_features(mount: str) -> None:
    positions, rotations = any_path(0, 60, 30.0, 0.4)
    own = signal_features(signal_of_motion(positions, rotations, 30.0), mount)
    flip, camera = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, 1.0])
    other = signal_features(signal_of_motion(positions @ flip, flip @ rotations @ camera, 30.0), mount)
    torch.testing.assert_close(mirrored_features(own), other, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(own, other, atol=1e-2)
    torch.testing.assert_close(mirrored_features(mirrored_features(own)), own)


def test_numbers_that_are_no_persons_are_bounded_and_the_mount_is_told() -> None:
    wild = HeadSignal(np.full((4, 3), 1e6), np.full((4, 3), -1e6), np.full((4, 2), 9.0), np.ones((4, 3)))
    features = signal_features(wild, "chest")
    assert features.shape == (4, SIGNAL_FEATURES)
    assert features.abs().max() <= 12.0
    assert features[:, -len(MOUNTS) :].tolist() == [[0.0, 1.0, 0.0]] * 4
