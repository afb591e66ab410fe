"""``egopose bench scenes``: third-person reconstruction against true motions among boxes.

Each clip is a simulated motion (:mod:`egopose.benchmarks.scene_truth`). Virtual cameras see it, a pose estimator's
errors are put on top, and ``egopose reconstruct prepare`` runs on what is left. The kinematic root is judged, and the
simulated motion too where the folder of results holds ``plan.npz``.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from egopose.benchmarks.scene_baselines import anchored, still
from egopose.benchmarks.scene_clips import (
    Chosen,
    TrueClip,
    clip_names,
    clips_folder,
    read_true_clip,
    simulated_feet,
)
from egopose.benchmarks.scene_sight import EXACT, GAP, HARD, SightNoise, guessed_scene, seen
from egopose.benchmarks.scene_table import by_camera, tables
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.data.preparation import humanoid_of
from egopose.evaluation.scene_metrics import SceneMotion, scene_figures
from egopose.evaluation.scene_page import write_scene_page
from egopose.humanoid.model import HumanoidModel
from egopose.inference.reconstruction import PLAN
from egopose.inference.scene_preparation import prepare_scene
from egopose.inference.scene_recovery import SEARCH, recover_scene
from egopose.motion.motion import Motion
from egopose.scene.camera_file import save_camera
from egopose.scene.clip import Clip, read_clip
from egopose.scene.scene_file import write_scene
from egopose.scene.simulated import as_simulated, load_simulated

__all__ = ["run", "tables"]

_NOISE = {"measured": SightNoise(), "hard": HARD, "none": EXACT}


@dataclass(frozen=True)
class View:
    """One way to see a clip; its folder's name says it all."""

    clip: str
    camera: str
    noise: str
    boxes: str
    gap: bool
    seed: int

    @property
    def name(self) -> str:
        """Of the folder of results."""
        more = [part for part, on in (("gap", self.gap), ("no_boxes", self.boxes == "none")) if on]
        return ".".join([self.clip, self.camera, self.noise, *more, str(self.seed)])

    def about(self) -> dict[str, Any]:
        """For a row of a table."""
        return dict(vars(self))


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """See the true clips, prepare scenes of them, and judge.

    Args:
        overrides: settings of :class:`~egopose.benchmarks.scene_clips.Chosen`, ``key=one,two``.
        rounds: seeds of each camera and its noise, from 0.

    Returns:
        ``rows``: a row a view and judged motion (``kinematic``, ``simulated``), or why it ``failed``. ``by_camera``:
        means.

    Raises:
        InputError: a setting is unknown or cannot be, or a true clip is damaged.
    """
    chosen = Chosen.of(overrides)
    if rounds < 1:
        raise InputError("bench scenes", "rounds", f"{rounds}; at least 1")
    humanoid = humanoid_of(compose_config("reconstruct"))
    source = clips_folder(chosen.source)
    names = clip_names(source, chosen.clips)
    ways = product(chosen.cameras, chosen.noise, chosen.boxes, range(rounds))
    views = [(way, name) for way in ways for name in names]
    rows: list[dict[str, Any]] = []
    with _folder(chosen.folder) as folder, _bar(len(views)) as advance:
        clips = {name: read_true_clip(source / name, humanoid) for name in names}
        for (camera, noise, boxes, seed), name in views:
            view = View(name, camera, noise, boxes, chosen.gap, seed)
            rows += _row(humanoid, clips[name], view, folder / view.name, chosen)
            advance()
    return {"rounds": rounds, "rows": rows, "by_camera": by_camera([row for row in rows if "failed" not in row])}


def _row(humanoid: HumanoidModel, clip: TrueClip, view: View, folder: Path, chosen: Chosen) -> list[dict[str, Any]]:
    """A row for each judged motion; one that says why where preparing failed."""
    acted = [mode for mode in chosen.physics if mode != "none"]
    try:
        if not chosen.judge_only:
            observe(humanoid, clip, view, folder)
            prepare(folder)
            for mode in acted:
                act_out(folder, mode)
        return [{**view.about(), **row} for row in judged(humanoid, clip, folder, acted)]
    except InputError as error:
        return [{**view.about(), "motion": "kinematic", "failed": str(error)}]


