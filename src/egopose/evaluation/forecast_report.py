"""What an evaluation of forecasts leaves behind: tables by horizon, JSON, CSV, motions and pictures of futures."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.result_files import write_json
from egopose.data.windows import ForecastWindow
from egopose.evaluation.forecast_metrics import METRICS, ForecastScores
from egopose.evaluation.statistics import Interval, mean_interval, ratio_interval
from egopose.humanoid.model import HumanoidModel
from egopose.inference.outputs import TakeVideo, file_name
from egopose.motion.rotations import Array
from egopose.vision.overlay import overlay_frames
from egopose.vision.rendering import label_frame
from egopose.vision.side_by_side import middle_square
from egopose.vision.video import Frame, iter_frames, write_video

_UNITS = {"E_pose": "rad", "E_vel": "", "A_accl": ""}
#: rgba: the true motion green, other futures blue.
TRUTH_COLOUR, FUTURE_COLOUR = (0.2, 0.75, 0.3, 0.45), (0.3, 0.45, 0.9, 0.25)

#: method -> its runs (training seeds); a future by the mean action, or figures of several drawn ones.
Methods = Mapping[str, Sequence[ForecastScores]]


@dataclass(frozen=True)
class ForecastComparison:
    """``figures[method][metric]``, and ``ratios[other][metric]`` of ``ours`` to each other method: an interval for each
    of ``horizons`` (s), None where forecasts end before it."""

    horizons: tuple[float, ...]
    ours: str
    figures: Mapping[str, Mapping[str, list[Interval | None]]]
    ratios: Mapping[str, Mapping[str, list[Interval | None]]]


def compare_forecasts(
    methods: Methods, ours: str, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> ForecastComparison:
    """Means with bootstrap intervals over runs and takes, and ratios of ``ours`` to others on the same windows.

    Of a method with several futures a window, ``NAME`` is their mean and ``NAME, best of K`` the best at each horizon;
    nothing is divided by those.

    Args:
        methods: all on the same windows, each with one run or as many as ``ours``.
        ours: one of them, with one future a window.
        level, draws, seed: of the intervals.
    """
    result: dict[str, dict[str, Array]] = {}
    for name, runs in methods.items():
        result[name] = {m: np.stack([run.per_take(m) for run in runs]) for m in METRICS}
        if runs[0].samples > 1:
            best = f"{name}, best of {runs[0].samples}"
            result[best] = {m: np.stack([run.per_take(m, "best") for run in runs]) for m in METRICS}
    horizons = tuple(float(h) for h in methods[ours][0].horizons)

    def figure(table: Array) -> Interval | None:
        return None if np.isnan(table).all() else mean_interval(table, level, draws, seed)

    def ratio(mine: Array, other: Array) -> Interval | None:
        return ratio_interval(mine, other, level, draws, seed) if np.nansum(other) > 0 else None

    others = [name for name, runs in methods.items() if name != ours and runs[0].samples == 1]
    columns = range(len(horizons))
    figures = {
        name: {m: [figure(table[m][:, :, r]) for r in columns] for m in METRICS} for name, table in result.items()
    }
    ratios = {
        name: {m: [ratio(result[ours][m][:, :, r], result[name][m][:, :, r]) for r in columns] for m in METRICS}
        for name in others
    }
    return ForecastComparison(horizons, ours, figures, ratios)


def rows(comparison: ForecastComparison) -> tuple[list[str], list[list[str]]]:
    """Header and rows of strings: a row a metric and horizon, a column a method, then ours divided by the others."""
    header = ["metric", "horizon", *comparison.figures, *(f"{comparison.ours} / {m}" for m in comparison.ratios)]
    body = []
    for metric in METRICS:
        label = f"{metric} ({_UNITS[metric]})" if _UNITS[metric] else metric
        for r, horizon in enumerate(comparison.horizons):
            cells = [_cell(table[metric][r]) for table in (*comparison.figures.values(), *comparison.ratios.values())]
            if any(cell != "-" for cell in cells):
                body.append([label, f"{horizon:.2f} s", *cells])
    return header, body


def as_markdown(comparison: ForecastComparison) -> str:
    """A Markdown table."""
    header, body = rows(comparison)
    lines = [header, ["---", "---:"] + ["---:"] * (len(header) - 2), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def write_forecast_results(
    folder: Path,
    comparison: ForecastComparison,
    methods: Methods,
    windows: Sequence[ForecastWindow],
    labels: Sequence[str],
    about: Mapping[str, Any],
    notes: Sequence[str],
) -> None:
    """``results.json``, ``results.md`` and ``windows.csv`` in ``folder``; ``about`` goes into the JSON."""
    folder.mkdir(parents=True, exist_ok=True)

    def plain(table: Mapping[str, Mapping[str, list[Interval | None]]]) -> dict[str, Any]:
        return {
            name: {m: [None if i is None else asdict(i) for i in cells] for m, cells in metrics.items()}
            for name, metrics in table.items()
        }

    values = {
        **about,
        "windows": list(labels),
        "horizons_s": list(comparison.horizons),
        "divided": comparison.ours,
        "figures": plain(comparison.figures),
        "ratios": plain(comparison.ratios),
    }
    write_json(folder / "results.json", values)
    (folder / "results.md").write_text(as_markdown(comparison) + "\n" + "\n".join(notes) + "\n")
    with (folder / "windows.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(
            ["method", "run", "window", "take", "start", "horizon_s", *METRICS, *(f"best_{m}" for m in METRICS)]
        )
        for name, runs in methods.items():
            for number, scores in enumerate(runs):
                for w, (window, label) in enumerate(zip(windows, labels, strict=True)):
                    for r, horizon in enumerate(scores.horizons):
                        cells = [t[m][w, r] for t in (scores.mean, scores.best) for m in METRICS]
                        if not np.isnan(cells).all():
                            place = [name, number, label, window.take, window.start, f"{horizon:.4f}"]
                            writer.writerow([*place, *(f"{cell:.8g}" for cell in cells)])


def other_file(method: str) -> str:
    """Where a window's folder keeps the future that another method tells."""
    return f"other_{file_name(method)}.npz"


