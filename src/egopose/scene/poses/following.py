"""The same person from frame to frame, among all the people and readings that an estimator gives.

The best chain of readings is found over the whole clip at once (Viterbi 1967), so a frame in which somebody else is
found with more confidence does not lead it away. A chain may leave frames out: a gap is better than a wrong person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egopose.motion.rotations import Array

#: Seconds over which a person who was not found is still the same one.
LONGEST_GAP = 2.0
#: In body heights: how far keypoints may lie from where the person would be at the same speed. By noise, for each
#: second (gravity alone makes 0.7 of the first half), and at most: whoever turns up elsewhere may be anybody.
_NOISE, _EACH_SECOND, _FURTHEST = 0.15, 2.0, 0.7
#: Of two sights of one person the smaller is at least this much of the larger one: crouching halves a box.
_LEAST_SIZE = 0.35
#: How much a move of one height counts against a reading of full confidence.
_STEADINESS = 2.0
#: Keypoints below this confidence say nothing.
_SURE = 0.1


@dataclass(frozen=True)
class Candidate:
    """One reading of one person in one frame: ``pixels [K, 2]`` (NaN where unknown) and ``confidence [K]``."""

    pixels: Array
    confidence: Array

    @property
    def seen(self) -> np.ndarray:
        """``[K]``: known and sure enough to speak."""
        return (self.confidence > _SURE) & np.isfinite(self.pixels).all(axis=1)

    @property
    def height(self) -> float:
        """The longer side of the box around what is seen, px; at least 1."""
        points = self.pixels[self.seen]
        return max(float(np.ptp(points, axis=0).max()), 1.0) if len(points) else 1.0


def follow(frames: Sequence[Sequence[Candidate]], fps: float, at: tuple[float, float] | None = None) -> list[int]:
    """Which candidate of each frame is the person; -1 where none is.

    Args:
        frames: the candidates of each frame, any number.
        fps: frames per second.
        at: px, a place on the person in the first frame in which there is anyone; by default the person who is large
            and well seen for long.

    Returns:
        ``[T]`` indices. The chain with the most confidence (large people count for more) less what its keypoints jump.
    """
    longest = max(1, round(LONGEST_GAP * fps))
    largest = max((c.height for candidates in frames for c in candidates), default=1.0)
    worth = [np.array([_worth(c, largest) for c in candidates]) for candidates in frames]
    speeds = [_speeds(frames, t) for t in range(len(frames))]
    first = next((t for t, candidates in enumerate(frames) if candidates), None)
    if at is not None and first is not None:
        away = [float(np.hypot(*(_middle(c) - np.array(at)))) for c in frames[first]]
        # Whoever is pointed at outweighs all that the others could gather.
        worth[first][int(np.argmin(away))] += 2.0 * len(frames)
    best: list[Array] = []
    before: list[list[tuple[int, int]]] = []
    for t, candidates in enumerate(frames):
        total, links = worth[t].copy(), [(-1, -1)] * len(candidates)
        for gap in range(1, min(longest, t) + 1):
            for j, earlier in enumerate(frames[t - gap]):
                for i, candidate in enumerate(candidates):
                    cost = _jump(earlier, candidate, gap * speeds[t - gap][j], gap / fps)
                    if (sum_ := best[t - gap][j] - cost + worth[t][i]) > total[i]:
                        total[i], links[i] = sum_, (t - gap, j)
            if gap == 1 and frames[t - 1] and all(link[0] == t - 1 for link in links):
                break  # everyone here was there a moment ago: longer leaps are no better
        best.append(total)
        before.append(links)
    out = [-1] * len(frames)
    ends = [(float(total.max()), t) for t, total in enumerate(best) if len(total)]
    if not ends:
        return out
    t = max(ends)[1]
    i = int(np.argmax(best[t]))
    while t >= 0:
        out[t] = i
        t, i = before[t][i]
    return out


def _worth(candidate: Candidate, largest: float) -> float:
    return float(candidate.confidence.mean()) * float(np.sqrt(candidate.height / largest))


def _middle(candidate: Candidate) -> Array:
    points = candidate.pixels[candidate.seen]
    return points.mean(axis=0) if len(points) else np.full(2, np.inf)


def _speeds(frames: Sequence[Sequence[Candidate]], t: int) -> list[Array]:
    """``[2]`` px a frame of each candidate of frame t, by whoever stood next to it in the frame before."""
    out = []
    for candidate in frames[t]:
        here, nearest = _middle(candidate), np.zeros(2)
        others = frames[t - 1] if t else ()
        moves = [here - _middle(other) for other in others]
        near = [move for move in moves if np.isfinite(move).all() and np.hypot(*move) < _NOISE * candidate.height]
        if near:
            nearest = min(near, key=lambda move: float(np.hypot(*move)))
        out.append(nearest)
    return out


def _jump(a: Candidate, b: Candidate, move: Array, seconds: float) -> float:
    """What it costs that ``b`` be the person of ``a``, so many seconds later; infinite where it cannot be.

    ``move [2]`` px is the way at the speed that ``a`` had; who stood still is as likely.
    """
    both = a.seen & b.seen
    height, smaller = max(a.height, b.height), min(a.height, b.height)
    if both.sum() < 3 or smaller < _LEAST_SIZE * height:
        return np.inf
    way = b.pixels[both] - a.pixels[both]
    away = min(float(np.median(np.linalg.norm(way - guess, axis=1))) for guess in (move, np.zeros(2))) / height
    return _STEADINESS * away if away <= min(_NOISE + _EACH_SECOND * seconds, _FURTHEST) else np.inf
