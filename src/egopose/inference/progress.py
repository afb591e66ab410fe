"""How far a long command is: one bar over all its stages with the time left, on standard error.

Where standard error is no terminal there is no bar, and each stage leaves one line with its seconds.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

_LINE = re.compile(r"^(\w[\w ]*): ([\d.]+) s$", re.MULTILINE)


class StageProgress:
    """Stages that follow each other, each over the same number of frames; a context manager.

    Args:
        stages: name -> what a frame costs in it, in any unit: the time left follows from these shares.
        frames: of each stage.
        console: where to; None for standard error.

    Attributes:
        seconds: of each stage that ended.
    """

    def __init__(self, stages: Mapping[str, float], frames: int, console: Console | None = None) -> None:
        self._console = Console(file=sys.stderr) if console is None else console
        self._costs, self._frames = dict(stages), max(frames, 1)
        self.seconds: dict[str, float] = {}
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        # The speed of the last half minute tells little at the border of two stages.
        self._bar = Progress(
            *columns, console=self._console, disable=not self._console.is_terminal, speed_estimate_period=120.0
        )
        self._task = self._bar.add_task("starting", total=self._frames * sum(self._costs.values()))

    def __enter__(self) -> StageProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[int], None]]:
        """A stage, by its name; gives what is to be told how many more frames are done."""
        cost, names = self._costs[name], list(self._costs)
        before = self._frames * sum(self._costs[one] for one in names[: names.index(name)])
        done = 0

        def advance(frames: int) -> None:
            nonlocal done
            done = min(done + frames, self._frames)
            self._bar.update(self._task, completed=before + done * cost)

        self._bar.update(self._task, description=name, completed=before)
        began = time.perf_counter()
        yield advance
        self.seconds[name] = time.perf_counter() - began
        advance(self._frames)
        if not self._console.is_terminal:
            print(f"{name}: {self.seconds[name]:.2f} s", file=self._console.file, flush=True)


def stage_seconds(text: str) -> dict[str, float]:
    """The stages and seconds among the lines of ``text`` that a :class:`StageProgress` left."""
    return {name: float(seconds) for name, seconds in _LINE.findall(text)}
