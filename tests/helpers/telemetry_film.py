"""Small films with telemetry, written as a camera writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egopose.motion.rotations import Array, normalize
from egopose.vision.telemetry import Samples, Telemetry, write_gpmf_mp4
from egopose.vision.video import write_video


def telemetry_folder(shared: Path) -> Path:
    """The folder of real cameras' telemetry, or the test skips."""
    folder = shared / "telemetry"
    if not folder.is_dir():
        pytest.skip("the folder ../shared/telemetry of real cameras' files is not here: it is not part of the project")
    return folder


def plain_video(path: Path, frames: int = 70, fps: float = 30.0) -> Path:
    """Grey frames that get lighter."""
    write_video(path, (np.full((48, 64, 3), 2 * (k % 100), np.uint8) for k in range(frames)), fps)
    return path


def any_samples(rng: np.random.Generator, times: Array, columns: int, size: float, unit: bool) -> Samples:
    values = rng.normal(size=(len(times), columns)) * size
    return Samples(times, normalize(values) if unit else values)


def any_telemetry(seed: int, frames: int, fps: float, rate: float = 200.0, begin: float = -0.01) -> Telemetry:
    """Random numbers for all that the writer writes."""
    rng = np.random.default_rng(seed)
    per_frame = np.arange(frames) / fps
    dense = begin + np.arange(int(frames / fps * rate)) / rate
    return Telemetry(
        model="HERO11 Black",
        gyroscope=any_samples(rng, dense, 3, 3.0, False),
        accelerometer=any_samples(rng, dense, 3, 9.0, False),
        gravity=any_samples(rng, per_frame, 3, 1.0, True),
        camera_orientation=any_samples(rng, per_frame, 4, 1.0, True),
        image_orientation=any_samples(rng, per_frame, 4, 1.0, True),
        field_of_view=float(rng.uniform(40, 130)),
        lens=str(rng.choice(["linear", "wide", "narrow"])),
        readout=float(rng.uniform(0.001, 0.03)),
        stabilised=bool(rng.integers(2)),
    )


def film(folder: Path, telemetry: Telemetry, frames: int = 70, fps: float = 30.0) -> Path:
    """An MP4 with this telemetry."""
    out = folder / "film.mp4"
    write_gpmf_mp4(plain_video(folder / "plain.mp4", frames, fps), out, telemetry, fps)
    return out
