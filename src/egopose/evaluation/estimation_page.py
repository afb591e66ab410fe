"""One page of an evaluation: tables, error over time and by joint, the best and the worst moments as pictures.

Made from the evaluation's folder alone (docs/howto-evaluate.md): figures are those of ``results.json``, curves those of
``takes/NAME``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.evaluation.charts import Chart, Line, bar_chart, line_chart
from egopose.evaluation.page import DAMAGED, Number, Picture, Table, labelled, render, result_cell
from egopose.evaluation.protocols import METRICS
from egopose.evaluation.report import rendered_notes
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.vision.rendering import side_view_frames

REPORT = "report.html"
SHOWN = ("E_pose", "E_vel", "A_accl", "mpjpe_root_aligned", "root_drift")  # metrics of one take, one job
_DISTANCE = "MPJPE, roots aligned (mm)"


@dataclass(frozen=True)
class ReportSettings:
    """See ``conf/report.yaml``.

    Args:
        moments: pictures of the best and of the worst each.
        apart: s between two pictured moments of a take.
        size: pixels a panel.
        takes: takes whose curves are shown; None for all.
    """

    moments: int
    apart: float
    size: int
    takes: int | None


@dataclass(frozen=True)
class TakeMotions:
    """One take of the first run: what was true, what was estimated, and PoseReg's motion."""

    name: str
    reference: Motion
    estimate: Motion
    pose_regression: Motion
    columns: Mapping[str, Array]

    def joint_errors(self, motion: Motion) -> Array:
        """``[T, J]`` mm: distance of each joint from the reference's, roots moved together."""
        return root_aligned_errors(motion, self.reference)


def root_aligned_errors(told: Motion, truth: Motion) -> Array:
    """``[T, J]`` mm: distance of each joint from the true one, roots moved together."""
    there, true = (m.forward_kinematics()[0] for m in (told, truth))
    return 1e3 * np.linalg.norm((there - there[:, :1]) - (true - true[:, :1]), axis=-1)


def write_report(folder: Path, humanoid: HumanoidModel | None, settings: ReportSettings, out: Path) -> Path:
    """Write the page of an evaluation.

    Args:
        folder: of `egopose evaluate`.
        humanoid: whose model is drawn; None for no pictures.
        settings: how much is shown.
        out: the HTML file; its folder must exist.

    Raises:
        InputError: the folder holds no evaluation, or one without the motions this needs.
    """
    results = read_json(folder / "results.json", "results")
    if not isinstance(results, dict) or not {"figures", "ratios", "takes", "per_take", "baseline"} <= set(results):
        raise InputError(folder / "results.json", "figures", "is no result of `egopose evaluate`")
    takes = read_takes(folder)
    try:
        html = render(
            "estimation.html",
            title=f"Evaluation: {results.get('split', '')}",
            data=results,
            **_about(results),
            figures=figures_table(results),
            survival=_survival(results),
            **_failsafe(results.get("failsafe", [])),
            takes=_takes_table(results),
            mean_error=_mean_error(takes),
            curves=[_curves(take) for take in takes[: settings.takes]],
            **_by_joint(takes),
            **_moments(takes, humanoid, settings),
        )
    except DAMAGED as error:
        raise InputError(folder / "results.json", "figures", f"is damaged: {error!r}") from None
    out.write_text(html, encoding="utf-8")
    return out


def read_takes(folder: Path) -> list[TakeMotions]:
    """All takes of an evaluation's folder, in order of their names.

    Raises:
        InputError: there are none, or one lacks a motion or a table of frames.
    """
    folders = sorted(path for path in (folder / "takes").glob("*") if path.is_dir())
    if not folders:
        raise InputError(folder, "takes", "there are none; `egopose evaluate` writes them")
    takes = []
    for path in folders:
        wanted = [path / f"{name}.npz" for name in ("reference", "estimate", "pose_regression")]
        if missing := [p for p in wanted if not p.is_file()]:
            raise InputError(missing[0], "path", "is missing: evaluate anew, older evaluations did not keep it")
        reference, estimate, regressed = (read_motion(p) for p in wanted)
        if not len(reference) == len(estimate) == len(regressed):
            raise InputError(path, "qpos", "reference, estimate and pose_regression differ in length")
        takes.append(TakeMotions(path.name, reference, estimate, regressed, _columns(path / "frames.csv")))
    return takes