def observe(humanoid: HumanoidModel, clip: TrueClip, view: View, folder: Path) -> None:
    """Write what is seen to ``folder/seen``: poses, the camera, a guessed scene; ``turn.json`` to judge by."""
    rng = np.random.default_rng([view.seed, zlib.crc32(f"{view.clip}.{view.camera}".encode())])
    noise = replace(_NOISE[view.noise], gap=GAP if view.gap else 0)
    motion = Motion(humanoid.skeleton, clip.simulated.qpos, clip.scene.fps, clip.name)
    sight = seen(motion, view.camera, noise, rng)
    out = folder / "seen"
    out.mkdir(parents=True, exist_ok=True)
    sight.track.save(out / "poses.npz")
    save_camera(sight.camera, out / "camera.npz")
    if view.boxes == "guessed":
        scene = guessed_scene(clip.scene, view.camera, sight.turn, motion.qpos[0, :2], rng)
        write_scene(scene, out / "scene.yaml")
    (out / "turn.json").write_text(json.dumps({"turn": sight.turn}))


def prepare(folder: Path) -> None:
    """``egopose reconstruct prepare`` on ``folder/seen``; results go to ``folder``."""
    seen_in = folder / "seen"
    words = [f"poses={seen_in / 'poses.npz'}", f"camera.track={seen_in / 'camera.npz'}"]
    words += [f"out={folder}", "page.moments=4", "page.height=200"]
    if (seen_in / "scene.yaml").is_file():
        words.append(f"scene={seen_in / 'scene.yaml'}")
    values = compose_config("reconstruct", words)
    prepare_scene(values, write_scene_page)


def act_out(folder: Path, mode: str) -> None:
    """``egopose reconstruct`` goes on from a prepared ``folder``, in ``folder/MODE``: ``given`` or ``fitted`` boxes."""
    out = folder / mode
    out.mkdir(exist_ok=True)
    for file in folder.iterdir():
        if file.is_file() and file.name not in (PLAN, "page.html"):
            shutil.copy2(file, out / file.name)
    values = compose_config("reconstruct", [f"fit={mode == 'fitted'}", f"out={out}"])
    recover_scene(values, out, lambda _, page: page.write_text(""))


def judged(humanoid: HumanoidModel, clip: TrueClip, folder: Path, acted: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Figures of simple answers, of the kinematic root in ``folder``, and of simulated motions.

    Those are its ``plan.npz``, and those of ``acted``.

    Raises:
        InputError: a file is missing or damaged, or has other frames than the truth.
    """
    found = read_clip(folder)
    turn = float(read_json(folder / "seen" / "turn.json", "turn")["turn"])
    start = round(found.scene.begin * found.scene.fps)
    if start + len(found) > len(clip.simulated):
        raise InputError(folder / "body.npz", "qpos", f"{len(found)} frames; the truth has {len(clip.simulated)}")
    true = clip.part(humanoid, start, len(found))
    bodies = {
        "still": still(folder, found),
        "anchored": anchored(folder, found, humanoid),
        "kinematic": found.body,
    }
    rows: list[dict[str, Any]] = [
        {"motion": name, **scene_figures(humanoid, SceneMotion(body, found.touching, found.scene), true, turn)}
        for name, body in bodies.items()
    ]
    plans = {"simulated": folder / PLAN, **{f"simulated, {mode}": folder / mode / PLAN for mode in acted}}
    for motion, path in plans.items():
        if path.is_file():
            simulated = _simulated(path, found, humanoid)
            row = {"motion": motion, **scene_figures(humanoid, simulated, true, turn)}
            card = path.with_name(SEARCH)
            rows.append({**row, "seconds": read_json(card, "search")["seconds"]} if card.is_file() else row)
    return rows


def _simulated(path: Path, found: Clip, humanoid: HumanoidModel) -> SceneMotion:
    plan = load_simulated(path)
    scene = as_simulated(found.scene, plan)
    feet = simulated_feet(path, plan, scene, humanoid)
    if len(plan) != len(found):
        raise InputError(path, "qpos", f"{len(plan)} frames; body.npz has {len(found)}")
    return SceneMotion(Motion(humanoid.skeleton, plan.qpos, found.body.fps), feet, scene)


@contextmanager
def _folder(given: str) -> Iterator[Path]:
    if given:
        yield Path(given).expanduser()
        return
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@contextmanager
def _bar(total: int) -> Iterator[Any]:
    columns = [TextColumn("views"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("views", total=total)
        yield lambda: bar.advance(task)
