"""The page of a reconstruction: what the simulated body did, beside the film and the kinematic input."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.evaluation import reconstruction_pictures as pictures
from egopose.evaluation.charts import Chart, Line, line_chart
from egopose.evaluation.page import Film, Number, Table, render
from egopose.evaluation.reconstruction_findings import Findings
from egopose.evaluation.scene_pictures import Moments, read_moments
from egopose.inference.reconstruction import FITTED, Reconstruction
from egopose.inference.scene_stages import Sources, film_of, load_projection
from egopose.scene.movement_numbers import Row
from egopose.scene.scene_file import Box, read_scene
from egopose.vision.video import Frame


@dataclass(frozen=True)
class ReconstructionPageSettings:
    """See ``conf/report.yaml``.

    Args:
        moments: pictured, evenly over the clip.
        size: px of a panel.
        sentences: failures told at most.

    Raises:
        InputError: one is not positive.
    """

    moments: int
    size: int
    sentences: int

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise InputError("conf/report.yaml", f"reconstruction.{name}", "must be positive")


def write_reconstruction_page(found: Reconstruction, settings: ReconstructionPageSettings, out: Path) -> Path:
    """Write the page.

    Args:
        found: without ``projection.npz`` in its folder no film is shown; where the film is gone ``poses.npz`` tells its
            size.
        settings: how much is shown.
        out: the HTML file; its folder must exist.

    Raises:
        InputError: a file of the folder is missing or damaged.
    """
    findings = Findings(found)
    failures = findings.failures()
    grids, why_none = _grids(found, settings)
    values = {
        "title": f"{found.folder.resolve().name}: the reconstruction",
        "data": {"numbers": [_plain(row) for row in found.numbers.rows()], "failures": failures},
        "motion": found.path.name,
        "begin": found.scene.begin,
        "fps": found.motion.fps,
        "failures": failures[: settings.sentences],
        "more": max(0, len(failures) - settings.sentences),
        "quality": _quality(findings),
        "grids": grids,
        "why_none": why_none,
        "height": _height(found),
        "force": _force(found),
        "contacts": _contacts(findings),
        "contact_table": _contact_table(findings),
        "boxes": _boxes(found),
        "numbers": _numbers(found.numbers.summary()),
        "details": _numbers(found.numbers.details()),
    }
    out.write_text(render("reconstruction.html", **values), encoding="utf-8")
    return out


def _grids(found: Reconstruction, settings: ReconstructionPageSettings) -> tuple[list[Film], str]:
    """Pictures, and why there are no renderings among them."""
    path = found.folder / "projection.npz"
    projection = load_projection(path) if path.is_file() else None
    moments = _moments(found, settings.moments, projection is not None)
    try:
        made = pictures.moment_grids(found, projection, moments, settings.size)
        said = f"From above: {', '.join(pictures.row_names(projection is not None))}."
        said += "" if projection is None else " In the film: kinematic grey, simulated green."
        return [_photo(grid, said) for grid in made], ""
    except RuntimeError as error:
        if projection is None:
            return [], str(error)
        strip = pictures.film_strip(found, projection, moments, settings.size)
        return [_photo(strip, "The film: kinematic body grey, simulated body green.")], str(error)


def _moments(found: Reconstruction, count: int, film: bool) -> Moments:
    if not film:
        numbers = np.linspace(0, len(found.motion) - 1, count).round().astype(int)
        return Moments(tuple(dict.fromkeys(numbers.tolist())), ())
    sources = Sources(film_of(found.folder), found.folder / "poses.npz", found.motion.fps)
    return read_moments(sources, found.folder, count)


def _photo(frame: Frame, caption: str) -> Film:
    return Film([frame], 1.0, caption)


def _plain(row: Row) -> dict[str, Any]:
    value = row.value if np.isfinite(row.value) else None
    return {"what": row.what, "side": row.side, "value": value, "unit": row.unit, "frames": list(row.frames)}


def _quality(findings: Findings) -> Table:
    both = findings.kinematic, findings.simulated
    wanted = sum(int(one.wanted.sum()) for one in findings.contacts)
    met = sum(int((one.wanted & one.found).sum()) for one in findings.contacts)
    root, joints = findings.root_distance, findings.joint_distance
    rows: list[list[Any]] = [
        ["a foot slides while the film says it touches (mm/s)", *(Number(1e3 * one.slide, 0) for one in both)],
        ["a foot slides while it touches in the simulation (mm/s)", "", Number(1e3 * findings.own_slide, 0)],
        ["the body reaches into the ground, mean (mm)", *(Number(1e3 * one.depth, 1) for one in both)],
        ["at its deepest (mm)", *(Number(1e3 * one.deepest, 0) for one in both)],
        ["frames deeper than 20 mm (%)", *(Number(100 * one.sunk, 0) for one in both)],
        ["wanted contacts that are there (% of frames)", "", Number(100 * met / wanted if wanted else None, 0)],
        ["root off the kinematic one, mean (m)", "", Number(float(root.mean()), 2)],
        ["root off the kinematic one, at most (m)", "", Number(float(root.max()), 2)],
        ["joints off the kinematic ones, roots laid together, mean (mm)", "", Number(1e3 * float(joints.mean()), 0)],
    ]
    return Table(["", "kinematic", "simulated"], rows)


def _height(found: Reconstruction) -> Chart:
    times = np.arange(len(found.motion)) / found.motion.fps
    lines = [Line("kinematic", times, found.clip.body.qpos[:, 2]), Line("simulated", times, found.motion.qpos[:, 2])]
    return line_chart(lines, "time (s)", "height of the root over the floor (m)")


def _force(found: Reconstruction) -> Chart:
    forces, numbers = found.forces, found.numbers
    times = np.arange(len(found.motion)) / found.motion.fps
    upward = forces.per_frame(forces.force[..., 2].sum(axis=2)) / forces.weight
    lines = [Line("all contacts", times, upward.sum(axis=1))]
    for side in ("Right", "Left"):
        row = found.humanoid.skeleton.index(f"{side}Foot")
        lines.append(Line(f"{side.lower()} foot", times, upward[:, row]))
    marks = [at / forces.rate for flight in numbers.flights for at in (flight.begin, flight.end)]
    return line_chart(lines, "time (s)", "vertical force of the ground (body weights)", marks)


def _contacts(findings: Findings) -> Chart:
    times = np.arange(len(findings.found.motion)) / findings.found.motion.fps
    lines, level = [], 0.0
    for effector in dict.fromkeys(one.effector for one in findings.contacts):
        own = [one for one in findings.contacts if one.effector == effector]
        for name in ("wanted", "found"):
            on = np.any([getattr(one, name) for one in own], axis=0)
            lines.append(Line(f"{effector.replace('_', ' ')}, {name}", times, level + 0.8 * on))
            level += 1.0
        level += 0.5
    return line_chart(lines, "time (s)", "contacts")


def _contact_table(findings: Findings) -> Table:
    rows: list[list[Any]] = []
    for one in findings.contacts:
        wanted, met = int(one.wanted.sum()), int((one.wanted & one.found).sum())
        beyond = int((one.found & ~one.wanted).sum())
        cells = [Number(wanted, 0), Number(met, 0), Number(beyond, 0)]
        rows.append([one.effector.replace("_", " "), one.surface, *cells])
    return Table(["", "on", "frames wanted", "of these found", "found but not wanted"], rows)


def _boxes(found: Reconstruction) -> Table:
    path = found.folder / FITTED
    fitted = {box.name: box for box in read_scene(path).boxes} if path.is_file() else {}
    rows = []
    for first, simulated in zip(found.clip.scene.boxes, found.scene.boxes, strict=True):
        for whose, box in (("first guess", first), ("fitted", fitted.get(first.name)), ("simulated", simulated)):
            if box is not None:
                rows.append([first.name, whose, *_box_cells(box)])
    return Table(["box", "", "height (m)", "place (m)", "yaw (degrees)"], rows)


def _box_cells(box: Box) -> Iterator[Any]:
    yield Number(box.height, 2)
    yield "-" if box.place is None else ", ".join(f"{value:.2f}" for value in box.place)
    yield Number(None if box.yaw is None else float(np.rad2deg(box.yaw)), 0)


def _numbers(rows: Sequence[Row]) -> Table:
    cells = []
    for row in rows:
        first, last = (f"{frame:.1f}" for frame in row.frames)
        decimals = 0 if abs(row.value) >= 100 else 2
        cells.append(
            [
                row.what,
                row.side,
                Number(row.value, decimals),
                row.unit,
                first if first == last else f"{first} to {last}",
            ]
        )
    return Table(["", "side", "value", "unit", "frames"], cells)
