"""What goes wrong with a wearer's video: a camera that jitters, slips or swings in its mount, frames that never come.

Rendered takes are rendered anew with the camera so turned, so flow is what a camera would have seen, borders and
parallax included; nothing is done to flow itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.motion.rotations import Array

_SOURCE = "conf/corruption"


@dataclass(frozen=True)
class Corruption:
    """See ``conf/corruption/none.yaml``.

    Args:
        jitter: degrees, standard deviation, independent from frame to frame.
        drift: degrees a root of a second, standard deviation of a random walk.
        shake: degrees, amplitude of a sine about each axis, with phases of its own.
        shake_rate: Hz.
        dropped: share of frames in whose place the one before stands.
        seed: of all of it.
    """

    jitter: float
    drift: float
    shake: float
    shake_rate: float
    dropped: float
    seed: int

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Corruption | None:
        """``config["corruption"]``; None where there is none, or nothing in it is wrong with the video.

        Raises:
            InputError: a setting is missing, unknown or out of range; names it.
        """
        if config.get("corruption") is None:
            return None
        result = from_mapping(cls, config["corruption"], _SOURCE)
        for name in ("jitter", "drift", "shake", "shake_rate"):
            if not 0.0 <= getattr(result, name) < float("inf"):
                raise InputError(_SOURCE, name, f"must be 0 or more, not {getattr(result, name)}")
        if not 0.0 <= result.dropped < 1.0:
            raise InputError(_SOURCE, "dropped", f"must be a share under 1, not {result.dropped}")
        return result if result.jitter or result.drift or result.shake or result.dropped else None

    def generator(self, take_seed: int) -> np.random.Generator:
        """A take's own; nothing else is drawn from it, so that a take's room and camera stay as they are without."""
        return np.random.default_rng([take_seed, 3, self.seed])

    def angles(self, rng: np.random.Generator, count: int, fps: float) -> Array:
        """``[count, 3]`` rad: yaw, pitch down and roll to be added to the camera's own, the first frame's drift 0."""
        jitter = rng.normal(size=(count, 3)) * self.jitter
        steps = rng.normal(size=(count, 3)) * self.drift / np.sqrt(fps)
        steps[:1] = 0.0
        time = np.arange(count)[:, None] / fps
        swing = self.shake * np.sin(2 * np.pi * (self.shake_rate * time + rng.random(3)))
        return np.deg2rad(jitter + np.cumsum(steps, axis=0) + swing)

    def shown(self, rng: np.random.Generator, count: int) -> NDArray[np.int64]:
        """``[count]`` which frame is seen in each one's place: itself, or the last before it that came."""
        came = rng.random(count) >= self.dropped
        came[:1] = True
        return np.maximum.accumulate(np.where(came, np.arange(count), 0))
