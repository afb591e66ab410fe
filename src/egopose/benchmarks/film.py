"""Estimates from film against true motion: a table of cameras by measures, one of motions, and how doubt is told.

Films are rendered by the virtual camera and read as ``egopose estimate`` reads them. The kinematic motion that the body
would follow is compared with the motion that was filmed.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from egopose.benchmarks.film_cameras import Chosen, Shot, read_exactly, read_film, shots, take, without_telemetry
from egopose.benchmarks.film_clips import SECONDS, bench_clip
from egopose.benchmarks.film_confidence import BAD, Judged, areas, bad_films, judged, separation, shuffled_films
from egopose.benchmarks.film_measures import measures
from egopose.benchmarks.film_table import by_camera, by_clip, tables
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io.native import read_native
from egopose.motion.rotations import Array

__all__ = ["run", "tables"]

#: Degrees: the camera with which motions are compared, where the choice has it.
_PITCH, _WIDTH = 20.0, 90.0
_BODY = ("checkpoint=pretrained:people_estimation", "planner=none")


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Render films, estimate the motion, and compare.

    Args:
        overrides: settings of :class:`~egopose.benchmarks.film_cameras.Chosen`, ``key=one,two``.
        rounds: seeds of each place, from 0. Even seeds film the walk's first half, which turns left; odd seeds its
            second half, which turns right.

    Returns:
        ``cameras``: a row a film. ``by_camera``: means and worst of each camera's films. ``clips`` and ``by_clip``:
        likewise of motions. ``confidence``: a row a film, good or bad. ``areas``: under the ROC curve, by kind of bad
        film, ``separation``: likewise of single parts and features. ``body``: a row a film. Only what was chosen.

    Raises:
        InputError: a setting is unknown or cannot be.
        RuntimeError: no OpenGL here.
    """
    chosen = Chosen.of(overrides)
    if rounds < 1:
        raise InputError("bench film", "rounds", f"{rounds}; at least 1")
    torch.set_num_threads(1)
    humanoid = humanoid_of(compose_config("train"))
    parts = set(chosen.part) | ({"body"} if chosen.body else set())
    result: dict[str, Any] = {"rounds": rounds}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "cameras" in parts:
            result["cameras"] = _cameras(humanoid, chosen, rounds, folder)
            result["by_camera"] = by_camera(result["cameras"])
        if parts & {"clips", "confidence"}:
            films = _clips(humanoid, chosen, "confidence" in parts, folder)
            good = [film for film in films if film.row["kind"] == "good"]
            # Good films of other lenses only stand beside bad ones.
            result["clips"] = [*_exact(humanoid, chosen), *(film.row for film in good if film.row["clip"])]
            result["by_clip"] = by_clip(result["clips"])
            if "confidence" in parts:
                result["confidence"] = [film.row for film in films]
                result["areas"], result["separation"] = areas(films), separation(films)
        if "body" in parts:
            result["body"] = _bodies(humanoid, chosen, folder)
    return result


def _cameras(humanoid: HumanoidModel, chosen: Chosen, rounds: int, folder: Path) -> list[dict[str, Any]]:
    """A row for each film and way to read it."""
    walk, rows = bench_clip("walk", humanoid), []
    every = shots(chosen, range(rounds))
    with _bar("cameras", len(every)) as advance:
        for shot in every:
            qpos = _piece(_half(walk, shot.seed), chosen.seconds)
            for imu, film in _read(humanoid, qpos, shot, chosen, folder):
                rows.append({**shot.about("walk", imu), **film.row})
            advance()
    return rows


