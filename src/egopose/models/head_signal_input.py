"""What a regressor of head signals reads of a frame: the signal, and how the camera is worn."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from egopose.vision.head_signal import SIGNAL_NUMBERS, HeadSignal
from egopose.vision.mounts import MOUNTS

#: Numbers of a frame.
SIGNAL_FEATURES = SIGNAL_NUMBERS + len(MOUNTS)
# Signs of the mirror image of turning (ahead, left, up), velocity, tilt (pitch, roll), quality and mounts.
_MIRROR = torch.tensor([-1.0, 1, -1, 1, -1, 1, 1, -1, 1, 1] + [1.0] * len(MOUNTS))
#: rad/s and heights/s beyond which a number is no person's.
_MOST = torch.tensor([12.0] * 3 + [4.0] * 3 + [3.2] * 2 + [1.0] * 2)


def signal_features(signal: HeadSignal, mount: str) -> Tensor:
    """``[T, SIGNAL_FEATURES]`` float32 of a signal and the mount's name."""
    worn = np.zeros((len(signal), len(MOUNTS)))
    worn[:, MOUNTS.index(mount)] = 1.0
    numbers = torch.from_numpy(signal.numbers()).float()
    bounded = torch.minimum(torch.maximum(numbers, -_MOST), _MOST)
    return torch.cat([bounded, torch.from_numpy(worn).float()], dim=1)


def mirrored_features(features: Tensor) -> Tensor:
    """The mirror image of features ``[..., SIGNAL_FEATURES]``."""
    return features * _MIRROR
