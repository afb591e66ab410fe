"""What processes hold in memory, by Linux's own account (``/proc/PID/smaps``)."""

from __future__ import annotations

from pathlib import Path

_KB = 1 / 1024
_PRIVATE = ("Private_Clean:", "Private_Dirty:")


def proportional_mb(pid: int) -> float:
    """MiB of a process, each page that several share divided by their number (PSS)."""
    rows = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    return sum(int(row[1]) for row in rows if row[0] == "Pss:") * _KB


def mapped_mb(pid: int, file: Path) -> tuple[float, float]:
    """MiB of a file's pages in a process: all that it has mapped in, and those it alone holds and has altered.

    A page of a file that only one process happens to have mapped counts as private to Linux; what grows with the
    number of processes is what each has altered or copied.
    """
    resident, altered, ours = 0, 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            ours = words[-1] == str(file)
        elif ours and words[0] == "Rss:":
            resident += int(words[1])
        elif ours and words[0] == "Private_Dirty:":
            altered += int(words[1])
    return resident * _KB, altered * _KB


def private_mb(pid: int) -> float:
    """MiB that only this process holds."""
    rows = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    return sum(int(row[1]) for row in rows if row[0] in _PRIVATE) * _KB
