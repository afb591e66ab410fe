"""The wearer's video, kept as small JPEGs so that any frame is there at once."""

from __future__ import annotations

import threading

import cv2
import numpy as np

from egopose.errors import InputError
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
        self._kept: list[bytes] = []
        self._stop = threading.Event()
        self.fault: InputError | None = None
        self._thread = threading.Thread(target=self._decode, args=(footage, fps, count), daemon=True)
        self._thread.start()

    def _decode(self, footage: Footage, fps: float, count: int) -> None:
        try:
            for number, frame in enumerate(iter_frames(footage.path, fps, footage.offset, count)):
                if self._stop.is_set():
                    return
                if number % self._every == 0:
                    seen = frame[:, -frame.shape[0] :] if footage.last_panel else frame
                    scale = min(1.0, _SIDE / max(seen.shape[:2]))
                    small = cv2.resize(
                        np.ascontiguousarray(seen), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
                    )
                    self._kept.append(cv2.imencode(".jpg", small[..., ::-1])[1].tobytes())
        except InputError as error:
            self.fault = error

    def at(self, frame: int) -> Frame | None:
        """RGB ``[H, W, 3]``; None where it is not decoded yet, or the video has ended."""
        index = frame // self._every
        if index >= len(self._kept):
            return None
        bgr = cv2.imdecode(np.frombuffer(self._kept[index], np.uint8), cv2.IMREAD_COLOR)
        return None if bgr is None else np.ascontiguousarray(bgr[..., ::-1]).astype(np.uint8, copy=False)

    def close(self) -> None:
        """Stop decoding and wait for it."""
        self._stop.set()
        self._thread.join()
