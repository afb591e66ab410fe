"""Retargeting: frames a second on one core."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.data.prepare_motion import PreparationSettings, reference_motion, without_lead_in
from egopose.data.source_reading import read_source
from egopose.data.take_sources import find_sources
from egopose.motion.retarget import retarget


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Retarget every clip of a data set, and prepare it whole.

    The processor's time counts, of all threads together: a figure of one core, whatever else the machine does.

    Args:
        overrides: of the ``prepare`` configuration (``data=cmu6 data.folder=PATH``); default the embedded clips.
        rounds: timed repetitions; the median counts.

    Returns:
        ``clips``, ``frames`` (of the sources, at twice the control rate at most), ``retarget_fps`` (retargeting
        alone), ``prepare_fps`` (with filter, settling and planting), ``mean_mm`` and ``worst_mm`` (mean over parts and
        clips of the distance to the source, and the worst part's mean).

    Raises:
        InputError: a setting is unknown, or the data cannot be used.
    """

    config = compose_config("prepare", list(overrides))
    humanoid, data = humanoid_of(config), config["data"]
    settings = PreparationSettings.from_mapping(data.get("preparation") or {})
    fps = 2.0 / humanoid.control_dt
    jobs = []
    for source in find_sources(data):
        motion = without_lead_in(read_source(source))
        jobs.append((motion.resample(fps) if motion.fps > fps else motion, source.mapping))
    frames = sum(len(motion) for motion, _ in jobs)
    alone, whole, errors = [], [], []
    for _ in range(rounds):
        began = time.process_time()
        reports = [retarget(m, humanoid.skeleton, humanoid.joint_range, mapping)[1] for m, mapping in jobs]
        alone.append(time.process_time() - began)
        began = time.process_time()
        for motion, mapping in jobs:
            reference_motion(motion, humanoid, settings, mapping)
        whole.append(time.process_time() - began)
    for report in reports:
        errors.append([mean for mean, _ in report.position_mm.values()])
    return {
        "clips": len(jobs),
        "frames": frames,
        "retarget_fps": frames / float(np.median(alone)),
        "prepare_fps": frames / float(np.median(whole)),
        "mean_mm": float(np.mean([np.mean(parts) for parts in errors])),
        "worst_mm": float(max(max(parts) for parts in errors)),
    }
