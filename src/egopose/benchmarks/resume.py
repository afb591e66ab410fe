"""Training that is killed again and again beside the same training left alone."""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from egopose.benchmarks import processes
from egopose.benchmarks.killed import LOADED, NOTES, PHASES, Notes, content, train_or_go_on, trainer_state, unequal
from egopose.checkpoint.checkpoint import FOLDER, find_checkpoint
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.pipeline.dataset import motion_dataset
from egopose.training.logging import CURVES

#: A whole training made small: what is lost or altered by a kill does not depend on the size.
SMALL = (
    "collector.num_envs=4",
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
#: Share of the kills that come before the first iteration of a start; the others up to so many iterations after it.
_BEFORE = 0.3
_WINDOW = 4
_PATIENCE = 30.0  # s for what a killed training leaves behind to end
#: Processes of Ray's own that outlive its killed head: for a minute they try to tell it of that. They hold nothing of a
#: training: the next start does not wait for them, the benchmark's end does.
_RAY_AGENTS = ("ray::DashboardAgent", "ray::RuntimeEnvAgent", "ray/dashboard/agent.py", "ray/_private/runtime_env")
_AGENTS_PATIENCE = 120.0
_TIMES = ("steps_per_s", "seconds_collect", "seconds_gae", "seconds_update")


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """Kill a training with SIGKILL at ``rounds`` random moments, resume it each time, and compare its end.

    It is training's own program, in a process of its own, on the default clips with noise for context; only Python's
    imports are done beforehand, in a server process that each start, and each worker of it, is forked from.

    Args:
        overrides: of the training configuration (``collector=multi_sync``).
        rounds: kills.

    Returns:
        ``kills``, ``kills_in`` each phase of a start, ``kills_in_a_write`` that left a half-written checkpoint,
        ``kills_before_a_checkpoint``. ``bit_equal``: whether every tensor and random generator of the last checkpoint
        is that of the uninterrupted run, bit by bit, else ``differs`` names them;
        ``curves_equal``: the same of the figures in ``curves.csv``; ``curves_whole``: whether every iteration stands
        there once. ``loaded``: how many starts came to take over a checkpoint; ``loaded_equal``: whether each took the
        newest whole one on the disk and then held, workers included, what stands in it, bit by bit; ``most_lost``
        iterations at a kill. ``orphans``: processes of killed trainings that were left half a minute later, Ray's
        agents two minutes after the end; ``seconds_until_gone`` of the slowest other, the agents aside. ``iterations``,
        ``collector``, ``seconds`` in all and ``seconds_a_start`` until the first iteration (median).

    Raises:
        InputError: a setting is unknown or out of range.
        RuntimeError: a training ended by itself with an error; says which.
    """
    if rounds < 1:
        raise InputError("bench resume", "rounds", f"must be at least 1, not {rounds}")
    # A start gets two done on average, less what its kill loses: so it does not come to its end before the last kill.
    iterations = f"algo.iterations={3 * rounds + 6}"
    config = compose_config("train", [*SMALL, iterations, *overrides])
    motion_dataset(config)  # prepares the data where that has not been done yet
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["egopose.train", "egopose.pipeline", "egopose.training.loop", "egopose.benchmarks.killed", "torch.utils.data"]
    )
    begin = time.monotonic()
    server = context.Process(target=time.sleep, args=(0,))  # the server imports at its first process
    server.start()
    server.join()
    with tempfile.TemporaryDirectory(prefix="egopose-resume-") as place:
        alone, killed = Path(place) / "alone", Path(place) / "killed"
        _finish(_start(context, config, alone, 0), alone)
        campaign = _Campaign(context, config, killed, random.Random(int(config["seed"])))
        for _ in range(rounds):
            campaign.kill()
        _finish(_start(context, config, killed, rounds), killed)
        campaign.wait_for_agents()
        end = find_checkpoint(killed)
        differs = unequal(content(find_checkpoint(alone)), content(end))
        curves = _curves(killed)
        loads = [json.loads(line) for line in killed.with_suffix(LOADED).read_text().splitlines()]
        return {
            "kills": campaign.kills.total(),
            "bit_equal": not differs,
            "curves_equal": _curves(alone) == curves,
            "curves_whole": [float(row["iteration"]) for row in curves] == list(range(1, len(curves) + 1)),
            "differs": differs,
            "loaded": len(loads),
            "loaded_equal": not any(load["differs"] for load in loads) and campaign.newest_taken(loads),
            "loaded_differs": sorted({name for load in loads for name in load["differs"]}),
            "most_lost": campaign.most_lost,
            "orphans": campaign.orphans,
            "seconds_until_gone": campaign.seconds_until_gone,
            "kills_in": {phase: campaign.kills[phase] for phase in PHASES},
            "kills_in_a_write": campaign.in_a_write,
            "kills_before_a_checkpoint": campaign.before_a_checkpoint,
            "iterations": trainer_state(end)["iteration"],
            "collector": config["collector"]["kind"],
            "seconds": time.monotonic() - begin,
            "seconds_a_start": median(campaign.starts),
        }


