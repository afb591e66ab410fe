"""One page of an evaluation: tables, error over time and by joint, the best and the worst moments as pictures.

Made from the evaluation's folder alone (docs/howto-evaluate.md): figures are those of ``results.json``, curves those of
``takes/NAME``.
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
from egopose.evaluation.protocols import METRICS
from egopose.evaluation.report import rendered_notes
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.vision.rendering import side_view_frames

REPORT = "report.html"


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
        sections = [
            ("What was evaluated", _about(results)),
            ("Figures", figures_table(results)),
            ("Frames survived", _survival(results)),
            ("Fail-safe", _failsafe(results)),
            ("Takes", _takes_table(results)),
            ("Error over time", _over_time(takes, settings)),
            ("Error by joint", _by_joint(takes)),
            ("Best and worst moments", _moments(takes, humanoid, settings)),
        ]
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise InputError(folder / "results.json", "figures", f"is damaged: {error!r}") from None
    out.write_text(page.page(f"Evaluation: {results.get('split', '')}", sections, results), encoding="utf-8")
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


def figures_table(results: Mapping[str, Any]) -> str:
    """The table of ``results.json``, a row a metric: methods with intervals, ratios, and the reference's own value."""
    methods, divided, baseline = list(results["figures"]), list(results["ratios"]), results["baseline"]
    header = ["metric", *methods, *(f"{m} / {baseline}" for m in divided), "reference"]
    rows = []
    for metric in METRICS:
        cells = [page.text(f"{metric.label} ({metric.unit})" if metric.unit else metric.label)]
        for part, names, decimals in (("figures", methods, metric.decimals), ("ratios", divided, 3)):
            for name in names:
                result = results[part][name].get(metric.key)
                between = (result["low"], result["high"]) if result and result["low"] is not None else None
                cells.append(page.number(result["value"] if result else None, decimals, between))
        cells.append(page.number(results.get("reference", {}).get(metric.key), metric.decimals))
        rows.append(cells)
    resets = [page.number(results["resets"][m], 1) for m in methods]
    rows.append([page.text("resets"), *resets, *(page.text("") for _ in divided), page.text("")])
    level = results.get("settings", {}).get("interval", {}).get("level")
    said = f"{100 * level:g} % intervals" if isinstance(level, float) else "Intervals"
    return page.table(header, rows) + f'<p class="note">{said} over runs and takes, by bootstrap.</p>'


def _about(results: Mapping[str, Any]) -> str:
    runs = len(next(iter(results["per_take"][next(iter(results["per_take"]))].values())))
    lines = [
        f"<p>{runs} run{'s' if runs > 1 else ''} on {len(results['takes'])} fragments, split "
        f"{escape(str(results.get('split')))}. Curves and pictures are of the first run.</p>"
    ]
    lines += [f"<p><strong>{escape(note)}</strong></p>" for note in rendered_notes(results)]
    lines += [f"<p>Checkpoint: <code>{escape(str(c))}</code></p>" for c in results.get("checkpoints", [])]
    if command := results.get("command"):
        lines.append(f"<p>Made by</p><pre>{escape(str(command))}</pre>")
    return "".join(lines)


def _survival(results: Mapping[str, Any]) -> str:
    rows = [
        [page.text(run), page.text(name.replace("_", " ")), page.number(f["frames"], 1), page.number(f["fell"], 2)]
        for run, result in enumerate(results.get("survival", []))
        for name, f in result.items()
    ]
    return page.table(["run", "controller", "frames until a fall", "share that fell"], rows)


def _failsafe(results: Mapping[str, Any]) -> str:
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
    runs = results.get("failsafe", [])
    header = ["run", "mode", *(key.replace("_", " ") for key in keys), "fallen (% of frames)"]
    rows = [
        [
            page.text(run),
            page.text(result["mode"]),
            *(page.number(result[key], 3 if key == "reset_threshold" else 0) for key in keys),
            page.number(100 * result["fallen_share"], 1),
        ]
        for run, result in enumerate(runs)
    ]
    if not rows:
        return '<p class="note">Not judged: evaluate anew, older evaluations did not.</p>'
    each = [
        [
            page.text(take["take"]),
            page.text(t["frame"]),
            page.text(t["kind"].replace("_", " ")),
            page.number(t["lead_frames"], 0),
        ]
        for take in runs[0]["takes"]
        for t in take["triggers"]
    ]
    note = (
        f'<p class="note">A trigger is right where the body would have fallen within {runs[0]["window_frames"]} frames '
        "without the reset, which was simulated from the very state of the trigger. Lead: frames from the trigger to "
        "that fall; negative where the body had fallen already.</p>"
    )
    return page.table(header, rows) + note + (page.table(["take", "frame", "kind", "lead"], each) if each else "")


