"""One page of an evaluation of forecasts: error over the horizon with bands, by joint, windows as pictures.

Made from the evaluation's folder alone (docs/howto-forecast.md): figures are those of ``results.json``, curves and
pictures those of ``windows/NAME``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.charts import Chart, Line, line_chart
from egopose.evaluation.estimation_page import ReportSettings, joint_errors, no_pictures, root_aligned_errors
from egopose.evaluation.forecast_metrics import METRICS
from egopose.evaluation.forecast_report import FUTURE_COLOUR, TRUTH_COLOUR, other_file
from egopose.evaluation.page import DAMAGED, Number, Picture, Table, render, result_cell
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
        fps, names = windows[0].truth.fps, windows[0].truth.skeleton.names
        html = render(
            "forecast.html",
            title=f"Forecasts: {results.get('split', '')}",
            data=results,
            **_about(results),
            figures=_figures(results),
            over_horizon={metric: _over_horizon(results, metric) for metric in METRICS},
            over_time=_over_time(errors, fps, methods),
            spread=f"{_SPREAD[1] - _SPREAD[0]:.0%}",
            coverage=_coverage(results, fps),
            **joint_errors(names, {m: e.mean(axis=(0, 1)) for m, e in errors.items()}, methods),
            **_pictures(windows, next(iter(errors.values())), humanoid, settings),
        )
    except (*DAMAGED, ValueError) as error:
        raise InputError(folder / "results.json", "figures", f"is damaged: {error!r}") from None
    out.write_text(html, encoding="utf-8")
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


def _about(results: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "notes": [note for note in results.get("notes", []) if note != RENDERED_NOTE],
        "rendered_note": RENDERED_NOTE if results.get("rendered_video") else None,
        "checkpoints": results.get("checkpoints", []),
        "command": results.get("command"),
        "level": results.get("settings", {}).get("interval", {}).get("level"),
    }


def _figures(results: Mapping[str, Any]) -> Table:
    methods, divided, ours = list(results["figures"]), list(results["ratios"]), results["divided"]
    rows: list[list[Any]] = []
    for metric in METRICS:
        for r, horizon in enumerate(results["horizons_s"]):
            result = [results["figures"][m][metric][r] for m in methods]
            result += [results["ratios"][m][metric][r] for m in divided]
            if any(f is not None for f in result):
                rows.append([_with_unit(metric), f"{horizon:.2f} s", *(_cell(f) for f in result)])
    return Table(["metric", "up to", *methods, *(f"{ours} / {m}" for m in divided)], rows)


def _cell(found: Mapping[str, Any] | None) -> Number:
    cell = result_cell(found, 3)
    # Of one run and one take the bootstrap draws the same mean again and again: no interval.
    return cell if cell.interval is None or cell.interval[0] < cell.interval[1] else Number(cell.value)


def _with_unit(metric: str) -> str:
    return f"{metric} ({_UNITS[metric]})" if _UNITS[metric] else metric


def _over_horizon(results: Mapping[str, Any], metric: str) -> Chart:
    """The mean up to each horizon, a line a method, its interval as ground."""
    lines = []
    for method, figures in results["figures"].items():
        at = [(h, f) for h, f in zip(results["horizons_s"], figures[metric], strict=True) if f is not None]
        band = [[np.nan if f[edge] is None else f[edge] for _, f in at] for edge in ("low", "high")]
        lines.append(Line(method, [h for h, _ in at], [f["value"] for _, f in at], band))
    return line_chart(lines, "mean up to (s)", _with_unit(metric))


def _over_time(errors: Mapping[str, Array], fps: float, order: Sequence[str]) -> Chart:
    """Mean over windows at each frame; about ours the middle 80 % of the windows."""
    lines = []
    for k, (method, result) in enumerate(errors.items()):
        curves = result.mean(axis=2)
        band = np.quantile(curves, _SPREAD, axis=0) if k == 0 else None
        lines.append(Line(method, np.arange(1, curves.shape[1] + 1) / fps, curves.mean(axis=0), band))
    return line_chart(lines, "s into the future", _DISTANCE, order=order)


def _coverage(results: Mapping[str, Any], fps: float) -> Chart | None:
    """How many true angles lie in the bands, frame by frame, beside how many should; None where there are no bands."""
    lines: list[Line] = []
    for run, result in enumerate(results.get("coverage", [])):
        inside = np.asarray(result["held_out_per_frame"], dtype=np.float64)
        seconds = np.arange(1, len(inside) + 1) / fps
        if not lines:
            lines.append(Line("asked for", seconds, np.full(len(inside), float(result["level"]))))
        lines.append(Line(f"run {run}", seconds, inside))
    return line_chart(lines, "s into the future", "share of true joint angles inside") if lines else None


def _pictures(
    windows: Sequence[WindowMotions], errors: Array, humanoid: HumanoidModel | None, settings: ReportSettings
) -> dict[str, Any]:
    """Strips of the worst and the best windows by the mean error ``errors [W, H, J]`` of ours."""
    if why := no_pictures([window.truth for window in windows], humanoid):
        return {"windows": {}, "why_no_windows": why}
    assert humanoid is not None
    means = errors.mean(axis=(1, 2))
    order = [int(w) for w in np.argsort(-means)]
    count = min(settings.moments, max(1, len(order) // 2))
    groups = {"Worst": order[:count], "Best": order[count:][::-1][:count]}
    try:
        strips = {
            title: [
                Picture(_strip(windows[w], humanoid, settings.size), f"{windows[w].name}: {means[w]:.0f} mm")
                for w in chosen
            ]
            for title, chosen in groups.items()
        }
    except RuntimeError as error:
        return {"windows": {}, "why_no_windows": str(error)}
    return {"windows": strips, "why_no_windows": None}


def _strip(window: WindowMotions, humanoid: HumanoidModel, size: int) -> Any:
    """``[size, 3 size, 3]``: a window a third, two thirds and all of its horizon ahead."""
    length = len(window.truth)
    times = np.array([length // 3, 2 * length // 3, length]) - 1
    ours = next(iter(window.told.values()))
    overlays = [(window.truth.qpos[times], TRUTH_COLOUR), *((d.qpos[times], FUTURE_COLOUR) for d in window.drawn)]
    frames = overlay_frames(humanoid.mj_model, ours.qpos[times], overlays, "forecast (green: true)", size)
    return np.concatenate(list(frames), axis=1)