def _clips(humanoid: HumanoidModel, chosen: Chosen, with_bad: bool, folder: Path) -> list[Judged]:
    """Films of every motion by the usual camera in every place, and bad films where they are asked for."""
    usual = Shot(_usual(chosen.pitch, _PITCH), _usual(chosen.width, _WIDTH), False, "", 0, chosen.pixels)
    films: list[Judged] = []
    every = [
        (clip, replace(usual, place=place, seed=number))
        for clip in chosen.clip
        for number, place in enumerate(chosen.place)
    ]
    with _bar("clips", len(every) + (len(BAD) * len(chosen.place) if with_bad else 0)) as advance:
        for clip, shot in every:
            qpos = _piece(bench_clip(clip, humanoid), chosen.seconds)
            for imu, film in _read(humanoid, qpos, shot, chosen, folder):
                films.append(replace(film, row={"kind": "good", **shot.about(clip, imu), **film.row}))
            if with_bad and clip == "walk":
                films += shuffled_films(humanoid, folder, shot)
            advance()
        if with_bad:
            for number, place in enumerate(chosen.place):
                shot = replace(usual, place=place, seed=number)
                films += bad_films(humanoid, shot, chosen.seconds, folder, advance)
    return films


def _exact(humanoid: HumanoidModel, chosen: Chosen) -> list[dict[str, Any]]:
    """A row for each motion as it would be read if the camera's motion were known: ``imu`` is ``exact``."""
    pitch, rows = _usual(chosen.pitch, _PITCH), []
    for clip in chosen.clip:
        qpos = _piece(bench_clip(clip, humanoid), chosen.seconds)
        film = judged(humanoid, read_exactly(humanoid, qpos, pitch), qpos)
        rows.append({"clip": clip, "pitch": pitch, "imu": "exact", **film.row})
    return rows


def _read(
    humanoid: HumanoidModel, qpos: Array, shot: Shot, chosen: Chosen, folder: Path
) -> Iterator[tuple[bool, Judged]]:
    """A film of a motion, read with and without its telemetry as chosen."""
    path = take(humanoid, qpos, shot, folder)
    for imu in chosen.imu:
        reading = read_film(humanoid, path if imu else without_telemetry(path), shot.camera(imu))
        yield imu, judged(humanoid, reading, qpos)


def _bodies(humanoid: HumanoidModel, chosen: Chosen, folder: Path) -> list[dict[str, Any]]:
    """The whole command, without a planner, on a film of the walk in every place."""
    rows = []
    qpos = _piece(bench_clip("walk", humanoid), chosen.seconds)
    with _bar("body", len(chosen.place)) as advance:
        for number, place in enumerate(chosen.place):
            usual = _usual(chosen.pitch, _PITCH), _usual(chosen.width, _WIDTH)
            shot = Shot(*usual, False, place, number, chosen.pixels)
            path, out = take(humanoid, qpos, shot, folder), folder / f"body_{number}"
            command = [sys.executable, "-m", "egopose.estimate", f"video={path}", f"out={out}", "sees=head_signal"]
            done = subprocess.run([*command, *_BODY], capture_output=True, text=True, check=False)
            if done.returncode:
                last = (done.stderr.strip() or "failed").splitlines()[-1]
                raise InputError("bench film", "egopose estimate", last)
            estimate = read_native(out / "estimate.npz").qpos
            count = min(len(estimate), len(qpos))
            rows.append({**shot.about("walk", True), **measures(humanoid, estimate[:count], qpos[:count])})
            advance()
    return rows


def _half(walk: Array, seed: int) -> Array:
    frames = round(0.5 * SECONDS["walk"] * 30.0)
    return walk[frames:] if seed % 2 else walk[: frames + 1]


def _piece(qpos: Array, seconds: float) -> Array:
    return qpos[: round(seconds * 30.0) + 1]


def _usual(given: tuple[float, ...], wanted: float) -> float:
    return min(given, key=lambda one: abs(one - wanted))


@contextmanager
def _bar(label: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar of films on standard error; gives what is to be told that one is done."""
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TextColumn("films"), TimeRemainingColumn())
    with Progress(*columns, console=Console(file=sys.stderr)) as bar:
        task = bar.add_task(label, total=total)
        yield lambda: bar.advance(task)
