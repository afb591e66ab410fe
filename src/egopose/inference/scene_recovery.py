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
from egopose.inference.progress import StageProgress
from egopose.inference.reconstruction import FITTED, PAGE, PLAN
from egopose.inference.scene_motion import Recovered, fitted, recovered
from egopose.inference.window_refinement import RefinementSettings
from egopose.pipeline.agent import load_policy
from egopose.scene.clip import read_clip
from egopose.scene.scene_file import Scene, write_scene

SEARCH = "search.json"
#: What a frame costs in each stage, ms: measured on two cores beside other work.
_COSTS = {"physics": 900.0, "report": 60.0}
#: Changes with what the stages compute from the same inputs.
_VERSION = 2


def recover_scene(values: Mapping[str, Any], folder: Path, write_report: Callable[[Path, Path], object]) -> Path:
    """Find the simulated motion of a prepared ``folder`` and report it; returns the folder.

    Leaves ``plan.npz`` (:class:`~egopose.scene.simulated.SimulatedMotion`), ``scene.fitted.yaml``, ``search.json`` and
    ``reconstruction.html``.

    Args:
        values: ``conf/reconstruct.yaml``, resolved.
        folder: of :func:`~egopose.inference.scene_preparation.prepare_scene`.
        write_report: writes the page of a folder of results to a file.

    Raises:
        InputError: a setting, the policy or a file of the preparation cannot be used. Stages that were made stay.
    """
    settings = RefinementSettings.from_config(values["refinement"])
    chosen = FOLDER / "tracker" if values["policy"] is None else Path(str(values["policy"]))
    policy = load_policy(chosen)
    free = convert(values["fit"], bool, "conf/reconstruct.yaml", "fit")
    clip, humanoid, store = read_clip(folder), humanoid_of(values), StageFolder(folder)
    inputs = {
        **{name: store.digest(name) for name in ("body.npz", "root.npz", "joints.npz")},
        "scene": repr((clip.scene.boxes, clip.scene.contacts)),
        "refinement": values["refinement"],
        "fit": free,
        "policy": _digest(policy.path),
        "version": _VERSION,
    }
    with StageProgress(_COSTS, len(clip)) as progress:
        if not store.done("physics", inputs):
            with progress.stage("physics") as advance:
                began = time.perf_counter()
                scene = fitted(folder, clip, humanoid) if free else clip.scene
                share = _Share(settings.sweeps, advance)
                found = recovered(folder, replace(clip, scene=scene), humanoid, policy, settings, share)
                seconds = time.perf_counter() - began
                store.make("physics", inputs, lambda part: _keep(found, clip.scene, scene, seconds, part))
        told = {PLAN: store.digest(PLAN), FITTED: store.digest(FITTED), "version": _VERSION}
        if not store.done("report", told):
            with progress.stage("report"):
                store.make("report", told, lambda part: _report(write_report, folder, part))
    return folder


def _report(write: Callable[[Path, Path], object], folder: Path, out: Path) -> None:
    write(folder, out / PAGE)


class _Share:
    """Frames of several sweeps as frames of one stage."""

    def __init__(self, sweeps: int, advance: Callable[[int], None]) -> None:
        self._sweeps, self._advance, self._done = sweeps, advance, 0

    def __call__(self, frames: int) -> None:
        before, self._done = self._done // self._sweeps, self._done + frames
        self._advance(self._done // self._sweeps - before)


def _digest(checkpoint: Path) -> str:
    """Of a checkpoint: its list of checksums stands for all of its files."""
    return (checkpoint / "checksums.json").read_text(encoding="utf8")


def _keep(found: Recovered, guessed: Scene, scene: Scene, seconds: float, out: Path) -> None:
    found.motion.save(out / PLAN)
    write_scene(scene, out / FITTED)
    pairs = zip(guessed.boxes, scene.boxes, strict=True)
    told = {
        "cost": found.cost,
        "seconds": seconds,
        "boxes": {before.name: {"height": _less(after.height, before.height)} for before, after in pairs},
    }
    (out / SEARCH).write_text(json.dumps(told, indent=1))


def _less(after: float | None, before: float | None) -> float | None:
    return None if after is None or before is None else after - before
