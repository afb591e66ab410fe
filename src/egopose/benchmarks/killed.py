"""The process that ``bench resume`` kills: training's own program, which notes where it is and what it has loaded."""

from __future__ import annotations

import functools
import json
import mmap
import multiprocessing.forkserver
import os
import shutil
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from egopose.checkpoint.checkpoint import read_json
from egopose.collection.collectors import transform_state
from egopose.collection.workers import Workers
from egopose.pipeline.dataset import motion_dataset
from egopose.pipeline.training import run_job
from egopose.training import loop
from egopose.training.ppo import PPO

#: What a training is doing; ``load`` is taking over a checkpoint.
PHASES = ("start", "load", "collect", "update", "save")
#: Beside the run directory: :class:`Notes`; a line of JSON for each checkpoint loaded: start, name, what differed.
NOTES = ".notes"
LOADED = ".loaded.jsonl"
_NOTES = struct.Struct("<3i")


class Notes:
    """Phase, iterations done in this process and by the whole run, in memory that outlives the process.

    Args:
        path: of the file that is mapped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            path.write_bytes(bytes(_NOTES.size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _NOTES.size)

    def read(self) -> tuple[str, int, int]:
        """``(phase, iterations of this process, iterations of the run)``."""
        phase, here, whole = _NOTES.unpack(self._memory[:])
        return PHASES[phase], here, whole

    def clear(self) -> None:
        """For the next process."""
        self._memory[:] = _NOTES.pack(0, 0, 0)

    def note(self, phase: str | None = None, whole: int | None = None) -> None:
        """A phase that begins, or an iteration that is done."""
        now, here, before = _NOTES.unpack(self._memory[:])
        now = now if phase is None else PHASES.index(phase)
        self._memory[:] = _NOTES.pack(now, here + (whole is not None), before if whole is None else whole)


def train_or_go_on(config: dict[str, Any], folder: Path, number: int) -> None:
    """What the killed process does: the job of a sweep in ``folder``, from its beginning or its last checkpoint."""
    with folder.with_suffix(".log").open("a") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    # Workers too come from the server that this process was forked from, in place of one of its own that would import
    # everything anew. All else of how they start and end is as it is from the command line.
    server: Any = multiprocessing.forkserver._forkserver
    server.ensure_running = lambda: None
    _observe(Notes(folder.with_suffix(NOTES)), number)
    run_job(config, folder, motion_dataset(config))


def _observe(notes: Notes, number: int) -> None:
    """Have training's functions note where they are, and compare what is loaded with its checkpoint."""

    def before(owner: Any, name: str, phase: str) -> None:
        function = getattr(owner, name)

        @functools.wraps(function)
        def noting(*args: Any, **settings: Any) -> Any:
            notes.note(phase)
            return function(*args, **settings)

        setattr(owner, name, noting)

    def iterate(run: loop.Run, batches: Any) -> Mapping[str, float]:
        figures = once(run, batches)
        notes.note(whole=run.counters.iteration)
        return figures

    def restore(run: loop.Run, path: str | Path) -> None:
        load(run, path)
        differs = loaded_otherwise(run, Path(path))
        with run.folder.with_suffix(LOADED).open("a") as file:
            file.write(json.dumps({"start": number, "checkpoint": Path(path).name, "differs": differs}) + "\n")

    module: Any = loop
    once: Callable[..., Any] = module.iterate
    load: Callable[..., Any] = loop.Run.restore
    module.iterate = iterate
    module.Run.restore = restore
    before(loop, "iterate", "collect")
    before(PPO, "advantages", "update")
    before(loop.Run, "save", "save")
    before(loop.Run, "restore", "load")


def loaded_otherwise(run: Any, checkpoint: Path) -> list[str]:
    """Names of what a run that was just restored holds otherwise than its checkpoint, bit by bit.

    What it holds is saved once more, worlds and random numbers as its workers themselves tell them, and compared file
    by file; the parameters and the normaliser's statistics of every worker with the learner's.
    """
    collector, differs = run.collector, []
    if isinstance(collector, Workers):
        policy, transforms = run.ppo.actor.state_dict(), transform_state(collector)
        reports, policies = collector.reports(), collector.policy_states()
        collector.simulation = [report["simulation"] for report in reports]
        for number, (report, state) in enumerate(zip(reports, policies, strict=True)):
            differs += [f"worker{number}.{name}" for name in unequal(policy, state)]
            differs += [f"worker{number}.{name}" for name in unequal(transforms, report["transforms"])]
    again = run.folder.with_suffix(".again")
    shutil.rmtree(again, ignore_errors=True)
    run.checkpoint().save(again, metadata={"schema": 1})
    return differs + unequal(content(checkpoint), content(again))


def unequal(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Keys whose values differ, or that one lacks."""

    def same(a: Any, b: Any) -> bool:
        return torch.equal(a, b) if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor) else bool(a == b)

    return sorted(
        key
        for key in set(first) | set(second)
        if key not in first or key not in second or not same(first[key], second[key])
    )


def content(checkpoint: Path) -> dict[str, bytes | dict[str, Any]]:
    """Every file of every component; of the counters all but the clock."""
    out: dict[str, bytes | dict[str, Any]] = {}
    for file in (checkpoint / "components").rglob("*"):
        if file.is_file():
            out[file.relative_to(checkpoint / "components").as_posix()] = file.read_bytes()
    name = next(name for name in out if name.endswith("-trainer_state/value.json"))
    return {**out, name: trainer_state(checkpoint)}


def trainer_state(checkpoint: Path) -> dict[str, Any]:
    """A checkpoint's counters but for the clock."""
    return {key: value for key, value in read_json(checkpoint, "trainer_state").items() if key != "seconds"}
