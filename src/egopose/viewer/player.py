"""The timeline: which frame is shown when, by a clock that skips frames and never falls behind."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter


class Player:
    """Play, pause, seek, speed; to be used by one thread.

    Args:
        clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = perf_counter) -> None:
        self._clock = clock
        self._frames, self._fps = 1, 30.0
        self._speed, self._playing, self.loop = 1.0, False, True
        self._position, self._since = 0.0, 0.0

    def load(self, frames: int, fps: float) -> None:
        """Another clip: from its first frame on, playing or not as before."""
        self._frames, self._fps = frames, fps
        self.seek(0)

    @property
    def playing(self) -> bool:
        return self._playing

    def play(self, on: bool) -> None:
        """Go on from here (from the start, where the end was reached), or stand still."""
        at = self.frame()
        self.seek(0 if on and not self._playing and at == self._frames - 1 else at)
        self._playing = on

    def seek(self, frame: int) -> None:
        """Frames outside the clip are its ends."""
        self._position, self._since = float(min(max(frame, 0), self._frames - 1)), self._clock()

    @property
    def speed(self) -> float:
        """Seconds of the clip a second."""
        return self._speed

    @speed.setter
    def speed(self, value: float) -> None:
        self.seek(self.frame())
        self._speed = value

    def frame(self) -> int:
        """The frame to show now; at the end of a clip that does not loop, playing stops."""
        if not self._playing:
            return int(self._position)
        at = int(self._position + (self._clock() - self._since) * self._fps * self._speed + 1e-6)
        if self.loop:
            return at % self._frames
        if at >= self._frames:
            self._playing, self._position = False, float(self._frames - 1)
            return self._frames - 1
        return at