class _Campaign:
    """Starts and kills of one training, and what was seen of them.

    Args:
        context: that processes start in.
        config: of the training, resolved.
        folder: its run directory.
        draw: of the moments.
    """

    def __init__(self, context: Any, config: Mapping[str, Any], folder: Path, draw: random.Random) -> None:
        self.context, self.config, self.folder, self.draw = context, config, folder, draw
        self.kills: Counter[str] = Counter()
        self.starts: list[float] = []
        self.newest: list[str | None] = [None]
        self.in_a_write = self.before_a_checkpoint = self.most_lost = self.orphans = 0
        self.seconds_until_gone = 0.0
        self._notes = Notes(folder.with_suffix(NOTES))
        self._iteration = 0.5  # s; of the last one seen
        self._agents: set[processes.Process] = set()

    def kill(self) -> None:
        """Start it, kill it at a random moment, and wait for all its processes to end."""
        self._notes.clear()
        others = processes.family(os.getpid())
        process = _start(self.context, self.config, self.folder, len(self.newest) - 1)
        # The first start is to come as far as an iteration: it tells how long that takes.
        if self.starts and self.draw.random() < _BEFORE:
            self._wait(process, 0.0, self.draw.uniform(0.0, median(self.starts)))
        else:
            self._wait(process, self.draw.uniform(0.0, _WINDOW))
        family = processes.family(os.getpid()) - others
        process.kill()
        process.join()
        if process.exitcode != -9:
            _finish(process, self.folder)
            raise RuntimeError("training came to its end before it was killed")
        family |= processes.family(os.getpid()) - others
        agents = processes.of_commands(family, *_RAY_AGENTS)
        self._agents |= agents
        seconds, left = self._left(family - agents, _PATIENCE)
        self.seconds_until_gone = max(self.seconds_until_gone, 0.0 if left else seconds)

        phase, _, done = self._notes.read()
        self.kills[phase] += 1
        root = self.folder / FOLDER
        self.in_a_write += any(root.glob(".*.part-*"))
        newest = find_checkpoint(self.folder) if any(root.glob("checkpoint-*")) else None
        self.before_a_checkpoint += newest is None
        self.newest.append(None if newest is None else newest.name)
        if done:
            self.most_lost = max(self.most_lost, done - (trainer_state(newest)["iteration"] if newest else 0))

    def wait_for_agents(self) -> None:
        """For what Ray takes longer to end."""
        self._left(self._agents, _AGENTS_PATIENCE)

    def _left(self, family: set[processes.Process], patience: float) -> tuple[float, set[processes.Process]]:
        seconds, left = processes.end_of(family, patience)
        self.orphans += len(left)
        processes.kill(left)
        return seconds, left

    def newest_taken(self, loads: Sequence[Mapping[str, Any]]) -> bool:
        """Whether each start that came so far took over what was the newest whole checkpoint at the kill before it."""
        return all(load["checkpoint"] == self.newest[load["start"]] for load in loads)

    def _wait(self, process: Any, count: float, most: float = math.inf) -> None:
        """Until ``count`` iterations after a start are done, the last one in part; ``most`` s for the start."""
        begin = time.monotonic()
        first: float | None = None
        while process.is_alive() and (first is not None or time.monotonic() - begin < most):
            phase, here, _ = self._notes.read()
            if first is None and phase not in ("start", "load"):
                first = time.monotonic()
                self.starts.append(first - begin)
            if first is not None and here >= int(count):
                self._iteration = (time.monotonic() - first) / here if here else self._iteration
                process.join(self._iteration * (count - int(count)))
                return
            time.sleep(0.002)


def _start(context: Any, config: Mapping[str, Any], folder: Path, number: int) -> Any:
    process = context.Process(target=train_or_go_on, args=(dict(config), folder, number))
    process.start()
    return process


def _finish(process: Any, folder: Path) -> None:
    process.join()
    if process.exitcode != 0:
        lines = folder.with_suffix(".log").read_text(errors="replace").strip().splitlines()
        raise RuntimeError(f"training ended with code {process.exitcode}: {' | '.join(lines[-5:])}")


def _curves(folder: Path) -> list[dict[str, Any]]:

    with (folder / CURVES).open(newline="") as stream:
        return [{key: value for key, value in row.items() if key not in _TIMES} for row in csv.DictReader(stream)]
