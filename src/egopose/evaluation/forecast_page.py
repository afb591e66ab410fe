"""One page of an evaluation of forecasts: error over the horizon with bands, by joint, windows as pictures.

Made from the evaluation's folder alone (docs/howto-forecast.md): figures are those of ``results.json``, curves and
pictures those of ``windows/NAME``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation import charts, page
from egopose.evaluation.charts import Line
from egopose.evaluation.estimation_page import ReportSettings, root_aligned_errors
from egopose.evaluation.forecast_metrics import METRICS
from egopose.evaluation.forecast_report import FUTURE_COLOUR, TRUTH_COLOUR, other_file
from egopose.humanoid.model import HumanoidModel
from egopose.inference.outputs import RENDERED_NOTE
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.vision.overlay import overlay_frames

_UNITS = {"E_pose": "rad", "E_vel": "", "A_accl": ""}
_SPREAD = (0.1, 0.9)  # of the windows: the ground about the mean
_DISTANCE = "MPJPE, roots aligned (mm)"


@dataclass(frozen=True, eq=False)
class WindowMotions:
    """One window of the first run.

    Args:
        name: as in ``results.json``.
        truth: what came. told: by method, ours first; each as long as ``truth``.
        drawn: other futures of ours that are kept.
    """

    name: str
    truth: Motion
    told: Mapping[str, Motion]
    drawn: tuple[Motion, ...]

    def joint_errors(self, method: str) -> Array:
        """``[H, J]`` mm: distance of each joint from the true one, roots moved together."""
        return root_aligned_errors(self.told[method], self.truth)


def write_forecast_page(folder: Path, humanoid: HumanoidModel | None, settings: ReportSettings, out: Path) -> Path:
    """Write the page of an evaluation of forecasts.

    Args:
        folder: of `egopose evaluate`.
        humanoid: whose model is drawn; None for no pictures.
        settings: how much is shown.
        out: the HTML file; its folder must exist.

    Raises:
        InputError: the folder holds no evaluation of forecasts, or a damaged one.
    """
    results = read_json(folder / "results.json", "results")
    if not isinstance(results, dict) or not {"figures", "ratios", "windows", "horizons_s"} <= set(results):
        raise InputError(folder / "results.json", "figures", "is no result of `egopose evaluate` of forecasts")
    try:
        methods = list(results["figures"])
        windows = read_windows(folder, methods)
        errors = {m: np.stack([w.joint_errors(m) for w in windows]) for m in windows[0].told}
        sections = [
            ("What was evaluated", _about(results)),
            ("Figures", _figures(results)),
            ("Error over the horizon", _over_horizon(results)),
            ("Error at each moment of the future", _over_time(errors, windows[0].truth.fps, methods)),
            ("Bands of the joint angles", _coverage(results, windows[0].truth.fps)),
            ("Error by joint", _by_joint(errors, windows[0].truth.skeleton.names, methods)),
            ("Best and worst windows", _pictures(windows, next(iter(errors.values())), humanoid, settings)),
        ]
    except (KeyError, TypeError, AttributeError, IndexError, ValueError) as error:
        raise InputError(folder / "results.json", "figures", f"is damaged: {error!r}") from None
    out.write_text(page.page(f"Forecasts: {results.get('split', '')}", sections, results), encoding="utf-8")
    return out


def read_windows(folder: Path, methods: Sequence[str]) -> list[WindowMotions]:
    """All windows of an evaluation's folder, in order of their names.

    Args:
        folder: of the evaluation.
        methods: of ``results.json``, ours first; those whose futures are kept are read.

    Raises:
        InputError: there are none, or one lacks a motion.
    """
    folders = sorted(path for path in (folder / "windows").glob("*") if path.is_dir())
    if not folders:
        raise InputError(folder, "windows", "there are none; `egopose evaluate` writes them")
    result = []
    for path in folders:
        files = {methods[0]: path / "forecast.npz", **{m: path / other_file(m) for m in methods[1:]}}
        for needed in (path / "reference.npz", path / "forecast.npz"):
            if not needed.is_file():
                raise InputError(needed, "path", "is missing: evaluate anew")
        reported = {method: read_motion(file) for method, file in files.items() if file.is_file()}
        drawn = tuple(read_motion(file) for file in sorted(path.glob("future_*.npz")))
        truth = read_motion(path / "reference.npz")
        if any(len(motion) != len(truth) for motion in (*reported.values(), *drawn)):
            raise InputError(path, "qpos", "the motions of a window differ in length")
        result.append(WindowMotions(path.name, truth, reported, drawn))
    return result


def _about(results: Mapping[str, Any]) -> str:
    lines = [f"<p>{escape(note)}</p>" for note in results.get("notes", []) if note != RENDERED_NOTE]
    if results.get("rendered_video"):
        lines.append(f"<p><strong>{escape(RENDERED_NOTE)}</strong></p>")
    lines += [f"<p>Checkpoint: <code>{escape(str(c))}</code></p>" for c in results.get("checkpoints", [])]
    if command := results.get("command"):
        lines.append(f"<p>Made by</p><pre>{escape(str(command))}</pre>")
    return "".join(lines)


def _figures(results: Mapping[str, Any]) -> str:
    methods, divided, ours = list(results["figures"]), list(results["ratios"]), results["divided"]
    header = ["metric", "up to", *methods, *(f"{ours} / {m}" for m in divided)]
    rows = []
    for metric in METRICS:
        label = f"{metric} ({_UNITS[metric]})" if _UNITS[metric] else metric
        for r, horizon in enumerate(results["horizons_s"]):
            result = [results["figures"][m][metric][r] for m in methods]
            result += [results["ratios"][m][metric][r] for m in divided]
            if any(f is not None for f in result):
                rows.append([page.text(label), page.text(f"{horizon:.2f} s"), *(_cell(f) for f in result)])
    level = results.get("settings", {}).get("interval", {}).get("level")
    said = f"{100 * level:g} % intervals" if isinstance(level, float) else "Intervals"
    return page.table(header, rows) + f'<p class="note">{said} over runs and takes, by bootstrap.</p>'


def _cell(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return page.number(None)
    # Of one run and one take the bootstrap draws the same mean again and again: no interval.
    known = found["low"] is not None and found["low"] < found["high"]
    return page.number(found["value"], 3, (found["low"], found["high"]) if known else None)


def _over_horizon(results: Mapping[str, Any]) -> str:
    """A chart a metric: the mean up to each horizon, a line a method, its interval as ground."""
    parts = []
    for metric in METRICS:
        lines = []
        for method, figures in results["figures"].items():
            at = [(h, f) for h, f in zip(results["horizons_s"], figures[metric], strict=True) if f is not None]
            band = [[np.nan if f[edge] is None else f[edge] for _, f in at] for edge in ("low", "high")]
            lines.append(Line(method, [h for h, _ in at], [f["value"] for _, f in at], band))
        shown = f"{metric} ({_UNITS[metric]})" if _UNITS[metric] else metric
        parts.append(f"<h3>{escape(metric)}</h3>{charts.line_chart(lines, 'mean up to (s)', shown)}")
    return "".join(parts) + '<p class="note">Ground: the intervals of the table; there are none of a single take.</p>'


def _over_time(errors: Mapping[str, Array], fps: float, order: Sequence[str]) -> str:
    """Mean over windows at each frame; about ours the middle 80 % of the windows."""
    lines = []
    for k, (method, result) in enumerate(errors.items()):
        curves = result.mean(axis=2)
        band = np.quantile(curves, _SPREAD, axis=0) if k == 0 else None
        lines.append(Line(method, np.arange(1, curves.shape[1] + 1) / fps, curves.mean(axis=0), band))
    note = f'<p class="note">First run. Ground: the middle {_SPREAD[1] - _SPREAD[0]:.0%} of the windows of ours.</p>'
    return charts.line_chart(lines, "s into the future", _DISTANCE, order=order) + note


def _coverage(results: Mapping[str, Any], fps: float) -> str:
    """How many true angles lie in the bands, frame by frame, beside how many should."""
    lines: list[Line] = []
    for run, result in enumerate(results.get("coverage", [])):
        inside = np.asarray(result["held_out_per_frame"], dtype=np.float64)
        seconds = np.arange(1, len(inside) + 1) / fps
        if not lines:
            lines.append(Line("asked for", seconds, np.full(len(inside), float(result["level"]))))
        lines.append(Line(f"run {run}", seconds, inside))
    if not lines:
        return '<p class="note">No bands: no futures were drawn (forecast.samples=1).</p>'
    return charts.line_chart(lines, "s into the future", "share of true joint angles inside")


def _by_joint(errors: Mapping[str, Array], names: Sequence[str], order: Sequence[str]) -> str:
    means = {method: result.mean(axis=(0, 1)) for method, result in errors.items()}
    rows = [[page.text(n), *(page.number(float(v[k]), 1) for v in means.values())] for k, n in enumerate(names)]
    chart = charts.bar_chart(names[1:], {m: v[1:] for m, v in means.items()}, "distance, roots aligned (mm)", order)
    return chart + page.table(["joint (mm)", *means], rows)


def _pictures(
    windows: Sequence[WindowMotions], errors: Array, humanoid: HumanoidModel | None, settings: ReportSettings
) -> str:
    """Strips of the worst and the best windows by the mean error ``errors [W, H, J]`` of ours."""
    if humanoid is None:
        return '<p class="note">No pictures: the run\'s humanoid is not at hand.</p>'
    if any(window.truth.skeleton != humanoid.skeleton for window in windows):
        return '<p class="note">No pictures: the motions are on another humanoid than the run\'s.</p>'
    means = errors.mean(axis=(1, 2))
    order = [int(w) for w in np.argsort(-means)]
    count = min(settings.moments, max(1, len(order) // 2))
    parts = [
        "<p>The mean future solid, the true motion green, drawn futures blue; from left to right a third, two thirds "
        "and the end of the horizon.</p>"
    ]
    try:
        for title, chosen in (("Worst", order[:count]), ("Best", order[count:][::-1][:count])):
            figures = []
            for w in chosen:
                strip = _strip(windows[w], humanoid, settings.size)
                figures.append(page.picture(strip, f"{windows[w].name}: {means[w]:.0f} mm"))
            parts.append(f'<h3>{title}</h3><div class="moments">{"".join(figures)}</div>')
    except RuntimeError as error:
        return f'<p class="note">No pictures: {escape(str(error))}</p>'
    return "".join(parts)


def _strip(window: WindowMotions, humanoid: HumanoidModel, size: int) -> Any:
    """``[size, 3 size, 3]``: a window a third, two thirds and all of its horizon ahead."""
    length = len(window.truth)
    times = np.array([length // 3, 2 * length // 3, length]) - 1
    ours = next(iter(window.told.values()))
    overlays = [(window.truth.qpos[times], TRUTH_COLOUR), *((d.qpos[times], FUTURE_COLOUR) for d in window.drawn)]
    frames = overlay_frames(humanoid.mj_model, ours.qpos[times], overlays, "forecast (green: true)", size)
    return np.concatenate(list(frames), axis=1)
