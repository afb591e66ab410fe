"""Fill a take store: motions, the wearer's videos, flow. Every stage is skipped where its result is there."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from egopose.core.errors import InputError
from egopose.data.lock import store_lock
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.data.reference import reference_states, supported
from egopose.data.store import Fragment, TakeInfo, TakeStore, runs_of
from egopose.data.sync_offset import settings_of, sync_offset
from egopose.data.take_sources import TakeSource, find_sources
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.foot_geometry import lowest_points
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.notes import notes_of
from egopose.motion.retarget import RetargetReport
from egopose.vision.corruption import Corruption
from egopose.vision.features import extract_flow
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera
from egopose.vision.takes import RenderConfig, RenderJob, render_takes

#: Raise it whenever changed code gives another reference, video or flow for unchanged settings and sources: reading of
#: motion files, retargeting, settling, making of the humanoid, rendering, optical flow. Stores are then made anew.
PREPARATION_VERSION = 3


def humanoid_of(config: Mapping[str, Any]) -> HumanoidModel:
    """The humanoid of a resolved configuration, at its simulation rate."""
    return build_humanoid(HumanoidConfig.from_mapping(config["humanoid"]), SimConfig(**config["sim"]))


def store_folder(config: Mapping[str, Any]) -> Path:
    """Where the store of this configuration lies: ``data.store``, else the user's cache, named after what is in it."""
    data = config["data"]
    if data.get("store"):
        return Path(data["store"]).expanduser().resolve()
    cache = os.environ.get("EGOPOSE_CACHE") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    base = Path(cache).expanduser() / ("stores" if os.environ.get("EGOPOSE_CACHE") else "egopose/stores")
    return (base / f"{data['name']}-{fingerprint_of(config)[:10]}").resolve()


def fingerprint_of(config: Mapping[str, Any]) -> str:
    """Changes with whatever changes the reference: sources, humanoid, preparation and its code's version."""
    data = config["data"]
    sources = [
        [s.name, s.subject, s.motion.stat().st_size, str(s.video), s.sync_offset, s.options, s.mapping]
        + ([asdict(s.camera)] if s.camera else [])
        for s in find_sources(data)
    ]
    parts = [sources, config["humanoid"], data.get("preparation"), config["sim"]["control_hz"], PREPARATION_VERSION]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def prepare(config: Mapping[str, Any], *, progress: bool = True, flow: bool = True) -> TakeStore:
    """The store of a configuration, made or completed; by one process at a time, the others wait.

    Args:
        config: resolved; groups ``data humanoid sim vision``.
        progress: show bars.
        flow: also videos and flow; without, only motions.

    Raises:
        InputError: a source cannot be used; nothing already made is lost.
    """
    root = store_folder(config)
    with store_lock(root):
        return _prepare(config, root, progress, flow)


def _prepare(config: Mapping[str, Any], root: Path, progress: bool, flow: bool) -> TakeStore:
    if (root / "store.json").is_file():
        store = TakeStore.open(root)
        if store.fingerprint != fingerprint_of(config):
            raise InputError(
                root,
                "fingerprint",
                "the store was made of other data or settings, or by another version of the preparation; "
                "give another data.store",
            )
    else:
        store = _make_motions(config, root, progress)
    if flow:
        _make_videos(config, store, progress)
        _make_flow(config, store, progress)
    return store


def _bar(label: str, unit: str, show: bool) -> Progress:
    columns = [TextColumn(label), BarColumn(), MofNCompleteColumn(), TextColumn(unit), TimeRemainingColumn()]
    return Progress(*columns, disable=not show)


def _make_motions(config: Mapping[str, Any], root: Path, progress: bool) -> TakeStore:
    data, humanoid = config["data"], humanoid_of(config)
    settings = PreparationSettings.from_mapping(data.get("preparation") or {})
    sources = find_sources(data)
    clips, infos, states, offset = [], [], [], 0
    with _bar("motions", "takes", progress) as bar:
        task = bar.add_task("motions", total=len(sources))
        for source in sources:
            motion = read_motion(source.motion, **source.options)
            if source.sync_offset is None:
                source = replace(source, sync_offset=_find_offset(config, source, motion))
            clip, report = reference_motion(motion, humanoid, settings, source.mapping)
            body = reference_states(humanoid, clip)
            contacts = clip.contacts if clip.contacts is not None else np.ones((len(clip), 1), dtype=bool)
            feasible = supported(humanoid, body, contacts, clip.fps, lowest_points(humanoid, clip))
            infos.append(_row(source, clip, report, offset, body, feasible, humanoid))
            clips.append(clip)
            states.append(body)
            offset += len(clip)
            bar.advance(task)
    root.parent.mkdir(parents=True, exist_ok=True)
    fps = 1.0 / humanoid.control_dt
    return TakeStore.create(root, fps, fingerprint_of(config), infos, clips, torch.cat(states))


