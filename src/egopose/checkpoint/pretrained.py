"""Trained weights that come with the package: a small run directory each, named ``pretrained:NAME`` on a command line.

``egopose package`` makes them. ``docs/model-card.md`` says what they are.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from egopose.checkpoint.checksums import check_files
from egopose.core.errors import InputError

PREFIX = "pretrained:"
#: The prefix of earlier versions, which is still read.
FORMER_PREFIX = "weights:"
#: What a packaged run is: provenance and figures. A folder with this file is one.
ABOUT = "weights.json"
FOLDER = Path(__file__).resolve().parents[1] / "weights"


def pretrained_names() -> list[str]:
    """The names there are, sorted."""
    return sorted(path.parent.name for path in FOLDER.glob(f"*/{ABOUT}"))


def pretrained_run(name: str) -> Path:
    """The run directory of ``pretrained:NAME``; every file is compared with its checksum.

    Args:
        name: with the prefix, with the former prefix ``weights:``, or without one.

    Raises:
        InputError: there is no such name, or a file is missing, added or altered.
    """
    wanted, there = name.removeprefix(PREFIX).removeprefix(FORMER_PREFIX), pretrained_names()
    if wanted not in there:
        near = difflib.get_close_matches(wanted, there, 1)
        meant = f"; did you mean {PREFIX}{near[0]}?" if near else ""
        listed = ", ".join(f"{PREFIX}{one}" for one in there) or "none"
        raise InputError("checkpoint", name, f"no such weights come with egopose{meant or f'; there are {listed}'}")
    check_files(FOLDER / wanted)
    return FOLDER / wanted


def is_pretrained(path: str | Path) -> bool:
    """Whether ``path`` is a name ``pretrained:NAME`` (or, as before, ``weights:NAME``) and no file."""
    return str(path).startswith((PREFIX, FORMER_PREFIX))