def write_futures_video(
    path: Path,
    humanoid: HumanoidModel,
    window: ForecastWindow,
    mean: Array,
    truth: Array,
    drawn: Array,
    video: TakeVideo | None,
    size: int,
) -> None:
    """The mean future (solid), the true one and drawn ones (overlays), beside the end of what was seen.

    Args:
        path: the MP4.
        humanoid: whose model is drawn.
        window: of the forecast.
        mean, truth: ``[H, nq]``.
        drawn: ``[K, H, nq]``; K may be 0.
        video: of the wearer, or None. During the future it stands still on the last frame seen.
        size: pixels a panel.

    Raises:
        InputError: the video cannot be read.
        RuntimeError: no OpenGL here.
    """
    fps = 1.0 / humanoid.control_dt
    overlays = [(truth, TRUTH_COLOUR), *((future, FUTURE_COLOUR) for future in drawn)]
    bodies = overlay_frames(humanoid.mj_model, mean, overlays, "forecast (green: true)", size)
    write_video(path, _beside(bodies, _last_seen(window, video, fps, size)), fps)


def _last_seen(window: ForecastWindow, video: TakeVideo | None, fps: float, size: int) -> Frame | None:
    if video is None:
        return None
    (frame,) = iter_frames(video.path, fps, video.sync_offset + window.now / fps, 1, video.taken_at)
    return label_frame(middle_square(frame, size), f"last seen{' (rendered)' if video.rendered else ''}")


def _beside(frames: Iterator[Frame], picture: Frame | None) -> Iterator[Frame]:
    for frame in frames:
        yield frame if picture is None else np.concatenate([frame, picture], axis=1)


def _cell(interval: Interval | None) -> str:
    return "-" if interval is None else f"{interval.value:.3f} [{interval.low:.3f}, {interval.high:.3f}]"
