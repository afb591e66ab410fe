"""Readers and writers of motion: one file a format, one door for all.

Every reader gives a :class:`~egopose.motion.motion.Motion`: z up, metres, radians; every fault of a file is one
:class:`~egopose.errors.InputError`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from egopose.errors import InputError
from egopose.motion.io.acclaim import read_amc
from egopose.motion.io.bvh import read_bvh
from egopose.motion.io.deepmimic import read_deepmimic
from egopose.motion.motion import Motion

_READERS = {".bvh": read_bvh, ".amc": read_amc, ".txt": read_deepmimic}


def read_motion(path: str | Path, **options: Any) -> Motion:
    """Read a motion file; the suffix says how.

    Args:
        path: ``.bvh`` (options ``unit``, ``up``), ``.amc`` (``asf``, ``fps``), ``.txt`` (DeepMimic).
        options: of that reader.

    Raises:
        InputError: an unknown suffix or option, or a fault of the file.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(path, "suffix", f"no reader for {path.suffix!r}; there is one for {', '.join(_READERS)}")
    try:
        return reader(path, **options)
    except TypeError as error:
        if "unexpected keyword" in str(error):
            raise InputError(path, "options", str(error)) from error
        raise
