"""Fill a take store: motions, the wearer's videos, flow. Every stage is skipped where its result is there."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import TensorDict

from egopose.core.errors import InputError
from egopose.data.lock import store_lock
from egopose.data.motion_stage import PreparedTake, prepared_takes
from egopose.data.store import REFERENCE_KEYS, Fragment, LeftOut, TakeInfo, TakeStore
from egopose.data.table_sources import left_out_rows
from egopose.data.take_sources import find_sources
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.motion.contacts import runs_of
from egopose.motion.notes import notes_of
from egopose.vision.corruption import Corruption
from egopose.vision.features import extract_flow
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
        + ([s.group, s.part, s.skip, s.facts] if data["source"] == "table" else [])
        for s in find_sources(data)
    ]
    parts = [sources, config["humanoid"], data.get("preparation"), config["sim"]["control_hz"], PREPARATION_VERSION]
    if data["source"] == "table":
        parts += [[asdict(clip) for clip in left_out_rows(data)]]
    if data.get("gate"):
        parts += ["gate"]
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
    sources, left_out = find_sources(data), left_out_rows(data)
    takes: list[PreparedTake] = []
    with _bar("motions", "takes", progress) as bar:
        task = bar.add_task("motions", total=len(sources))
        for take in prepared_takes(config, sources):
            if isinstance(take, LeftOut):
                left_out.append(take)
            else:
                takes.append(take)
            bar.advance(task)
    if not takes:
        first = next(clip for clip in left_out if clip.refused)
        raise InputError("data", first.name, f"all {len(sources)} clips are refused, this one for: {first.cause}")
    root.parent.mkdir(parents=True, exist_ok=True)
    offsets = np.cumsum([0, *(len(take.clip) for take in takes)]).tolist()
    infos = [_row(take, offset, humanoid) for take, offset in zip(takes, offsets[:-1], strict=True)]
    states = {key: torch.from_numpy(np.concatenate([t.states[key] for t in takes])) for key in REFERENCE_KEYS}
    reference = TensorDict(states, batch_size=[offsets[-1]])
    clips = [take.clip for take in takes]
    return TakeStore.create(root, 1.0 / humanoid.control_dt, fingerprint_of(config), infos, clips, reference, left_out)


def _row(take: PreparedTake, offset: int, humanoid: HumanoidModel) -> TakeInfo:
    source, clip = take.source, take.clip
    return TakeInfo(
        name=source.name,
        subject=source.subject,
        offset=offset,
        length=len(clip),
        lowest_head_height=float(take.states["xpos"][:, humanoid.head, 2].min()),
        source=source.motion.name,
        video=f"videos/{source.name}.mp4" if source.video is None else str(source.video),
        sync_offset=source.sync_offset or 0.0,
        rendered=source.video is None,
        supported=runs_of(take.supported),
        retargeting_mm=float(np.mean([mean for mean, _ in take.report.position_mm.values()])),
        camera=asdict(source.camera) if source.camera else None,
        notes=notes_of(clip),
        warnings=take.report.warnings,
        group=source.group,
        part=source.part,
        gate=take.gate,
        feasible=take.feasible,
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
    if split["kind"] == "table":
        return {i for i, take in enumerate(store.takes) if take.part == "test"}
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
    if config["data"]["split"]["kind"] == "table":
        rendered.append("rooms by table")
    corruption = Corruption.from_config(config)
    added = [part for part in (corruption and asdict(corruption), vision.get("film")) if part is not None]
    known = [parts, rendered, *added]
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