def _takes_table(results: Mapping[str, Any]) -> str:
    shown = [m for m in METRICS if m.key in ("E_pose", "E_vel", "A_accl", "mpjpe_root_aligned", "root_drift")]
    ours, *others = results["per_take"]
    header = [
        "take",
        *(f"{m.label}{f' ({m.unit})' if m.unit else ''}, {name}" for m in shown for name in (ours, *others)),
    ]
    rows = []
    for k, take in enumerate(results["takes"]):
        cells = [page.text(take)]
        for metric in shown:
            for name in (ours, *others):
                values = [run[k] for run in results["per_take"][name][metric.key] if run[k] is not None]
                cells.append(page.number(float(np.mean(values)) if values else None, metric.decimals))
        rows.append([*cells, page.number(float(np.mean([run[k] for run in results["resets_per_take"]])), 1)])
    return page.table([*header, "resets"], rows)


def _over_time(takes: Sequence[TakeMotions], settings: ReportSettings) -> str:
    fps = takes[0].reference.fps
    errors = [
        (take.joint_errors(take.estimate).mean(1), take.joint_errors(take.pose_regression).mean(1)) for take in takes
    ]
    longest = max(len(ours) for ours, _ in errors)
    means = [_mean_over([pair[k] for pair in errors], longest) for k in (0, 1)]
    seconds = np.arange(longest) / fps
    label = "MPJPE, roots aligned (mm)"
    parts = [
        "<h3>Mean over takes</h3>",
        charts.line_chart([Line("ours", seconds, means[0]), Line("PoseReg", seconds, means[1])], "s", label),
    ]
    for take, (ours, theirs) in list(zip(takes, errors, strict=True))[: settings.takes]:
        seconds = np.arange(len(ours)) / fps
        resets = seconds[take.columns["reset"] > 0] if "reset" in take.columns else seconds[:0]
        said = f" (dashed: {len(resets)} reset{'s' if len(resets) > 1 else ''})" if len(resets) else ""
        parts.append(f"<h3>{escape(take.name)}{said}</h3>")
        lines = [Line("ours", seconds, ours), Line("PoseReg", seconds, theirs)]
        parts.append(charts.line_chart(lines, "s", label, resets))
        if "confidence" in take.columns:
            lines = [Line("V over its running mean", seconds, take.columns["confidence"])]
            parts.append(charts.line_chart(lines, "s", "confidence", resets))
    return "".join(parts)


def _by_joint(takes: Sequence[TakeMotions]) -> str:
    names = takes[0].reference.skeleton.names
    motions = {"ours": "estimate", "PoseReg": "pose_regression"}
    means = {
        label: np.mean([take.joint_errors(getattr(take, field)).mean(axis=0) for take in takes], axis=0)
        for label, field in motions.items()
    }
    rows = [[page.text(n), *(page.number(float(v[k]), 1) for v in means.values())] for k, n in enumerate(names)]
    chart = charts.bar_chart(names[1:], {label: v[1:] for label, v in means.items()}, "distance, roots aligned (mm)")
    return chart + page.table(["joint (mm)", *means], rows)


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


def _moments(takes: Sequence[TakeMotions], humanoid: HumanoidModel | None, settings: ReportSettings) -> str:
    if humanoid is None:
        return '<p class="note">No pictures: the run\'s humanoid is not at hand.</p>'
    if any(take.reference.skeleton != humanoid.skeleton for take in takes):
        return '<p class="note">No pictures: the motions are on another humanoid than the run\'s.</p>'
    worst, best = worst_and_best(takes, settings.moments, settings.apart)
    places = [*worst, *best]
    poses = [np.stack([getattr(takes[k], part).qpos[t] for k, t in places]) for part in ("reference", "estimate")]
    try:
        frames = list(side_view_frames(humanoid.mj_model, poses, ["reference", "estimate"], settings.size))
    except RuntimeError as error:
        return f'<p class="note">No pictures: {escape(str(error))}</p>'
    captions = []
    for k, t in places:
        away = float(takes[k].joint_errors(takes[k].estimate)[t].mean())
        captions.append(f"{takes[k].name}, {t / takes[k].reference.fps:.2f} s (frame {t}): {away:.0f} mm")
    figures = [page.picture(frame, caption) for frame, caption in zip(frames, captions, strict=True)]
    parts = (("Worst", figures[: len(worst)]), ("Best", figures[len(worst) :]))
    return "".join(f'<h3>{name}</h3><div class="moments">{"".join(result)}</div>' for name, result in parts)


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
