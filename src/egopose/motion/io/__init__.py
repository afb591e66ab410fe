"""Readers and writers of motion: one file a format, one door for all.

Every reader gives a :class:`~egopose.motion.motion.Motion`: z up, metres, radians; every fault of a file is one
:class:`~egopose.core.errors.InputError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from egopose.core.errors import InputError
from egopose.motion.io._npz import entry_names
from egopose.motion.io.acclaim import read_amc
from egopose.motion.io.amass import read_amass
from egopose.motion.io.amass_writer import write_amass
from egopose.motion.io.bvh import read_bvh
from egopose.motion.io.bvh_writer import write_bvh
from egopose.motion.io.c3d import write_c3d
from egopose.motion.io.c3d_reader import read_c3d
from egopose.motion.io.csv_table import write_csv
from egopose.motion.io.deepmimic import read_deepmimic
from egopose.motion.io.glb import write_glb
from egopose.motion.io.mot import write_forces_mot, write_mot, write_torques_sto
from egopose.motion.io.mvnx import read_mvnx
from egopose.motion.io.native import read_native, write_native
from egopose.motion.io.trc import write_trc
from egopose.motion.io.trc_reader import read_trc
from egopose.motion.motion import Motion

__all__ = ["WRITERS", "given_options", "read_motion", "write_motion", "writer_suffix"]

_READERS: dict[str, Callable[..., Motion]] = {
    ".bvh": read_bvh,
    ".amc": read_amc,
    ".txt": read_deepmimic,
    ".mvnx": read_mvnx,
    ".trc": read_trc,
    ".c3d": read_c3d,
}

#: How files of each ending are written; of two endings that fit a name the longer one counts.
WRITERS: dict[str, Callable[..., None]] = {
    ".bvh": write_bvh,
    ".glb": write_glb,
    ".amass.npz": write_amass,
    ".trc": write_trc,
    ".c3d": write_c3d,
    ".mot": write_mot,
    ".forces.mot": write_forces_mot,
    ".torques.sto": write_torques_sto,
    ".csv": write_csv,
    ".npz": write_native,
}


def read_motion(path: str | Path, **options: Any) -> Motion:
    """Read a motion file; the suffix says how, and for ``.npz`` the arrays inside.

    Args:
        path: ``.bvh`` (options ``unit``, ``up``, ``fps``, ``encoding``), ``.amc`` (these and ``asf``), ``.txt``
            (DeepMimic: ``up``, ``fps``, ``encoding``), ``.mvnx`` (Xsens; ``subject``), ``.trc`` and ``.c3d`` (points;
            ``unit``, ``up``, ``fps``, ``points``), ``.npz`` (the project's own clip, or AMASS and SMPL with
            ``joints``, ``up``, ``fps``).
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


def given_options(reader: Mapping[str, Any]) -> dict[str, Any]:
    """Of a resolved ``conf/reader`` group what was given: options for :func:`read_motion`."""
    return {name: value for name, value in reader.items() if value is not None}


def write_motion(motion: Motion, path: str | Path, **options: Any) -> None:
    """Write a motion; the ending says how: one of :data:`WRITERS`, each with the keyword options of its function.

    ``.npz`` is the project's own clip (option ``dtype``); all others are for other programs, see
    docs/howto-export.md.

    Raises:
        InputError: an unknown ending or option, a folder that is not there, a motion that the format cannot hold.
    """
    path = Path(path)
    writer = WRITERS[writer_suffix(path)]
    if not path.parent.is_dir():
        raise InputError(path, "path", f"no folder {path.parent}")
    _call(writer, path, options, motion, path)


def writer_suffix(path: Path) -> str:
    """The key of :data:`WRITERS` a file's name ends with, the longest that fits.

    Raises:
        InputError: there is none.
    """
    fitting = [suffix for suffix in WRITERS if path.name.lower().endswith(suffix)]
    if not fitting:
        raise InputError(path, "suffix", f"no writer for {path.suffix!r}; there is one for {', '.join(WRITERS)}")
    return max(fitting, key=len)


def _call(function: Callable[..., Any], path: Path, options: dict[str, Any], *arguments: Any) -> Any:
    known = list(function.__kwdefaults__ or ())
    unknown = sorted(set(options) - set(known))
    if unknown:
        has = f"has the options {', '.join(known)}" if known else "has no options"
        raise InputError(path, f"option {unknown[0]}", f"{function.__name__} {has}")
    return function(*arguments, **options)
