"""A live motion into a clip of the project's own format, however long it gets."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.inference.stream.live_body import LivePose
from egopose.motion.io.native import write_native
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


class Recording:
    """Appends poses to ``PATH.part`` and makes them a clip at the end, so that an hour takes no memory.

    The clip's frame k is control frame k of the stream: frames that were jumped over hold the pose before them.

    Args:
        path: of the clip, ``*.npz``.
        skeleton: of the humanoid.
        fps: control frames a second.

    Raises:
        InputError: it cannot be written there.
    """

    def __init__(self, path: Path, skeleton: Skeleton, fps: float) -> None:
        if path.suffix != ".npz":
            raise InputError(path, "out", "the motion is written as .npz")
        self.path, self._skeleton, self._fps = path, skeleton, fps
        self._part = path.with_name(f"{path.name}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self._part.open("wb")
        except OSError as error:
            raise InputError(path, "out", f"cannot be written: {error.strerror}") from None
        self._last: Array | None = None
        self.frames = 0

    def pose(self, pose: LivePose) -> None:
        """Append a pose; frames between it and the last one hold the last one."""
        while self._last is not None and self.frames < pose.frame:
            self._write(self._last)
        self._write(pose.qpos)
        self._last = pose.qpos

    def _write(self, qpos: Array) -> None:
        self._stream.write(qpos.astype(np.float64, copy=False).tobytes())
        self.frames += 1

    def close(self) -> None:
        """Turn what was appended into the clip; without a frame there is none."""
        self._stream.close()
        if self.frames:
            rows = np.memmap(self._part, np.float64, "r", shape=(self.frames, self._skeleton.nq))
            meta = {"source": "estimated live by egopose"}
            made = self.path.with_name(f".{self.path.name}")
            write_native(Motion(self._skeleton, rows, self._fps, self.path.stem, meta=meta), made)
            os.replace(made, self.path)
        self._part.unlink()
