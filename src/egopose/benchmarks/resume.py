"""Training that is killed again and again beside the same training left alone."""

from __future__ import annotations

import csv
import multiprocessing
import os
import random
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.errors import InputError

#: A whole training made small: what is lost or altered by a kill does not depend on the size.
SMALL = (
    "collector.worlds=4",
    "collector.physics_threads=1",
    "collector.update_threads=1",
    "algo.steps_per_iteration=64",
    "algo.minibatch_size=32",
    "model.hidden=[32,16]",
    "model.critic.hidden=[32,16]",
    "training.checkpoint_every=2",  # a kill then falls within an iteration, between two, or into a checkpoint
    "training.keep_last=2",
    "training.evaluate_every=0",
    "logger=csv",
)
_ITERATIONS_A_KILL = 8
#: A kill comes after up to this many iterations' time beyond a start; on average a third of them get done.
_WINDOW = 7
_TIMES = ("steps_per_s", "seconds_collect", "seconds_gae", "seconds_update")


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Kill a training with SIGKILL at ``rounds`` random moments, resume it each time, and compare its end.

    It is training's own program, in a process of its own, on the default clips with noise for context; only Python's
    imports are done beforehand, in a server process that each start is forked from.

    Args:
        overrides: of the training configuration (``collector=multi_sync collector.workers=2``).
        rounds: kills.

    Returns:
        ``kills``; ``bit_equal``: whether every tensor and random generator of the last checkpoint is that of the
        uninterrupted run, bit by bit; ``curves_equal``: whether every iteration stands once in ``curves.csv`` with the
        same figures; ``kills_in_a_write``: how many left a half-written checkpoint; ``kills_before_a_checkpoint``;
        ``iterations``; ``collector``; ``seconds`` in sum and ``seconds_a_start`` until the first new checkpoint.

    Raises:
        InputError: a setting is unknown or out of range.
        RuntimeError: a training ended by itself with an error; says which.
    """
    from egopose import pipeline
    from egopose.training.checkpoint import FOLDER, find_checkpoint

    if rounds < 1:
        raise InputError("bench resume", "rounds", f"must be at least 1, not {rounds}")
    iterations = f"algo.iterations={_ITERATIONS_A_KILL * rounds}"
    config = pipeline.compose_config("train", [*SMALL, iterations, *overrides])
    pipeline.motion_material(config)  # prepares the data where that has not been done yet
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["egopose.train", "egopose.pipeline", "egopose.training.loop", "torch.utils.data"])
    begin = time.monotonic()
    draw = random.Random(int(config["seed"]))
    server = context.Process(target=time.sleep, args=(0,))  # the server imports at its first process
    server.start()
    server.join()
    with tempfile.TemporaryDirectory(prefix="egopose-resume-") as place:
        alone, killed = Path(place) / "alone", Path(place) / "killed"
        start, iteration = _left_alone(context, config, alone)
        kills = in_a_write = before = 0
        while kills < rounds:
            process = _start(context, config, killed)
            process.join(draw.uniform(0.0, start + _WINDOW * iteration))
            process.kill()
            process.join()
            if process.exitcode != -9:
                break  # it came to its end, or to an error, which the last start shows
            kills += 1
            in_a_write += any((killed / FOLDER).glob(".*.part-*"))
            before += not any((killed / FOLDER).glob("checkpoint-*"))
        _finish(_start(context, config, killed), killed)
        ends = [find_checkpoint(folder) for folder in (alone, killed)]
        return {
            "kills": kills,
            "bit_equal": _content(ends[0]) == _content(ends[1]),
            "curves_equal": _curves(alone) == _curves(killed),
            "kills_in_a_write": in_a_write,
            "kills_before_a_checkpoint": before,
            "iterations": _trainer_state(ends[1])["iteration"],
            "collector": config["collector"]["kind"],
            "seconds": time.monotonic() - begin,
            "seconds_a_start": start,
        }


def _left_alone(context: Any, config: Mapping[str, Any], folder: Path) -> tuple[float, float]:
    """Train without interruption; seconds until the first checkpoint, and of an iteration."""
    from egopose.training.checkpoint import FOLDER

    begin = time.monotonic()
    process = _start(context, config, folder)
    while process.is_alive() and not any((folder / FOLDER).glob("checkpoint-*")):
        time.sleep(0.005)
    start = time.monotonic() - begin
    _finish(process, folder)
    rest = int(config["algo"]["iterations"]) - int(config["training"]["checkpoint_every"])
    return start, max(0.0, time.monotonic() - begin - start) / max(1, rest)


def _start(context: Any, config: Mapping[str, Any], folder: Path) -> Any:
    process = context.Process(target=train_or_go_on, args=(dict(config), folder))
    process.start()
    return process


def _finish(process: Any, folder: Path) -> None:
    process.join()
    if process.exitcode != 0:
        lines = folder.with_suffix(".log").read_text(errors="replace").strip().splitlines()
        raise RuntimeError(f"training ended with code {process.exitcode}: {' | '.join(lines[-5:])}")


def train_or_go_on(config: dict[str, Any], folder: Path) -> None:
    """What the killed process does: the job of a sweep in ``folder``, from its beginning or its last checkpoint."""
    from egopose import pipeline
    from egopose.train import run_job

    with folder.with_suffix(".log").open("a") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    run_job(config, folder, pipeline.motion_material(config))


def _content(checkpoint: Path) -> dict[str, bytes | dict[str, Any]]:
    """Every file of every component; of the counters all but the clock."""
    files = (p for p in (checkpoint / "components").rglob("*") if p.is_file())
    content: dict[str, bytes | dict[str, Any]] = {p.relative_to(checkpoint).as_posix(): p.read_bytes() for p in files}
    name = next(name for name in content if name.endswith("-trainer_state/value.json"))
    return {**content, name: _trainer_state(checkpoint)}


def _trainer_state(checkpoint: Path) -> dict[str, Any]:
    from egopose.training.checkpoint import read_json

    return {key: value for key, value in read_json(checkpoint, "trainer_state").items() if key != "seconds"}


def _curves(folder: Path) -> list[dict[str, Any]]:
    from egopose.training.logging import CURVES

    with (folder / CURVES).open(newline="") as stream:
        return [{key: value for key, value in row.items() if key not in _TIMES} for row in csv.DictReader(stream)]
