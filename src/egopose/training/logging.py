"""What a run leaves behind to be read later: configuration, versions, git state, curves; and a live progress line."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import platform
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError

PACKAGES = ("egopose", "torch", "torchrl", "tensordict", "mujoco", "dm-control", "numpy", "hydra-core")
CURVES = "curves.csv"


class Scalars(Protocol):
    """A place for named numbers over the steps of a run."""

    def write(self, step: int, figures: Mapping[str, float]) -> None: ...

    def close(self) -> None: ...


class CsvCurves:
    """``curves.csv``: one row an iteration.

    Rows after ``iteration`` are dropped on opening, for a resumed run redoes them; so is one that was cut off when the
    process that wrote it was killed.

    A figure that comes up later (an evaluation's) becomes a new column; earlier rows are empty there.
    """

    def __init__(self, path: Path, iteration: int = 0) -> None:
        self.path = path
        self.columns: list[str] = []
        self.rows: list[dict[str, Any]] = []
        if path.is_file() and iteration > 0:
            with path.open(newline="", encoding="utf-8", errors="replace") as stream:
                lines = csv.DictReader(line.replace("\0", "") for line in stream)
                self.rows = [row for row in lines if None not in row.values() and _iteration(row) <= iteration]
            self.columns = list(self.rows[0]) if self.rows else []
        self._rewrite()

    def write(self, step: int, figures: Mapping[str, float]) -> None:
        row = {"steps": step, **figures}
        self.rows.append(row)
        if new := [name for name in row if name not in self.columns]:
            self.columns += new
            self._rewrite()
            return
        with self.path.open("a", newline="") as stream:
            csv.DictWriter(stream, self.columns).writerow(row)

    def close(self) -> None:
        """Nothing is held open."""

    def _rewrite(self) -> None:
        stream = io.StringIO(newline="")
        writer = csv.DictWriter(stream, self.columns)
        writer.writeheader()
        writer.writerows(self.rows)
        write_text_whole(self.path, stream.getvalue())


def _iteration(row: Mapping[str, Any]) -> float:
    """Of a row of ``curves.csv``; infinity where it cannot be read."""
    try:
        return float(row["iteration"])
    except (KeyError, ValueError):
        return float("inf")


class TensorBoardScalars:
    """TensorBoard events under ``folder``; works without network."""

    def __init__(self, folder: Path, purge_after: int | None = None) -> None:

        self.writer = SummaryWriter(str(folder), purge_step=None if purge_after is None else purge_after + 1)

    def write(self, step: int, figures: Mapping[str, float]) -> None:
        for name, value in figures.items():
            self.writer.add_scalar(name, value, step)

    def close(self) -> None:
        self.writer.close()


class WandbScalars:
    """Weights & Biases, by choice; ``mode: offline`` writes to the run directory alone."""

    def __init__(self, folder: Path, project: str, mode: str, config: Mapping[str, Any]) -> None:
        try:
            import wandb
        except ImportError:
            raise InputError("conf/logger/wandb.yaml", "logger", "needs `pip install egopose[wandb]`") from None
        self.run = wandb.init(project=project, mode=mode, dir=str(folder), name=folder.name, config=dict(config))

    def write(self, step: int, figures: Mapping[str, float]) -> None:
        self.run.log(dict(figures), step=step)

    def close(self) -> None:
        self.run.finish()


def build_loggers(
    settings: Mapping[str, Any], run_dir: Path, config: Mapping[str, Any], iteration: int = 0, steps: int = 0
) -> list[Scalars]:
    """``curves.csv`` always, and what ``logger.kind`` asks for: ``csv tensorboard wandb``.

    Raises:
        InputError: an unknown kind, or its package is not installed.
    """
    loggers: list[Scalars] = [CsvCurves(run_dir / CURVES, iteration)]
    kind = settings.get("kind")
    if kind == "tensorboard":
        loggers.append(TensorBoardScalars(run_dir / "tensorboard", steps if iteration else None))
    elif kind == "wandb":
        loggers.append(WandbScalars(run_dir, settings["project"], settings["mode"], config))
    elif kind != "csv":
        raise InputError("conf/logger", "kind", f"must be tensorboard, csv or wandb, not {kind!r}")
    return loggers


def write_provenance(run_dir: Path, config: Mapping[str, Any]) -> None:
    """``config.yaml`` (resolved), ``versions.json``, ``git.json`` into the run directory."""
    run_dir.mkdir(parents=True, exist_ok=True)
    write_text_whole(run_dir / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(dict(config))))
    write_text_whole(run_dir / "versions.json", json.dumps(versions(), indent=1))
    write_text_whole(run_dir / "git.json", json.dumps(git_state(Path(__file__).resolve().parent), indent=1))


def versions() -> dict[str, str]:
    """Of Python, the system and the packages that decide the results; packages not installed are left out."""
    out = {"python": platform.python_version(), "system": platform.platform()}
    for name in PACKAGES:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return out


def git_state(folder: Path) -> dict[str, Any]:
    """``{commit, dirty}`` of the checkout ``folder`` lies in; both None where there is none, or no git."""
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))}
    except (OSError, subprocess.SubprocessError):
        return {"commit": None, "dirty": None}


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=True, timeout=20)
    return done.stdout.strip()


class ProgressLine:
    """Progress and the time left: a live bar on a terminal, a plain line every ``interval`` s elsewhere.

    The time left is the smaller of what the remaining iterations take at the pace so far and what the budget leaves.

    Args:
        total: iterations of the run.
        done: iterations behind it already.
        max_seconds: the time budget, None for none.
        interval: seconds between plain lines.
    """

    def __init__(self, total: int, done: int = 0, max_seconds: float | None = None, interval: float = 10.0) -> None:
        self.total, self.first, self.max_seconds, self.interval = total, done, max_seconds, interval
        self.begin, self.last_line = time.monotonic(), float("-inf")
        self.live: Progress | None = None
        if sys.stderr.isatty():
            self.live = Progress(
                TextColumn("training"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[text]}"),
                console=Console(stderr=True),
            )
            self.task = self.live.add_task("training", total=total, completed=done, text="")
            self.live.start()

    def update(self, iteration: int, figures: Mapping[str, float]) -> None:
        text = "  ".join(
            f"{label} {figures[name]:{form}}"
            for name, label, form in (
                ("reward", "reward", ".3f"),
                ("episode_length", "frames", ".1f"),
                ("falls", "falls", ".0%"),
                ("kl", "kl", ".4f"),
                ("steps_per_s", "steps/s", ".0f"),
            )
            if name in figures
        )
        if self.live is not None:
            self.live.update(self.task, completed=iteration, text=text)
            return
        now = time.monotonic()
        if now - self.last_line >= self.interval or iteration >= self.total:
            self.last_line = now
            left = time.strftime("%H:%M:%S", time.gmtime(self.seconds_left(iteration, now)))
            print(f"iteration {iteration}/{self.total}  {text}  left {left}", file=sys.stderr, flush=True)

    def seconds_left(self, iteration: int, now: float) -> float:
        """Seconds until the end of the run, from the pace since it began."""
        elapsed = now - self.begin
        left = elapsed / max(1, iteration - self.first) * max(0, self.total - iteration)
        return left if self.max_seconds is None else min(left, max(0.0, self.max_seconds - elapsed))

    def close(self) -> None:
        if self.live is not None:
            self.live.stop()
