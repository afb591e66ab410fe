"""Rates of the physics: what coarser steps cost in tracking and energy, and what they save."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from egopose.core.config import compose_config
from egopose.data.gate import feasible_starts
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.data.rates import Starts, compare_rates
from egopose.data.source_reading import read_source
from egopose.data.take_sources import find_sources
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.motion.motion import finite_difference

#: Physics steps a control step that are compared; the first is the measure of the others.
SUBSTEPS = (15, 8, 5, 4, 3, 2)


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Open-loop PD from every feasible start of a data set's clips, and unactuated flight, at several rates.

    Args:
        overrides: of the ``prepare`` configuration (``data=cmu6 data.folder=PATH``).
        rounds: timed repetitions; the median counts.

    Returns:
        ``clips``, ``starts`` and ``rates``, a list of :func:`egopose.data.rates.compare_rates`'s rows.

    Raises:
        InputError: a setting is unknown, or the data cannot be used.
    """
    config = compose_config("prepare", list(overrides))
    table = HumanoidConfig.from_mapping(config["humanoid"])
    sims = [SimConfig(**{**config["sim"], "substeps": count}) for count in SUBSTEPS]
    humanoids = [build_humanoid(table, sim) for sim in sims]
    settings = PreparationSettings.from_mapping(config["data"].get("preparation") or {})
    parts = []
    for source in find_sources(config["data"]):
        clip, _ = reference_motion(read_source(source), humanoids[0], settings, source.mapping)
        starts = feasible_starts(humanoids[0], clip)
        parts.append(Starts.of(clip.qpos, finite_difference(clip.qpos, clip.fps), starts))
    together = Starts(*(np.concatenate(field) for field in zip(*parts, strict=True)))
    return {
        "clips": len(parts),
        "starts": len(together.qpos),
        "rates": compare_rates(humanoids, together, rounds),
    }
