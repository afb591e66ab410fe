"""Where a network errs: python experiments/contact_estimator/causes.py CMU_PEOPLE NETWORK; writes nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from table import CAMERAS, MOVING, test_clips

from egopose.checkpoint.contacts import load_contact_network
from egopose.motion.rotations import Array
from egopose.scene.contacts import ContactEstimator
from egopose.training.contact_clips import SeenClip
from egopose.training.contact_network import contact_accuracy, judging_views

_STARTS, _CUTS = 10, 4  # frames judged after a cut, cuts a clip


def frames_to_change(contacts: np.ndarray) -> Array:
    """``[T, 2]``: frames to the nearest other label of the same foot."""
    times = np.arange(len(contacts))
    out = np.full(contacts.shape, np.inf)
    for foot in range(contacts.shape[1]):
        for label in (False, True):
            other = np.flatnonzero(contacts[:, foot] != label)
            here = contacts[:, foot] == label
            if len(other):
                out[here, foot] = np.abs(times[here, None] - other).min(axis=1)
    return out


def part_of(seen: SeenClip, start: int) -> SeenClip:
    """The clip as if the film began at ``start``."""
    return SeenClip(
        *(getattr(seen, name)[start:] for name in ("keypoints", "confidence", "camera", "contacts", "doubtful"))
    )


def at_starts(network: ContactEstimator, views: Iterable[SeenClip]) -> tuple[float, float]:
    """Share right, %, in the first frames after a cut, and in the same frames of whole clips."""
    rng, cut, whole = np.random.default_rng(0), [], []
    for seen in views:
        right = contact_accuracy(network, seen, True)
        for _ in range(_CUTS):
            start = int(rng.integers(1, max(2, len(right) - _STARTS)))
            cut.append(contact_accuracy(network, part_of(seen, start), True)[:_STARTS])
            whole.append(right[start : start + _STARTS])
    return 100 * float(np.concatenate(cut).mean()), 100 * float(np.concatenate(whole).mean())


def main() -> None:
    """Print the figures, camera undone, moving cameras."""
    clips, settings = test_clips(Path(sys.argv[1]))
    network = load_contact_network(Path(sys.argv[2]))
    drawn = judging_views(clips, settings, CAMERAS)
    views = [seen for kind in MOVING for rows in drawn[kind].values() for seen in rows]
    right = np.concatenate([contact_accuracy(network, seen, True) for seen in views])
    away = np.concatenate([frames_to_change(seen.contacts) for seen in views])
    sure = ~np.concatenate([seen.doubtful for seen in views])
    labels = np.concatenate([seen.contacts for seen in views])
    wrong = right == 0
    print(f"right: {100 * right.mean():.1f} %")
    print(f"doubtful: {100 * (1 - sure.mean()):.1f} % of the frames; without them {100 * right[sure].mean():.1f} %")
    print(f"contacts missed {100 * (wrong & labels).mean():.1f} %, made up {100 * (wrong & ~labels).mean():.1f} %")
    for frames in range(1, 5):
        there = away == frames
        shares = [100 * share for share in (there.mean(), right[there].mean(), wrong[there].sum() / wrong.sum())]
        print(
            f"{frames} from a change: {shares[0]:.1f} % of frames, {shares[1]:.1f} % right, {shares[2]:.1f} % of errors"
        )
    far = away >= 5
    print(f"further: {100 * far.mean():.1f} % of the frames, right {100 * right[far].mean():.1f} %")
    print(
        "first {} frames after a cut {:.1f} %, in the whole clip {:.1f} %".format(_STARTS, *at_starts(network, views))
    )
    exact = judging_views(clips, replace(settings, error=(0.0, 0.0), dropped=0.0), CAMERAS)
    shares = [
        contact_accuracy(network, seen, True) for kind in MOVING for rows in exact[kind].values() for seen in rows
    ]
    print(f"exact keypoints: {100 * np.concatenate(shares).mean():.1f} %")


if __name__ == "__main__":
    main()
