"""The page of `egopose reconstruct prepare`: every stage in pictures and words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.evaluation import scene_pictures as pictures
from egopose.evaluation.charts import Line, line_chart
from egopose.evaluation.page import Film, Number, Picture, Table, render
from egopose.inference.scene_stages import Sources, clip_camera, supports_of, touching_of
from egopose.motion.io._npz import read_arrays
from egopose.motion.io.native import read_native
from egopose.scene.contacts import FEET
from egopose.scene.poses.track import load_track
from egopose.scene.scene_file import Scene, read_scene
from egopose.vision.video import Frame

_SOURCE = "conf/reconstruct.yaml"


def write_scene_page(sources: Sources, folder: Path, settings: Mapping[str, Any], out: Path) -> None:
    """Write ``page.html`` to ``out``.

    Args:
        sources: of the film.
        folder: of the results.
        settings: ``page`` of ``conf/reconstruct.yaml``.
        out: a folder.

    Raises:
        InputError: the film cannot be read any more, or a setting is not positive.
    """
    count, height = (convert(settings[name], int, _SOURCE, f"page.{name}") for name in ("moments", "height"))
    for name, value in (("moments", count), ("height", height)):
        if value < 1:
            raise InputError(_SOURCE, f"page.{name}", "must be positive")
    scene = read_scene(folder / "scene.yaml")
    moments = pictures.read_moments(sources, folder, count)
    touching = touching_of(folder, scene)
    values = {
        "title": f"{sources.name.name}: from the film to a scene",
        "data": {"scene": "scene.yaml"},
        "begin": scene.begin,
        "poses": _photo(
            pictures.found_poses(moments, folder, height), "As they were found. Left blue, right orange. By frame."
        ),
        "mosaic": _photo(
            pictures.mosaic(moments, folder), "Each picture where the first camera would see it; the hips' way."
        ),
        "camera": _camera(folder),
        "mended": _photo(pictures.mended_poses(moments, folder, height), "Mended. Magenta: interpolated."),
        "notes": load_track(folder / "mended.npz").notes,
        "contacts": _photo(
            pictures.contacts_seen(moments, folder, touching, height), "Red: the foot touches something."
        ),
        "touching": _touching(folder, touching, scene),
        "bodies": Picture(
            pictures.bodies(moments, folder, height // 2),
            "Keypoints grey, humanoid blue: from the camera, from its left.",
        ),
        "fit": _fit(folder),
        "scene": _photo(
            pictures.scene_seen(moments, folder, scene, height), "Humanoid, floor (squares of 1 m), boxes."
        ),
        "plan": Picture(pictures.plan(folder, scene, height), "Dots: where feet stood, right orange, left blue."),
        "supports": _supports(folder, scene),
        "boxes": _boxes(scene),
        "scene_notes": scene.notes,
    }
    (out / "page.html").write_text(render("scene.html", **values), encoding="utf-8")


def _photo(frame: Frame, caption: str) -> Film:
    """As WebP, a tenth of a PNG: a film of one picture."""
    return Film([frame], 1.0, caption)


def _camera(folder: Path) -> Any:
    camera, track = clip_camera(folder), load_track(folder / "mended.npz")
    times = np.arange(len(track)) / track.fps
    lines = [Line(name, times, camera.to_first[:, k, 2]) for k, name in enumerate(("x", "y"))]
    return line_chart(lines, "time (s)", "the picture's corner in the first picture (px)", times[camera.degenerate])


def _touching(folder: Path, touching: np.ndarray, scene: Scene) -> Any:
    probability = read_arrays(folder / "contacts.npz", ("probability",))["probability"]
    times = np.arange(len(touching)) / scene.fps
    lines = [Line(f"{side}, network", times, probability[:, k]) for k, side in enumerate(FEET)]
    lines += [Line(f"{side}, used", times, 1.05 + 0.08 * k + 0.05 * touching[:, k]) for k, side in enumerate(FEET)]
    return line_chart(lines, "time (s)", "probability of a contact")


def _fit(folder: Path) -> Table:
    fit = json.loads((folder / "fit.json").read_text())
    rows = [
        ["the camera", fit["camera"]],
        ["it looks below the horizon (degrees)", Number(float(np.rad2deg(fit["pitch"])), 1)],
        ["its right side hangs lower (degrees)", Number(float(np.rad2deg(fit["roll"])), 1)],
        ["frames in balance, by which these were found (%)", Number(100 * fit["balanced"], 0)],
        ["humanoid off the keypoints on average (mm)", Number(float(np.mean(list(fit["off_mm"].values()))), 1)],
    ]
    return Table(["", ""], rows)


def _supports(folder: Path, scene: Scene) -> Any:
    body, supports = read_native(folder / "body.npz"), supports_of(folder)
    times = np.arange(len(body)) / scene.fps
    lines = [Line("pelvis", times, body.qpos[:, 2])]
    for foot, side in enumerate(FEET):
        heights = np.full(len(body), np.nan)
        for support in supports:
            if support.foot == foot:
                heights[support.start : support.stop] = support.height
        lines.append(Line(f"{side} foot stands", times, heights))
    return line_chart(lines, "time (s)", "height over the floor (m)")


def _boxes(scene: Scene) -> Table:
    def numbers(values: tuple[float, ...] | None) -> str:
        return "-" if values is None else ", ".join(f"{value:.2f}" for value in values)

    rows = []
    for box in scene.boxes:
        contacts = [f"{c.effector} {c.first}-{c.last}" for c in scene.contacts if c.touches == box.name]
        free = ", ".join(f"{name} {low:+.2f}..{high:+.2f}" for name, (low, high) in box.free.items())
        yaw = Number(None if box.yaw is None else float(np.rad2deg(box.yaw)), 0)
        cells = [numbers(box.place), Number(box.height, 2), numbers(box.size), yaw]
        rows.append([box.name, *cells, free, ", ".join(contacts)[:160]])
    return Table(["box", "place (m)", "height (m)", "size (m)", "yaw (degrees)", "free", "contacts, frames"], rows)