def figures_table(results: Mapping[str, Any]) -> Table:
    """The table of ``results.json``, a row a metric: methods with intervals, ratios, and the reference's own value."""
    methods, divided, baseline = list(results["figures"]), list(results["ratios"]), results["baseline"]
    header = ["metric", *methods, *(f"{m} / {baseline}" for m in divided), "reference"]
    rows: list[list[Any]] = []
    for metric in METRICS:
        cells: list[Any] = [labelled(metric)]
        for part, names, decimals in (("figures", methods, metric.decimals), ("ratios", divided, 3)):
            cells += [result_cell(results[part][name].get(metric.key), decimals) for name in names]
        rows.append([*cells, Number(results.get("reference", {}).get(metric.key), metric.decimals)])
    rows.append(["resets", *(Number(results["resets"][m], 1) for m in methods), *("" for _ in divided), ""])
    return Table(header, rows)


def _about(results: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "runs": len(next(iter(results["per_take"][next(iter(results["per_take"]))].values()))),
        "split": results.get("split"),
        "notes": rendered_notes(results),
        "checkpoints": results.get("checkpoints", []),
        "command": results.get("command"),
        "level": results.get("settings", {}).get("interval", {}).get("level"),
    }


def _survival(results: Mapping[str, Any]) -> Table:
    rows = [
        [run, name.replace("_", " "), Number(f["frames"], 1), Number(f["fell"], 2)]
        for run, result in enumerate(results.get("survival", []))
        for name, f in result.items()
    ]
    return Table(["run", "controller", "frames until a fall", "share that fell"], rows)


