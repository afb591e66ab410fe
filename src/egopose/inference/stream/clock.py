"""Which control frames a camera's frame stands for, whatever the camera's rate.

A frame at the control rate (or a whole multiple of it) stands for one control frame; one of a slower camera, or after
late ones were dropped, for all the control frames that passed since the last one used; one of a quicker camera for
none where less than a quarter of a control frame has passed.
"""

from __future__ import annotations

# A frame less than this share of a control frame ahead is taken for the same one, and one that much short of a further
# control frame for that one. Far from a half, so that a camera at the control rate whose stamps waver is not now
# doubled, now left out: after either its frames lie half a control frame from both bounds.
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
        """Control frames from the last frame used to one at ``time`` (s): at least 1 where it is to be used (the first
        always is), 0 where the camera is ahead of the control rate and it is not."""
        if self._due is None:
            self._due = time
            return 1
        ahead = (time - self._due) * self._rate
        if ahead < _SAME:
            return 0
        count = max(int(ahead + _SAME), 1)
        self._due += count / self._rate
        return count
