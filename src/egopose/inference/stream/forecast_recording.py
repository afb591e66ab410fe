"""A stream's forecasts into one file, however many there get to be."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.inference.stream.live_forecasts import ForecastSettings, LiveForecast
from egopose.motion.io.native import skeleton_to_json
from egopose.motion.skeleton import Skeleton

FORMAT, VERSION = "egopose.forecasts", 1


class ForecastRecording:
    """Appends forecasts to ``PATH.part`` and makes them an ``.npz`` at the end, so that an hour takes no memory.

    Arrays of N forecasts, float32: ``frame [N]`` uint64 (the last one seen), ``qpos [N, H, nq]`` (the mean future),
    ``fallen [N]`` int32 (row, -1 for none), ``diverged [N]``, ``delay_ms [N]``; with drawn futures ``drawn
    [N, K, H, nq]``, ``low`` and ``high [N, H, nu]`` rad; ``header``: JSON in UTF-8 as uint8 (fps, skeleton, settings).

    Args:
        path: ``*.npz``.
        skeleton: of the humanoid.
        fps: control frames a second.
        settings: of the forecasts.

    Raises:
        InputError: it cannot be written there.
    """

    def __init__(self, path: Path, skeleton: Skeleton, fps: float, settings: ForecastSettings) -> None:
        if path.suffix != ".npz":
            raise InputError(path, "forecast.out", "forecasts are written as .npz")
        header = {"format": FORMAT, "version": VERSION, "fps": fps, "skeleton": skeleton_to_json(skeleton)}
        self._header = json.dumps(header | {"settings": vars(settings)}).encode()
        self.path, self._part = path, path.with_name(f"{path.name}.part")
        horizon, nq = settings.horizon, skeleton.nq
        fields: list[tuple[str, str, tuple[int, ...]]] = [
            ("frame", "<u8", ()),
            ("fallen", "<i4", ()),
            ("diverged", "?", ()),
            ("delay_ms", "<f4", ()),
            ("qpos", "<f4", (horizon, nq)),
        ]
        if settings.drawn:
            fields += [("drawn", "<f4", (settings.drawn, horizon, nq))]
            fields += [(edge, "<f4", (horizon, nq - 7)) for edge in ("low", "high")]
        self._row = np.zeros(1, dtype=fields)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self._part.open("wb")
        except OSError as error:
            raise InputError(path, "forecast.out", f"cannot be written: {error.strerror}") from None

    def forecast(self, forecast: LiveForecast, delay_ms: float) -> None:
        """Append one."""
        row = self._row[0]
        row["fallen"] = -1 if forecast.fallen is None else forecast.fallen
        row["delay_ms"] = delay_ms
        for name in set(self._row.dtype.names or ()) - {"fallen", "delay_ms"}:
            row[name] = getattr(forecast, name)
        try:
            self._stream.write(self._row.tobytes())
        except OSError as error:
            raise InputError(self.path, "forecast.out", f"cannot be written: {error.strerror}") from None

    def close(self) -> None:
        """Turn what was appended into the file; without a forecast there is none."""
        self._stream.close()
        count = self._part.stat().st_size // self._row.dtype.itemsize
        if count:
            rows = np.memmap(self._part, self._row.dtype, "r", shape=(count,))
            made = self.path.with_name(f".{self.path.name}")
            arrays = {name: rows[name] for name in self._row.dtype.names or ()}
            np.savez(made, header=np.frombuffer(self._header, np.uint8), allow_pickle=False, **arrays)
            os.replace(made, self.path)
        self._part.unlink()
