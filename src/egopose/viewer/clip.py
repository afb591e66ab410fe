"""What the viewer shows at a time: motions in step, figures per frame, and the wearer's video."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class Footage:
    """A video in step with a clip: the clip's time t is the video's ``t + start + offset`` seconds.

    Args:
        path: an MP4.
        offset: s, the sync offset of the take.
        start: s, where in the take the clip begins.
        last_panel: the wearer's view is the last square of a side-by-side picture.
        rendered: it was rendered from motion, not filmed.
        taken_at: rate of filming where the file's stamps are not of it.
    """

    path: Path
    offset: float = 0.0
    start: float = 0.0
    last_panel: bool = False
    rendered: bool = False
    taken_at: float | None = None


@dataclass(frozen=True, eq=False)
class Clip:
    """One take of one run.

    Args:
        motion: what is shown solid.
        reference: the true motion, shown transparent, or None.
        futures: other drawn futures of a forecast, each as long as ``motion``.
        forecast: ``motion`` is itself a future; the poses to come are shown fading.
        curves: figures per frame by name, each ``[T]``, NaN where there is none.
        bands: per degree of freedom ``low``, ``median``, ``high``, each ``[T]`` rad.
        footage: the wearer's video, or None.
    """

    motion: Motion
    reference: Motion | None = None
    futures: tuple[Motion, ...] = ()
    forecast: bool = False
    curves: Mapping[str, Array] = field(default_factory=dict)
    bands: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    footage: Footage | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """A source given on the command line: its label and its clips by the name of the take."""

    label: str
    clips: Mapping[str, Clip]
