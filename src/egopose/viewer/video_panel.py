"""The wearer's video, kept as small JPEGs so that any frame is there at once."""

from __future__ import annotations

import math
import threading

import cv2
import numpy as np

from egopose.core.errors import InputError
from egopose.viewer.clip import Footage
from egopose.vision.video import Frame, iter_frames

_SIDE = 320  # pixels of the longer side
_MOST = 18_000  # pictures kept: ten minutes of every frame, an hour of every sixth; about 0.25 GB


class Pictures:
    """Decodes in the background; :meth:`at` gives what is there.

    Args:
        footage: where the video lies.
        fps: of the clip. count: frames of the clip.
    """

    def __init__(self, footage: Footage, fps: float, count: int) -> None:
        self._every = -(-count // _MOST)
        # Frames before the video begins have no picture.
        offset = footage.start + footage.offset
        self._lead = max(0, math.ceil(-offset * fps - 1e-6))
        self._kept: list[bytes] = []
        self._stop = threading.Event()
        self.fault: InputError | None = None
        self._thread = threading.Thread(target=self._decode, args=(footage, offset, fps, count), daemon=True)
        self._thread.start()

    def _decode(self, footage: Footage, offset: float, fps: float, count: int) -> None:
        try:
            begin, left = offset + self._lead / fps, max(count - self._lead, 0)
            for number, frame in enumerate(iter_frames(footage.path, fps, begin, left, footage.taken_at)):
                if self._stop.is_set():
                    return
                if number % self._every == 0:
                    seen = frame[:, -frame.shape[0] :] if footage.last_panel else frame
                    scale = _SIDE / max(seen.shape[:2])
                    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR  # rendered videos are smaller
                    small = cv2.resize(np.ascontiguousarray(seen), None, fx=scale, fy=scale, interpolation=way)
                    self._kept.append(cv2.imencode(".jpg", small[..., ::-1])[1].tobytes())
        except InputError as error:
            self.fault = error

    def at(self, frame: int) -> Frame | None:
        """RGB ``[H, W, 3]``; None where it is not decoded yet, or the video has not begun or has ended."""
        index = (frame - self._lead) // self._every
        if not 0 <= index < len(self._kept):
            return None
        bgr = cv2.imdecode(np.frombuffer(self._kept[index], np.uint8), cv2.IMREAD_COLOR)
        return None if bgr is None else np.ascontiguousarray(bgr[..., ::-1]).astype(np.uint8, copy=False)

    def close(self) -> None:
        """Stop decoding and wait for it."""
        self._stop.set()
        self._thread.join()
