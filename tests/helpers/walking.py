"""An embedded clip of a walk on the default humanoid, for tests of what a worn camera sees."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from egopose.data.prepare_motion import reference_motion
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from helpers.mocap import default_humanoid


@lru_cache
def walking(clip: str = "deepmimic_walk") -> Motion:
    """The clip as a reference motion at 30 Hz, on the floor."""
    path = Path(str(files("egopose") / "assets" / "clips")) / f"{clip}.motion.npz"
    return reference_motion(read_motion(path), default_humanoid())[0]
