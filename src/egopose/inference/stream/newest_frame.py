"""Where a frame waits for the estimator: room for one, so that no queue can grow."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from egopose.vision.video import Frame


@dataclass(frozen=True)
class Captured:
    """A frame as it came from its source.

    Attributes:
        time: seconds on the source's clock; only differences count.
        arrived: seconds on ``time.perf_counter``, when it was handed over.
        image: RGB ``[H, W, 3]``.
    """

    time: float
    arrived: float
    image: Frame


class NewestFrame:
    """Hands frames from one thread to another, the newest only.

    The rule by which late frames are skipped: a frame that still waits when the next one comes is dropped and counted.

    Attributes:
        dropped: frames that were never taken because a newer one came.
        given: frames that came.
        broken: the source gives nothing and is tried again.
        reconnects: how often it gave pictures again after that.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: Captured | None = None
        self._closed = False
        self._error: Exception | None = None
        self.dropped = self.given = self.reconnects = 0
        self.broken = False

    def put(self, frame: Captured) -> None:
        """Replaces what is waiting."""
        with self._changed:
            self.dropped += self._waiting is not None
            self._waiting = frame
            self.given += 1
            self._changed.notify_all()

    def put_patiently(self, frame: Captured) -> None:
        """Waits until nothing is waiting any more: every frame is taken. Closing ends the wait."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is None or self._closed)
            self._waiting = frame
            self.given += 1
            self._changed.notify_all()

    def take(self, timeout: float) -> Captured | None:
        """The newest frame; None where none comes within ``timeout`` seconds or the source has ended.

        Raises:
            Exception: what ended the source.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed, timeout)
            frame, self._waiting = self._waiting, None
            self._changed.notify_all()
            if frame is None and self._error is not None:
                raise self._error
            return frame

    @property
    def ended(self) -> bool:
        """Closed, and the last frame taken."""
        with self._changed:
            return self._closed and self._waiting is None

    def close(self, error: Exception | None = None) -> None:
        """No more frames; ``error`` says why where that is not the source's plain end."""
        with self._changed:
            self._closed, self._error = True, error or self._error
            self._changed.notify_all()
