"""The stages behind a prepared scene: a motion that physics allows, the scene it fits, and what came of it.

They follow :mod:`egopose.inference.scene_preparation` in the same folder, with cards of their own: what is there and
still fits is not made again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from egopose.checkpoint.pretrained import FOLDER
from egopose.core.config import convert
from egopose.core.stages import StageFolder
from egopose.data.preparation import humanoid_of
from egopose.inference.motion_cost import TERMS
from egopose.inference.progress import StageProgress
from egopose.inference.reconstruction import FITTED, PAGE, PLAN
from egopose.inference.sampled_motion import Found, SamplingSettings
from egopose.inference.scene_motion import recovered
from egopose.inference.scene_refinement import Refined, refined
from egopose.inference.window_refinement import RefinementSettings
from egopose.pipeline.agent import load_policy
from egopose.scene.clip import read_clip
from egopose.scene.scene_file import FREE, Box, Scene, write_scene
from egopose.scene.simulated import as_simulated, load_simulated

SEARCH = "search.json"
REFINEMENT = "refinement.json"
_SAMPLED = "sampled.npz"
#: What a frame costs in each stage, ms: measured on two cores beside other work.
_COSTS = {"physics": 400.0, "refinement": 2000.0, "report": 60.0}
#: Changes with what the stages compute from the same inputs.
_VERSION = 2


def recover_scene(values: Mapping[str, Any], folder: Path, write_report: Callable[[Path, Path], object]) -> Path:
    """Find the simulated motion of a prepared ``folder`` and report it; returns the folder.

    Leaves ``sampled.npz`` and ``plan.npz`` (:class:`~egopose.scene.simulated.SimulatedMotion`, before and after
    refinement), ``scene.fitted.yaml``, ``search.json``, ``refinement.json`` and ``reconstruction.html``.

    Args:
        values: ``conf/reconstruct.yaml``, resolved.
        folder: of :func:`~egopose.inference.scene_preparation.prepare_scene`.
        write_report: writes the page of a folder of results to a file.

    Raises:
        InputError: a setting, the policy or a file of the preparation cannot be used. Stages that were made stay.
    """
    settings = SamplingSettings.from_config(values["sampling"])
    refinement = RefinementSettings.from_config(values["refinement"])
    chosen = FOLDER / "tracker" if values["policy"] is None else Path(str(values["policy"]))
    policy = load_policy(chosen)
    free = convert(values["fit"], bool, "conf/reconstruct.yaml", "fit")
    clip, humanoid, store = read_clip(folder), humanoid_of(values), StageFolder(folder)
    made_from = {name: store.digest(name) for name in ("body.npz", "root.npz", "joints.npz", "orientation.npz")}
    inputs = {
        **made_from,
        "scene": repr((clip.scene.boxes, clip.scene.contacts)),
        "sampling": values["sampling"],
        "fit": free,
        "policy": _digest(policy.path),
        "version": _VERSION,
    }
    with StageProgress(_COSTS, len(clip)) as progress:
        if not store.done("physics", inputs):
            with progress.stage("physics") as advance:
                share = _Share(settings.passes + 1, advance)
                began = time.perf_counter()
                found = recovered(folder, clip, humanoid, policy, settings, free, share)
                seconds = time.perf_counter() - began
                store.make("physics", inputs, lambda part: _keep(found, clip.scene, seconds, part))
        closer = inputs | {"sampled": store.digest(_SAMPLED), "refinement": values["refinement"]}
        if not store.done("refinement", closer):
            with progress.stage("refinement") as advance:
                began = time.perf_counter()
                sampled = load_simulated(folder / _SAMPLED)
                share = _Share(refinement.sweeps + 1, advance)
                better = refined(folder, clip, humanoid, policy, refinement, sampled, share)
                seconds = time.perf_counter() - began
                store.make("refinement", closer, lambda part: _keep_refined(better, seconds, part))
        told = {PLAN: store.digest(PLAN), FITTED: store.digest(FITTED), "version": _VERSION}
        if not store.done("report", told):
            with progress.stage("report"):
                store.make("report", told, lambda part: _report(write_report, folder, part))
    return folder


def _report(write: Callable[[Path, Path], object], folder: Path, out: Path) -> None:
    write(folder, out / PAGE)


class _Share:
    """Frames of several passes as frames of one stage."""

    def __init__(self, passes: int, advance: Callable[[int], None]) -> None:
        self._passes, self._advance, self._done = passes, advance, 0

    def __call__(self, frames: int) -> None:
        before, self._done = self._done // self._passes, self._done + frames
        self._advance(self._done // self._passes - before)


def _digest(checkpoint: Path) -> str:
    """Of a checkpoint: its list of checksums stands for all of its files."""
    return (checkpoint / "checksums.json").read_text(encoding="utf8")


def _keep(found: Found, scene: Scene, seconds: float, out: Path) -> None:
    found.motion.save(out / _SAMPLED)
    write_scene(fitted(scene, found), out / FITTED)
    spread = found.changes.std(axis=0)
    told = {
        "cost": dict(zip(TERMS, found.cost.mean(axis=0).tolist(), strict=True)),
        "total": float(found.totals[0]),
        "seconds": seconds,
        "boxes": {
            box.name: {
                name: {"change": float(found.change[k, c]), "spread": float(spread[k, c])}
                for c, name in enumerate(FREE)
                if name in box.free
            }
            for k, box in enumerate(scene.boxes)
        },
    }
    (out / SEARCH).write_text(json.dumps(told, indent=1))


def _keep_refined(better: Refined, seconds: float, out: Path) -> None:
    better.motion.save(out / PLAN)
    told = {"cost_before": better.before, "cost": better.after, "seconds": seconds}
    (out / REFINEMENT).write_text(json.dumps(told, indent=1))


def fitted(scene: Scene, found: Found) -> Scene:
    """The scene with its boxes where the best body had them; what may still change shrinks to what is left of it."""
    moved = as_simulated(scene, found.motion)
    return replace(moved, boxes=tuple(map(_as_found, moved.boxes, found.change.tolist())))


def _as_found(box: Box, change: list[float]) -> Box:
    left = {
        name: (min(low - by, 0.0), max(high - by, 0.0))
        for name, by in zip(FREE, change, strict=True)
        if name in box.free
        for low, high in [box.free[name]]
    }
    assert box.place is not None
    assert box.height is not None
    assert box.yaw is not None
    x, y = box.place
    return replace(box, place=(round(x, 4), round(y, 4)), height=round(box.height, 4), yaw=round(box.yaw, 4), free=left)
