"""BlazePose over a film: people looked for in four turns of the picture, the best readings chained."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from egopose.core.errors import InputError
from egopose.scene.poses.blazepose_networks import BlazePoseNetworks, Reading, Region
from egopose.scene.poses.following import Candidate, follow
from egopose.scene.poses.keypoints import BLAZEPOSE_33
from egopose.scene.poses.track import MAX_FRAMES, PoseTrack
from egopose.vision.video import Frame

#: Quarter turns of the picture in which people are looked for: the detector knows upright ones.
TURNS = (0, 1, 2, 3)
#: Frames between two looks over the whole picture while the person is found.
_LOOK_EVERY = 10
#: A reading that scores less is nobody; below the second, the whole picture is looked over again at once.
_LEAST, _DOUBTFUL = 0.5, 0.8
#: Mean confidence of a person who was found well.
_CLEAR = 0.6
#: A film's first frames that are read again, backwards from the first one that is as sure as this on average: a region
#: that the detector drew takes some frames to close in on the person.
_SETTLING, _SETTLED = 10, 0.9
#: Who was lost is looked for this long (s), this many of them, within this many sides of the region they were in.
_SEARCH, _SEARCHED, _NEARBY = 1.5, 2, 1.5
#: A picture smaller than this (px) shows nobody.
_LEAST_SIDE = 16
#: People of a frame whose regions are read again in the next one.
_CARRIED = 4


class BlazePose:
    """The offline default among the estimators, see :class:`~egopose.scene.poses.estimator.PoseEstimator`.

    Args:
        turns: quarter turns of the picture in which people are looked for.
        at: px, a place on the person to follow in the first frame; by default who is large and well seen for long.
        threads: of the processor.

    Raises:
        InputError: LiteRT is not installed.
    """

    def __init__(self, turns: tuple[int, ...] = TURNS, at: tuple[float, float] | None = None, threads: int = 1) -> None:
        self._networks = BlazePoseNetworks(threads)
        self._turns, self._at = turns, at

    def estimate(self, frames: Iterable[Frame], fps: float) -> PoseTrack:
        """Keypoints (``BLAZEPOSE_33``) and 3D keypoints in camera axes, relative to the middle of the hips.

        A frame in which the person was not found holds NaN, with confidence 0.

        Raises:
            InputError: no frames, frames of different sizes, over ``MAX_FRAMES``, nobody in any of them.
        """
        readings: list[list[Reading]] = []
        carried: list[Reading] = []
        lost: list[tuple[Region, int]] = []
        shape: tuple[int, ...] = ()
        longest = _SEARCH * fps
        first: list[Frame] = []
        for t, frame in enumerate(frames):
            shape = shape or frame.shape
            if frame.shape != shape or t >= MAX_FRAMES:
                raise InputError("poses", f"frame {t}", f"{frame.shape}; frames of one size, at most {MAX_FRAMES}")
            doubtful = not carried or min(r.score for r in carried) < _DOUBTFUL
            regions = [reading.region for reading in carried]
            if doubtful or t % _LOOK_EVERY == 0:
                regions += self._look(frame)
            found = self._read(frame, regions)
            lost += [(reading.region, t) for reading in carried if reading.confidence.mean() >= _CLEAR]
            lost = [(r, since) for r, since in lost if t - since <= longest and not _is_among(r, found)]
            lost = sorted(lost, key=lambda one: -one[1])[:_SEARCHED]
            for region, _ in lost:
                if not _is_among(region, found):
                    found += self._read(frame, self._look(frame, region))
            readings.append(found)
            carried = _people(found)
            if t < _SETTLING:
                first.append(frame)
            elif first:
                self._read_back(first, readings)
                first = []
        self._read_back(first, readings)
        if not any(readings):
            raise InputError("poses", "frames", f"no person was found in {len(readings)} frames")
        return _track(readings, fps, (shape[1], shape[0]), self._at)

    def _read(self, frame: Frame, regions: list[Region]) -> list[Reading]:
        """Readings of the regions in which there is a person."""
        found = [self._networks.read(frame, region) for region in _distinct(regions)]
        return [reading for reading in found if reading.score >= _LEAST]

    def _read_back(self, frames: list[Frame], readings: list[list[Reading]]) -> None:
        """Add readings to those of a film's first frames, from the region that the next frame's are in."""
        sure = [max((float(one.confidence.mean()) for one in found), default=0.0) for found in readings[: len(frames)]]
        settled = next((t for t, mean in enumerate(sure) if mean >= _SETTLED), 0)
        for t in reversed(range(settled)):
            readings[t] += self._read(frames[t], [one.region for one in _people(readings[t + 1])])

    def _look(self, frame: Frame, around: Region | None = None) -> list[Region]:
        """People in the whole picture, or near where one was: upright and in the picture's other turns."""
        left, top = 0, 0
        if around is not None:
            # In a part of the picture a small person is seen larger.
            reach = _NEARBY * around.side
            left, top = max(0, int(around.x - reach)), max(0, int(around.y - reach))
            frame = frame[top : max(0, int(around.y + reach)), left : max(0, int(around.x + reach))]
        if min(frame.shape[:2]) < _LEAST_SIDE:
            return []
        out = []
        for turns in self._turns:
            turned = np.ascontiguousarray(np.rot90(frame, turns))
            out += [_turned_back(r, turns, frame.shape[1], frame.shape[0]) for r in self._networks.people(turned)]
        return [replace(region, x=region.x + left, y=region.y + top) for region in out]


