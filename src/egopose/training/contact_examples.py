"""What one example of training is to each kind of contact network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from egopose.motion.rotations import Array
from egopose.scene.contacts import ContactNetwork, contact_features, mirrored_features, without_last_movement
from egopose.scene.window_contacts import WindowNetwork, contact_windows, labels_of_windows, mirrored_windows

#: Frames of a piece of a clip. The network sees 16 to either side, so about half of them are near a cut, as at a
#: film's ends.
PIECE = 64
#: A shorter piece teaches nothing.
_SHORTEST = 9


@dataclass(frozen=True)
class Examples:
    """``inputs [N, ...]``, ``contacts [N, F, 2]`` as 0 and 1, and ``known [N, F, 2]``: 1 where there is a label."""

    inputs: Tensor
    contacts: Tensor
    known: Tensor


@dataclass(frozen=True)
class NetworkKind:
    """How a network is made and fed.

    Args:
        make: from widths, dropout and input noise.
        inputs: ``[T, C]`` from keypoints, confidence and camera.
        examples: from a clip's inputs, its contacts and which of them are known, ``[T, 2]`` each.
        mirrored: inputs of the mirror image, in which the feet change places.
    """

    make: Callable[[tuple[int, ...], float, float], ContactNetwork | WindowNetwork]
    inputs: Callable[[Array, Array, Array | None], np.ndarray]
    examples: Callable[[np.ndarray, np.ndarray, np.ndarray, np.random.Generator], Examples]
    mirrored: Callable[[Tensor], Tensor]


def pieces(features: np.ndarray, contacts: np.ndarray, known: np.ndarray, rng: np.random.Generator) -> Examples:
    """A clip's features ``[T, 36]``, cut at a drawn frame and then every :data:`PIECE` frames; 0 beyond a piece."""
    frames = len(features)
    first = int(rng.integers(1, PIECE + 1))
    cuts = [0, *range(first, frames, PIECE), frames] if frames > PIECE else [0, frames]
    inputs, labels, learned = [], [], []
    for start, stop in pairwise(cuts):
        if stop - start < min(_SHORTEST, frames):
            continue
        row, label, there = torch.zeros(PIECE, features.shape[1]), torch.zeros(PIECE, 2), torch.zeros(PIECE, 2)
        row[: stop - start] = without_last_movement(torch.from_numpy(features[start:stop]))
        label[: stop - start] = torch.from_numpy(contacts[start:stop]).float()
        there[: stop - start] = torch.from_numpy(known[start:stop]).float()
        inputs.append(row)
        labels.append(label)
        learned.append(there)
    return Examples(torch.stack(inputs), torch.stack(labels), torch.stack(learned))


def windows(rows: np.ndarray, contacts: np.ndarray, known: np.ndarray, rng: np.random.Generator) -> Examples:
    """Every window ``[T, 189]`` of a clip with its labels; nothing is drawn."""
    labels, learned = (torch.from_numpy(labels_of_windows(these)).float() for these in (contacts, known))
    return Examples(torch.from_numpy(rows), labels, learned)


def joined(rows: Sequence[Examples]) -> Examples:
    """One after the other."""
    inputs, contacts, known = (torch.cat([getattr(row, name) for row in rows]) for name in _FIELDS)
    return Examples(inputs, contacts, known)


_FIELDS = ("inputs", "contacts", "known")
#: The networks of ``conf/contacts.yaml``: this project's, and the paper's.
NETWORKS = {
    "temporal": NetworkKind(ContactNetwork, contact_features, pieces, mirrored_features),
    "windows": NetworkKind(WindowNetwork, contact_windows, windows, mirrored_windows),
}
