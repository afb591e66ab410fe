"""Readers and writers of motion: one file a format, one door for all.

Every reader gives a :class:`~egopose.motion.motion.Motion`: z up, metres, radians; every fault of a file is one
:class:`~egopose.errors.InputError`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from egopose.errors import InputError
from egopose.motion.io._npz import entry_names
from egopose.motion.io.acclaim import read_amc
from egopose.motion.io.amass import read_amass
from egopose.motion.io.bvh import read_bvh
from egopose.motion.io.bvh_writer import write_bvh
from egopose.motion.io.deepmimic import read_deepmimic
from egopose.motion.io.native import read_native, write_native
from egopose.motion.motion import Motion

__all__ = ["read_motion", "write_motion"]

_READERS: dict[str, Callable[..., Motion]] = {".bvh": read_bvh, ".amc": read_amc, ".txt": read_deepmimic}
_WRITERS: dict[str, Callable[..., None]] = {".bvh": write_bvh, ".npz": write_native}


def read_motion(path: str | Path, **options: Any) -> Motion:
    """Read a motion file; the suffix says how, and for ``.npz`` the arrays inside.

    Args:
        path: ``.bvh`` (options ``unit``, ``up``), ``.amc`` (``asf``, ``fps``), ``.txt`` (DeepMimic), ``.npz`` (the
            project's own clip, or AMASS with the option ``joints``).
        options: of that reader.

    Raises:
        InputError: an unknown suffix or option, or a fault of the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        reader: Callable[..., Motion] | None = read_native if "header" in entry_names(path) else read_amass
    else:
        reader = _READERS.get(suffix)
    if reader is None:
        raise InputError(path, "suffix", f"no reader for {suffix!r}; there is one for {', '.join([*_READERS, '.npz'])}")
    return _call(reader, path, options, path)


def write_motion(motion: Motion, path: str | Path, **options: Any) -> None:
    """Write a motion: ``.bvh`` (options ``unit``, ``up``) or the project's own ``.npz`` (option ``dtype``).

    Raises:
        InputError: an unknown suffix or option, a folder that is not there.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(path, "suffix", f"no writer for {path.suffix!r}; there is one for {', '.join(_WRITERS)}")
    if not path.parent.is_dir():
        raise InputError(path, "path", f"no folder {path.parent}")
    _call(writer, path, options, motion, path)


def _call(function: Callable[..., Any], path: Path, options: dict[str, Any], *arguments: Any) -> Any:
    known = set(function.__kwdefaults__ or ())
    unknown = sorted(set(options) - known)
    if unknown:
        has = f"has the options {', '.join(sorted(known))}" if known else "has no options"
        raise InputError(path, f"option {unknown[0]}", f"{function.__name__} {has}")
    return function(*arguments, **options)