def _failsafe(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A row a run, and one a trigger of the first run."""
    if not runs:
        return {"failsafe": None}
    keys = (
        "triggers",
        "foreseen",
        "late",
        "false_alarm",
        "cut_short",
        "missed",
        "median_lead_frames",
        "reset_threshold",
    )
    header = ["run", "mode", *(key.replace("_", " ") for key in keys), "fallen (% of frames)"]
    rows = [
        [
            run,
            result["mode"],
            *(Number(result[key], 3 if key == "reset_threshold" else 0) for key in keys),
            Number(100 * result["fallen_share"], 1),
        ]
        for run, result in enumerate(runs)
    ]
    each = [
        [take["take"], t["frame"], t["kind"].replace("_", " "), Number(t["lead_frames"], 0)]
        for take in runs[0]["takes"]
        for t in take["triggers"]
    ]
    return {
        "failsafe": Table(header, rows),
        "window_frames": runs[0]["window_frames"],
        "triggers": Table(["take", "frame", "kind", "lead"], each),
    }


def _takes_table(results: Mapping[str, Any]) -> Table:
    shown = [m for m in METRICS if m.key in SHOWN]
    methods = list(results["per_take"])
    rows = []
    for k, take in enumerate(results["takes"]):
        cells = [take]
        for metric in shown:
            for name in methods:
                values = [run[k] for run in results["per_take"][name][metric.key] if run[k] is not None]
                cells.append(Number(float(np.mean(values)) if values else None, metric.decimals))
        rows.append([*cells, Number(float(np.mean([run[k] for run in results["resets_per_take"]])), 1)])
    return Table(["take", *(f"{labelled(m)}, {name}" for m in shown for name in methods), "resets"], rows)


def _over_time(take: TakeMotions) -> tuple[Array, Array]:
    """``[T]`` mm each: mean over joints, of ours and of PoseReg."""
    return take.joint_errors(take.estimate).mean(1), take.joint_errors(take.pose_regression).mean(1)


def _mean_error(takes: Sequence[TakeMotions]) -> Chart:
    errors = [_over_time(take) for take in takes]
    longest = max(len(ours) for ours, _ in errors)
    seconds = np.arange(longest) / takes[0].reference.fps
    ours, theirs = (_mean_over([pair[k] for pair in errors], longest) for k in (0, 1))
    return line_chart([Line("ours", seconds, ours), Line("PoseReg", seconds, theirs)], "s", _DISTANCE)


def _curves(take: TakeMotions) -> dict[str, Any]:
    """Error over a take and the fail-safe's confidence; resets are marked."""
    ours, theirs = _over_time(take)
    seconds = np.arange(len(ours)) / take.reference.fps
    resets = seconds[take.columns["reset"] > 0] if "reset" in take.columns else seconds[:0]
    lines = [Line("ours", seconds, ours), Line("PoseReg", seconds, theirs)]
    charts = [line_chart(lines, "s", _DISTANCE, resets)]
    if "confidence" in take.columns:
        lines = [Line("V over its running mean", seconds, take.columns["confidence"])]
        charts.append(line_chart(lines, "s", "confidence", resets))
    return {"name": take.name, "resets": len(resets), "charts": charts}


def _by_joint(takes: Sequence[TakeMotions]) -> dict[str, Any]:
    names = takes[0].reference.skeleton.names
    motions = {"ours": "estimate", "PoseReg": "pose_regression"}
    means = {
        label: np.mean([take.joint_errors(getattr(take, field)).mean(axis=0) for take in takes], axis=0)
        for label, field in motions.items()
    }
    return joint_errors(names, means)


def joint_errors(
    names: Sequence[str], means: Mapping[str, Array], order: Sequence[str] | None = None
) -> dict[str, Any]:
    """Chart and table of the error by joint.

    Args:
        names: of the ``J`` joints, the root first; it has no bar, for roots are aligned.
        means: by method, ``[J]`` mm.
        order: see :func:`~egopose.evaluation.charts.bar_chart`.
    """
    chart = bar_chart(names[1:], {m: v[1:] for m, v in means.items()}, "distance, roots aligned (mm)", order)
    rows = [[name, *(Number(float(v[k]), 1) for v in means.values())] for k, name in enumerate(names)]
    return {"joint_chart": chart, "joints": Table(["joint (mm)", *means], rows)}


def worst_and_best(takes: Sequence[TakeMotions], count: int, apart: float) -> tuple[list[tuple[int, int]], ...]:
    """(take, frame) of the greatest and of the least root-aligned error, ``apart`` seconds from each other."""
    errors = [take.joint_errors(take.estimate).mean(axis=1) for take in takes]
    order = sorted((float(e), k, t) for k, values in enumerate(errors) for t, e in enumerate(values))
    gap = apart * takes[0].reference.fps
    out = []
    for ranked in (reversed(order), iter(order)):
        chosen: list[tuple[int, int]] = []
        for _, k, t in ranked:
            if len(chosen) == count:
                break
            if all(k != other or abs(t - at) >= gap for other, at in chosen):
                chosen.append((k, t))
        out.append(chosen)
    return tuple(out)


def _moments(takes: Sequence[TakeMotions], humanoid: HumanoidModel | None, settings: ReportSettings) -> dict[str, Any]:
    if why := no_pictures([take.reference for take in takes], humanoid):
        return {"moments": {}, "why_no_moments": why}
    assert humanoid is not None
    worst, best = worst_and_best(takes, settings.moments, settings.apart)
    places = [*worst, *best]
    poses = [np.stack([getattr(takes[k], part).qpos[t] for k, t in places]) for part in ("reference", "estimate")]
    try:
        frames = list(side_view_frames(humanoid.mj_model, poses, ["reference", "estimate"], settings.size))
    except RuntimeError as error:
        return {"moments": {}, "why_no_moments": str(error)}
    captions = []
    for k, t in places:
        away = float(takes[k].joint_errors(takes[k].estimate)[t].mean())
        captions.append(f"{takes[k].name}, {t / takes[k].reference.fps:.2f} s (frame {t}): {away:.0f} mm")
    pictures = [Picture(frame, caption) for frame, caption in zip(frames, captions, strict=True)]
    return {"moments": {"Worst": pictures[: len(worst)], "Best": pictures[len(worst) :]}, "why_no_moments": None}


def no_pictures(motions: Sequence[Motion], humanoid: HumanoidModel | None) -> str | None:
    """Why ``motions`` cannot be drawn as ``humanoid``, or None."""
    if humanoid is None:
        return "the run's humanoid is not at hand."
    if any(motion.skeleton != humanoid.skeleton for motion in motions):
        return "the motions are on another humanoid than the run's."
    return None


def _mean_over(curves: Sequence[Array], length: int) -> Array:
    """Mean of curves of different lengths, over those that reach so far."""
    total, count = np.zeros(length), np.zeros(length)
    for curve in curves:
        total[: len(curve)] += curve
        count[: len(curve)] += 1
    return total / count


def _columns(path: Path) -> dict[str, Array]:
    """Columns of ``frames.csv``; empty cells are NaN."""
    try:
        with path.open(encoding="utf-8") as stream:
            names = stream.readline().strip().split(",")
            values = np.genfromtxt(stream, delimiter=",", ndmin=2, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise InputError(path, "table", f"cannot be read: {' '.join(str(error).split())}"[:200]) from None
    if values.shape[1] != len(names):
        raise InputError(path, "table", f"{values.shape[1]} columns under {len(names)} names")
    return {name: values[:, k] for k, name in enumerate(names)}
