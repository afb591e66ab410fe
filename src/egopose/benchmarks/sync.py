"""How well the sync offset is found: pieces of the motions looked for in their rendered videos, and in each other's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import prepare
from egopose.data.prepare_motion import without_lead_in
from egopose.data.source_reading import read_source
from egopose.data.sync_offset import find_offset, head_turning, settings_of, video_turning
from egopose.data.take_sources import find_sources
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera

# Pieces are as long as this (s), or this share of a shorter clip.
_LONGEST, _SHARE = 10.0, 0.7


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Table of errors.

    Args:
        overrides: of the training configuration; its data is rendered where it is not yet.
        rounds: pieces a clip, with beginnings between the video's frames.

    Returns:
        ``clips``: one row a clip: ``seconds`` of a piece, ``worst`` and ``median`` error in video frames over the
        pieces that were accepted, ``confidence`` (least), ``refused``; ``worst_frames``, ``median_frames`` and
        ``refused`` of all; ``wrong_pairs`` and ``wrong_accepted``: pieces looked for in another clip's video.
    """
    config = compose_config("train", overrides)
    settings = settings_of(compose_config("sync", ["video=none", "motion=none"])["data"])
    store = prepare(config, flow=False)
    store = prepare(config) if any(not store.video(i).is_file() for i in range(len(store.takes))) else store
    flow, rng = FlowConfig(**config["vision"]["flow"]), np.random.default_rng(0)
    motions = {s.name: without_lead_in(read_source(s)) for s in find_sources(config["data"])}
    turning = {
        take.name: video_turning(store.video(i), Camera(), flow, settings.rate, settings.field_of_view)
        for i, take in enumerate(store.takes)
    }
    rows: list[dict[str, Any]] = []
    errors: list[float] = []
    wrong = accepted = 0
    for name, motion in motions.items():
        length = min(_LONGEST, max(_SHARE * motion.duration, settings.shortest + 1 / settings.rate))
        found: list[float] = []
        confidence, refused = [], 0
        for _ in range(rounds):
            start = rng.uniform(0, max(motion.duration - length, 0.0))
            head = head_turning(_piece(motion, start, length), settings.rate)
            try:
                result = find_offset(head, turning[name], settings, name)
            except InputError:
                refused += 1
                continue
            found.append(abs(result.offset - _begin(motion, start)) * settings.rate)
            confidence.append(result.confidence)
        for other in motions:
            if other != name and len(turning[other]) > len(head) + settings.rate:
                wrong += 1
                accepted += _is_accepted(head, turning[other], settings)
        errors += found
        row = {"clip": name, "seconds": round(length, 2), "refused": refused}
        if found:
            row |= {"worst": max(found), "median": float(np.median(found)), "confidence": min(confidence)}
        rows.append(row)
    return {
        "clips": rows,
        "pieces": rounds * len(rows),
        "worst_frames": max(errors),
        "median_frames": float(np.median(errors)),
        "refused": sum(row["refused"] for row in rows),
        "wrong_pairs": wrong,
        "wrong_accepted": accepted,
    }


def _begin(motion: Motion, start: float) -> float:
    """The time (s) of the motion's frame nearest to ``start``."""
    return round(start * motion.fps) / motion.fps


def _piece(motion: Motion, start: float, length: float) -> Motion:
    first = round(start * motion.fps)
    return motion.slice(first, first + round(length * motion.fps) + 1)


def _is_accepted(head: Array, camera: Array, settings: Any) -> bool:
    try:
        find_offset(head, camera, settings)
    except InputError:
        return False
    return True
