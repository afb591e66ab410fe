"""The first stage of preparation: every take's motion on the humanoid, by one process or several."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from typing import Any

import numpy as np

from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.data.gate import open_loop_gate
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.data.reference import reference_states, supported
from egopose.data.source_reading import read_source
from egopose.data.store import LeftOut
from egopose.data.sync_offset import settings_of, sync_offset
from egopose.data.take_sources import TakeSource
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.foot_geometry import lowest_points
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion.motion import Motion
from egopose.motion.retarget import RetargetReport
from egopose.motion.rotations import Array
from egopose.vision.flow import FlowConfig


@dataclass(frozen=True)
class PreparedTake:
    """A take's motion as it goes into the store.

    Args:
        source: of it, with the offset of its video.
        clip: the reference clip.
        report: of retargeting.
        states: ``[T]`` body states.
        supported: ``[T]`` whether a body on a bare floor could be so.
        gate: why the physics gate is not passed, empty where it is; None where it was not asked.
        feasible: share of the frames that contact with a bare floor can have made; None where it was not asked.
    """

    source: TakeSource
    clip: Motion
    report: RetargetReport
    states: dict[str, Array]
    supported: np.ndarray
    gate: str | None = None
    feasible: float | None = None


@dataclass(frozen=True)
class MotionStageSettings:
    """How the motions of a set are prepared. Settings of ``conf/data``.

    Args:
        workers: processes; the result does not depend on it.
        on_refused: ``stop`` at a clip that cannot be used, or ``skip`` it and list it.
        gate: whether every clip goes through the physics gate (:mod:`egopose.data.gate`).
    """

    workers: int
    on_refused: str
    gate: bool

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> MotionStageSettings:
        """Of a resolved configuration. Raises InputError: a setting is wrong."""
        data = config["data"]
        workers = convert(data.get("workers", 1), int, "data", "data.workers")
        gate = convert(data.get("gate", False), bool, "data", "data.gate")
        on_refused = data.get("on_refused", "stop")
        if workers < 1:
            raise InputError("data", "data.workers", f"must be at least 1, not {workers}")
        if on_refused not in ("stop", "skip"):
            raise InputError("data", "data.on_refused", f"must be stop or skip, not {on_refused!r:.60}")
        return cls(workers, on_refused, gate)


def prepared_takes(config: Mapping[str, Any], sources: Sequence[TakeSource]) -> Iterator[PreparedTake | LeftOut]:
    """Every source as a take, or as refused, in order.

    Args:
        config: resolved; groups ``data humanoid sim``, and ``vision`` where the offset of a video is to be found.
        sources: of the set.

    Raises:
        InputError: a setting is wrong, or a source cannot be used and ``data.on_refused`` is not ``skip``.
    """
    settings = MotionStageSettings.from_config(config)
    work = partial(_prepared, json.dumps(config, default=str))
    if min(settings.workers, len(sources)) == 1:
        yield from map(work, sources)
        return
    with ProcessPoolExecutor(settings.workers, get_context("spawn"), initializer=end_with_parent) as pool:
        yield from pool.map(work, sources)


def _prepared(text: str, source: TakeSource) -> PreparedTake | LeftOut:
    config, humanoid, preparation, settings = _parts(text)
    try:
        motion = read_source(source)
        if source.sync_offset is None:
            source = replace(source, sync_offset=_offset(config, source, motion))
        clip, report = reference_motion(motion, humanoid, preparation, source.mapping)
    except InputError as error:
        if settings.on_refused != "skip":
            raise
        frames, fps = source.facts.get("frames"), source.facts.get("fps")
        seconds = frames / fps if frames and fps else None
        return LeftOut(source.name, source.subject, f"{error.field}: {error.cause}", seconds, refused=True)
    states = reference_states(humanoid, clip)
    contacts = clip.contacts if clip.contacts is not None else np.ones((len(clip), 1), dtype=bool)
    on_floor = supported(humanoid, states, contacts, clip.fps, lowest_points(humanoid, clip))
    take = PreparedTake(source, clip, report, {key: states[key].numpy() for key in states.keys()}, on_floor)  # noqa: SIM118
    if not settings.gate:
        return take
    result = open_loop_gate(humanoid, clip)
    return replace(take, gate=result.cause, feasible=result.feasible)


@lru_cache(maxsize=1)
def _parts(text: str) -> tuple[dict[str, Any], HumanoidModel, PreparationSettings, MotionStageSettings]:
    config = json.loads(text)
    humanoid = build_humanoid(HumanoidConfig.from_mapping(config["humanoid"]), SimConfig(**config["sim"]))
    preparation = PreparationSettings.from_mapping(config["data"].get("preparation") or {})
    return config, humanoid, preparation, MotionStageSettings.from_config(config)


def _offset(config: Mapping[str, Any], source: TakeSource, motion: Motion) -> float:
    assert source.video is not None
    flow = FlowConfig(**config["vision"]["flow"])
    return sync_offset(source.video, motion, settings_of(config["data"]), flow, source.camera, source.mapping).offset
