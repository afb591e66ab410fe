"""When each sample of a GPMF stream was taken: the track tells when a payload begins, and little else.

Newer cameras stamp the first sample of a stream in each payload (STMP, microseconds). Streams with one sample a frame
begin with the first frame, and tie those stamps to the video.

Older ones do not. Their sensors tick evenly, but payloads cut the stream with a jitter of tens of milliseconds. So a
straight line through the beginnings of all payloads gives the time of a sample by its number, as GoPro's own tools do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array

#: Streams with one sample a frame, the surest first.
_PER_FRAME = ("MSKP", "LSKP", "CORI", "IORI", "GRAV", "SHUT", "ISOE")
#: s by which a payload's beginning may lie off the line before the sensor is taken to tick unevenly.
_MOST_JITTER = 0.1


@dataclass(frozen=True)
class Block:
    """A stream's part of one payload.

    Args:
        payload: its number.
        count: samples in it.
        values: ``[count, k]``.
        stamp: STMP in s, or None.
        total: TSMP, samples since the beginning with these, or None.
    """

    payload: int
    count: int
    values: Array
    stamp: float | None
    total: int | None


def first_frame(streams: Mapping[str, Sequence[Block]]) -> float | None:
    """The stamp (s) of the first frame, or None where no stream with one sample a frame has stamps."""
    for key in _PER_FRAME:
        blocks = streams.get(key, ())
        if blocks and blocks[0].payload == 0 and blocks[0].stamp is not None:
            return blocks[0].stamp
    return None


def sample_times(blocks: Sequence[Block], starts: Array, durations: Array, frame: float | None) -> Array:
    """Times ``[N]`` (s of the video) of a stream's samples.

    Args:
        blocks: at least one, none of them empty.
        starts: ``[P]`` s, of all payloads.
        durations: ``[P]`` s.
        frame: stamp of the first frame, see :func:`first_frame`.
    """
    stamps = np.array([np.nan if b.stamp is None else b.stamp for b in blocks])
    counts = np.array([b.count for b in blocks])
    held = np.array([b.payload for b in blocks])
    if np.isfinite(stamps).all() and (np.diff(stamps) > 0).all():
        begins = stamps - (stamps[0] - starts[held[0]] if frame is None else frame)
    else:
        line = _straight(blocks, counts, starts[held])
        if line is not None:
            return line
        begins = starts[held]
    intervals = np.append(np.diff(begins), durations[held[-1]]) / counts
    if len(blocks) > 1:  # the last payload may hold less than its duration
        intervals[-1] = intervals[-2]
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(begins, counts) + within * np.repeat(intervals, counts)


def _straight(blocks: Sequence[Block], counts: NDArray[np.int64], starts: Array) -> Array | None:
    """Times by a line through the beginnings of payloads, or None where there are too few or they are off it."""
    if len(blocks) < 3:
        return None
    first = np.cumsum(counts) - counts
    totals = [b.total for b in blocks if b.total is not None]
    if len(totals) == len(blocks):
        told = np.array(totals) - counts
        # A count that falls, or is less than what is there, is no count since the beginning.
        if (np.diff(told) >= counts[:-1]).all():
            first = told - told[0]
    slope, origin = np.polyfit(first, starts, 1)
    if slope <= 0 or np.abs(origin + slope * first - starts).max() > _MOST_JITTER:
        return None
    number = np.repeat(first, counts) + np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return origin + slope * number