def _find_offset(config: Mapping[str, Any], source: TakeSource, motion: Motion) -> float:

    assert source.video is not None
    flow = FlowConfig(**config["vision"]["flow"])
    result = sync_offset(source.video, motion, settings_of(config["data"]), flow, source.camera, source.mapping)
    return result.offset


def _row(
    source: TakeSource,
    clip: Motion,
    report: RetargetReport,
    offset: int,
    body: Any,
    feasible: np.ndarray,
    humanoid: HumanoidModel,
) -> TakeInfo:
    return TakeInfo(
        name=source.name,
        subject=source.subject,
        offset=offset,
        length=len(clip),
        lowest_head_height=float(body["xpos"][:, humanoid.head, 2].min()),
        source=source.motion.name,
        video=f"videos/{source.name}.mp4" if source.video is None else str(source.video),
        sync_offset=source.sync_offset or 0.0,
        rendered=source.video is None,
        supported=runs_of(feasible),
        retargeting_mm=float(np.mean([mean for mean, _ in report.position_mm.values()])),
        camera=asdict(source.camera) if source.camera else None,
        notes=notes_of(clip),
        warnings=report.warnings,
    )


def _make_videos(config: Mapping[str, Any], store: TakeStore, progress: bool) -> None:

    corruption = Corruption.from_config(config)
    todo = [i for i, take in enumerate(store.takes) if take.rendered]
    if corruption is not None and len(todo) < len(store.takes):
        filmed = next(take.name for take in store.takes if not take.rendered)
        raise InputError("configuration", "corruption", f"is for rendered takes; the video of {filmed} was filmed")
    if not todo:
        return
    tests = _test_room_takes(config, store)
    # At the default rates, so that a video stays valid whatever rate is trained at.
    xml = build_humanoid(HumanoidConfig.from_mapping(config["humanoid"])).xml
    jobs = [
        RenderJob(t.name, xml, store.clip(i).qpos, video_of(config, store, i), "test" if i in tests else "train")
        for i in todo
        for t in [store.takes[i]]
    ]
    for folder in {job.path.parent for job in jobs}:
        folder.mkdir(parents=True, exist_ok=True)
    vision = config["vision"]
    render_takes(jobs, RenderConfig.from_mapping(vision, corruption), int(vision["workers"]), progress)


def _test_room_takes(config: Mapping[str, Any], store: TakeStore) -> set[int]:
    """Takes that only ever test stand in rooms no training take has seen."""
    split = config["data"]["split"]
    if split["kind"] != "subject":
        return set()
    tests = {str(s) for s in split["test_subjects"]}
    return {i for i, take in enumerate(store.takes) if take.subject in tests}


def video_of(config: Mapping[str, Any], store: TakeStore, take: int) -> Path:
    """The wearer's video as ``config`` has it: the store's, or a corrupted one beside it."""
    corruption, usual = Corruption.from_config(config), store.video(take)
    if corruption is None:
        return usual
    digest = hashlib.sha256(json.dumps(asdict(corruption), sort_keys=True).encode()).hexdigest()
    return usual.parent / f"corrupted-{digest[:8]}" / usual.name


def flow_name(config: Mapping[str, Any]) -> str:
    """The flow table's name: the vision config's kind and what the flow depends on."""
    vision = config["vision"]
    parts = [vision["flow"]["preset"], vision["flow"]["working_size"], vision["flow"]["stored_size"]]
    rendered = [vision["video"], vision["camera"], vision["room"], config["data"]["split"].get("test_subjects")]
    corruption = Corruption.from_config(config)
    known = [parts, rendered, *([asdict(corruption)] if corruption is not None else [])]
    digest = hashlib.sha256(json.dumps(known, sort_keys=True, default=str).encode()).hexdigest()
    return f"{parts[0]}-{parts[2]}-{digest[:8]}"


def _make_flow(config: Mapping[str, Any], store: TakeStore, progress: bool) -> None:

    name, settings = flow_name(config), config["vision"]["flow"]
    todo = sorted(set(range(len(store.takes))) - store.flow_done(name))
    progress = progress and bool(todo)
    table = store.open_flow(name, int(settings["stored_size"]))
    with _bar("optical flow", "frames", progress) as bar:
        task = bar.add_task("flow", total=sum(store.takes[i].length for i in todo))
        for index in todo:
            take = store.takes[index]
            camera = Camera.from_mapping(take.camera, take.name) if take.camera else None
            video = video_of(config, store, index)
            flow = extract_flow(video, settings, store.fps, take.sync_offset, take.length, camera)
            table[store.frames(index)] = torch.from_numpy(flow)
            store.mark_flow(name, index)
            bar.advance(task, take.length)


def global_spans(store: TakeStore, fragments: list[Fragment]) -> list[tuple[int, int]]:
    """``(start, stop)`` of fragments among the store's frames."""
    return [(store.takes[f.take].offset + f.start, store.takes[f.take].offset + f.stop) for f in fragments]
