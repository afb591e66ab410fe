"""The contact network of Yu, Park & Lee 2021, section 4: what :mod:`egopose.scene.contacts` is measured against.

The network is Rempe et al.'s (2020): nine frames of seven joints in, the contacts of the five middle frames out. Every
frame is in five windows, and their answers are averaged. A camera's motion may be undone first; that is ours.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from egopose.motion.rotations import Array
from egopose.scene.contacts import FEET, LOWER_BODY, MIRROR, checked_keypoints

WINDOW, LABELS = 9, 5
INPUTS = WINDOW * len(LOWER_BODY) * 3
#: The furthest coordinate of a window is scaled to this.
_REACH = 0.8


class WindowNetwork(nn.Module):
    """189 -> 1024, 512, 128, 32 with batch norm -> contacts of both feet in five frames.

    Args:
        widths: of the hidden layers (the paper's).
        dropout: after each hidden layer.
        input_noise: standard deviation added to the input in training.
    """

    def __init__(
        self, widths: tuple[int, ...] = (1024, 512, 128, 32), dropout: float = 0.3, input_noise: float = 0.005
    ) -> None:
        super().__init__()
        self.input_noise = input_noise
        layers: list[nn.Module] = []
        size = INPUTS
        for width in widths:
            layers += [nn.Linear(size, width), nn.BatchNorm1d(width), nn.ReLU(), nn.Dropout(dropout)]
            size = width
        self.layers = nn.Sequential(*layers, nn.Linear(size, LABELS * len(FEET)))

    def forward(self, windows: Tensor) -> Tensor:
        """Logits ``[N, 5, 2]`` of windows ``[N, 189]``."""
        if self.training:
            windows = windows + self.input_noise * torch.randn_like(windows)
        out: Tensor = self.layers(windows).unflatten(-1, (LABELS, len(FEET)))
        return out

    def probabilities(self, keypoints: Array, confidence: Array, camera: Array | None = None) -> Array:
        """As :meth:`egopose.scene.contacts.ContactNetwork.probabilities`."""
        windows = torch.from_numpy(contact_windows(keypoints, confidence, camera))
        with torch.no_grad():
            answers = self(windows).sigmoid().double().numpy()
        return vote(answers)


def contact_windows(keypoints: Array, confidence: Array, camera: Array | None = None) -> np.ndarray:
    """The network's inputs.

    Each window is centred on the pelvis of its middle frame and scaled so that the furthest coordinate is 0.8. At a
    clip's ends the first and the last frame repeat. A joint of confidence 0 stands at the centre.

    Args:
        keypoints: ``[T, 7, 2]`` in the order of :data:`LOWER_BODY`, x right, y down, any unit.
        confidence: ``[T, 7]``, 0 for a joint that is not seen.
        camera: ``[T, 3, 3]``: takes each picture's homogeneous points into one common picture. None: not undone.

    Returns:
        ``[T, 189]`` float32.

    Raises:
        ValueError: the shapes do not agree, or a seen keypoint is not finite.
    """
    keypoints, seen = checked_keypoints(keypoints, confidence, camera)
    confidence, frames = np.asarray(confidence, dtype=np.float64), len(keypoints)
    index = np.clip(np.arange(frames)[:, None] + np.arange(WINDOW) - WINDOW // 2, 0, frames - 1)
    points, seen_there = keypoints[index], seen[index]
    if camera is not None:
        to_middle = np.linalg.inv(camera)[:, None] @ np.asarray(camera)[index]
        homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
        mapped = np.einsum("twij,twkj->twki", to_middle, homogeneous)
        points = mapped[..., :2] / mapped[..., 2:]
    middle, middle_seen = points[:, WINDOW // 2], seen_there[:, WINDOW // 2]
    # Without a pelvis the middle of what is seen stands in for it.
    mean = (middle * middle_seen[..., None]).sum(1) / np.maximum(middle_seen.sum(1), 1)[:, None]
    centre = np.where(middle_seen[:, :1], middle[:, 0], mean)
    points = np.where(seen_there[..., None], points - centre[:, None, None], 0.0)
    reach = np.abs(points).max(axis=(1, 2, 3))
    points *= (_REACH / np.where(reach > 0, reach, 1.0))[:, None, None, None]
    out = np.concatenate([points, confidence[index][..., None]], axis=-1)
    return out.reshape(frames, INPUTS).astype(np.float32)


def mirrored_windows(windows: Tensor) -> Tensor:
    """Windows ``[N, 189]`` of the mirror image, in which left and right change places."""
    out = windows.unflatten(-1, (WINDOW, len(LOWER_BODY), 3))[:, :, list(MIRROR)]
    return (out * out.new_tensor([-1.0, 1.0, 1.0])).flatten(1)


def labels_of_windows(contacts: np.ndarray) -> np.ndarray:
    """``[T, 5, 2]`` labels of every frame's window from contacts ``[T, 2]``; the clip's ends repeat."""
    frames = len(contacts)
    index = np.clip(np.arange(frames)[:, None] + np.arange(LABELS) - LABELS // 2, 0, frames - 1)
    return np.asarray(contacts[index])


def vote(answers: Array) -> Array:
    """``[T, 2]``: the mean of what the windows that hold a frame say of it.

    Args:
        answers: ``[T, 5, 2]`` probabilities; window t speaks of frames t - 2 to t + 2.
    """
    frames, half = len(answers), LABELS // 2
    total, count = np.zeros((frames, answers.shape[2])), np.zeros((frames, 1))
    for place in range(LABELS):
        shift = place - half
        window = np.arange(max(0, -shift), frames - max(0, shift))
        total[window + shift] += answers[window, place]
        count[window + shift] += 1
    return total / count