def _track(
    readings: list[list[Reading]], fps: float, size: tuple[int, int], at: tuple[float, float] | None
) -> PoseTrack:
    """The chain of one person's readings as a track."""
    chain = follow([[Candidate(r.pixels, r.confidence) for r in found] for found in readings], fps, at)
    frames, count = len(readings), len(BLAZEPOSE_33)
    pixels, positions = np.full((frames, count, 2), np.nan), np.full((frames, count, 3), np.nan)
    confidence = np.zeros((frames, count))
    for t, k in enumerate(chain):
        if k >= 0:
            pixels[t], positions[t] = readings[t][k].pixels, readings[t][k].positions
            confidence[t] = readings[t][k].confidence
    return PoseTrack(BLAZEPOSE_33, pixels, confidence, fps, size, positions)


def _turned_back(region: Region, turns: int, width: int, height: int) -> Region:
    """A region of ``np.rot90(picture, turns)`` in the picture of that width and height itself."""
    x, y = region.x, region.y
    places = ((x, y), (width - y, x), (width - x, height - y), (y, height - x))
    return Region(*places[turns % 4], region.side, region.turn + 0.5 * np.pi * turns, region.score)


def _people(found: list[Reading]) -> list[Reading]:
    """The best reading of each person of a frame, the most confident first: several regions may show one person."""
    out: list[Reading] = []
    for reading in sorted(found, key=lambda r: -float(r.confidence.mean())):
        if all(_apart(reading.region, other.region, turned=False) for other in out) and len(out) < _CARRIED:
            out.append(reading)
    return out


def _is_among(region: Region, found: list[Reading]) -> bool:
    """Whether the person of a region was found well: like in size, near its middle."""
    return any(
        not _apart(region, reading.region, turned=False, near=0.4, like=0.6) and reading.confidence.mean() >= _CLEAR
        for reading in found
    )


def _distinct(regions: list[Region]) -> list[Region]:
    """Regions that differ: each is read at some cost."""
    out: list[Region] = []
    for region in regions:
        if all(_apart(region, other) for other in out):
            out.append(region)
    return out


def _apart(a: Region, b: Region, turned: bool = True, near: float = 0.15, like: float = 0.75) -> bool:
    """Whether two regions are of different people or, where ``turned``, may be read differently."""
    side = max(a.side, b.side)
    turn = abs((a.turn - b.turn + np.pi) % (2.0 * np.pi) - np.pi)
    elsewhere = bool(np.hypot(a.x - b.x, a.y - b.y) > near * side or min(a.side, b.side) < like * side)
    return elsewhere or (turned and turn > 0.4)
