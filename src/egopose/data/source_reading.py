"""Reading a take's motion file, and holding it against what its set says of the file."""

from __future__ import annotations

import math
from typing import Any

from egopose.core.errors import InputError
from egopose.data.take_sources import TakeSource
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.notes import with_note

#: Rates and units that differ by less are the same, written with fewer digits: 99.99 and 100 frames/s.
_SAME = 0.01


def read_source(source: TakeSource) -> Motion:
    """The take's motion as its file has it, less the frames that the set says come before it.

    The reader finds unit, up axis and rate by itself. Where the set's table says something else of the file, the table
    is believed, and a note in ``meta["notes"]`` tells of the difference.

    Raises:
        InputError: the file cannot be read, or has no more frames than are to be skipped.
    """
    said = {name: value for name, value in source.facts.items() if name in ("unit", "up", "fps")}
    try:
        motion = read_motion(source.motion, **source.options)
    except InputError as fault:
        if not said:
            raise
        try:
            motion = read_motion(source.motion, **source.options, **said)
        except InputError:
            raise fault from None
        motion = with_note(motion, f"read as the table says ({_words(said)}); by itself it is refused: {fault.cause}")
    else:
        found = _found(motion)
        other = {name: value for name, value in said.items() if name in found and not _same(found[name], value)}
        if other:
            was = _words({name: found[name] for name in other})
            motion = read_motion(source.motion, **source.options, **other)
            motion = with_note(motion, f"the file has {was}, the table {_words(other)}: read as the table says")
    frames = source.facts.get("frames")
    if frames is not None and frames != len(motion):
        motion = with_note(motion, f"the file has {len(motion)} frames, the table {frames}")
    if source.skip:
        if source.skip >= len(motion):
            cause = f"the set skips {source.skip} frames, the file has {len(motion)}"
            raise InputError(source.motion, "skip", cause)
        motion = motion.slice(source.skip, len(motion))
        motion = with_note(motion, f"{source.skip} frames before the motion were cut, as the table says")
    return motion


def _found(motion: Motion) -> dict[str, Any]:
    """What the reader found out of ``unit``, ``up`` and ``fps``."""
    values = {"unit": motion.meta.get("unit_metres"), "up": motion.meta.get("up"), "fps": motion.fps}
    return {name: value for name, value in values.items() if value is not None}


def _same(found: Any, said: Any) -> bool:
    return found == said if isinstance(said, str) else math.isclose(float(found), float(said), rel_tol=_SAME)


def _words(values: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value if isinstance(value, str) else f'{value:g}'}" for name, value in values.items())
