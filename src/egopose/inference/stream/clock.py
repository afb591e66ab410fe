"""Which control frames a camera's frame stands for, whatever the camera's rate.

At the control rate, or a whole multiple of it, a frame stands for one control frame. A frame of a slower camera, or
after dropped ones, stands for all control frames since the last one used. A frame of a quicker camera stands for
none if less than a quarter of a control frame has passed.
"""

from __future__ import annotations

# A frame less than this share of a control frame ahead is taken for the same one, and one that much short of a further
# control frame for that one. Far from a half: frames of a camera at the control rate must not be doubled or left out
# when its stamps waver. After either, they lie half a control frame from both bounds.
_SAME = 0.25


class ControlClock:
    """Control frames passed since the last frame used.

    Args:
        rate: control frames a second.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._due: float | None = None

    def intervals(self, time: float) -> int:
        """Control frames from the last frame used to one at ``time`` (s). It is at least 1 if the frame is used, as
        the first always is. It is 0 if the camera is ahead of the control rate and the frame is not used."""
        if self._due is None:
            self._due = time
            return 1
        ahead = (time - self._due) * self._rate
        if ahead < _SAME:
            return 0
        count = max(int(ahead + _SAME), 1)
        self._due += count / self._rate
        return count
