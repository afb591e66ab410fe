"""Processes of the benchmark's own family, and the end of those that a killed one leaves behind (Linux)."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

#: A process by number and time of its start, in the kernel's ticks: numbers are given out again.
Process = tuple[int, int]


def family(root: int) -> set[Process]:
    """All that ``root`` and what it started have started and that has not ended; without ``root``."""
    result = _processes()
    known, grown = {root}, True
    while grown:
        more = {pid for pid, (parent, _) in result.items() if parent in known} - known
        known |= more
        grown = bool(more)
    return {(pid, result[pid][1]) for pid in known if pid != root and pid in result}


def end_of(left: set[Process], seconds: float) -> tuple[float, set[Process]]:
    """Wait for processes to end; s until the last had, or until there was no more patience, and those left then."""
    begin = time.monotonic()
    while left:
        result = _processes()
        left = {process for process in left if result.get(process[0], (0, -1))[1] == process[1]}
        if not left or time.monotonic() - begin > seconds:
            break
        time.sleep(0.02)
    return time.monotonic() - begin, left


def of_commands(processes: set[Process], *words: str) -> set[Process]:
    """Those whose command line has one of the words in it."""
    result = set()
    for process in processes:
        with suppress(OSError):  # it has ended meanwhile
            line = Path(f"/proc/{process[0]}/cmdline").read_bytes().decode(errors="replace")
            if any(word in line for word in words):
                result.add(process)
    return result


def kill(processes: set[Process]) -> None:
    """SIGKILL to each that is still there."""
    result = _processes()
    for pid, start in processes:
        if result.get(pid, (0, -1))[1] == start:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def _processes() -> dict[int, tuple[int, int]]:
    """Of every process that has not ended: its parent, and when it started."""
    out = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        with suppress(OSError):  # it has ended meanwhile
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if fields[0] not in "ZX":
                out[int(folder.name)] = int(fields[1]), int(fields[19])
    return out
