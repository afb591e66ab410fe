"""What an evaluation leaves behind: tables, JSON, CSV, motions as BVH and npz, and side-by-side videos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.core.result_files import write_columns_csv, write_json
from egopose.evaluation import tables
from egopose.evaluation.agents import FragmentResult
from egopose.evaluation.protocols import METRICS, Comparison, compare
from egopose.inference.outputs import RENDERED_NOTE, file_name, write_motion_files
from egopose.motion.io import write_motion

OURS, BASELINE = "ours", "PoseReg"
PARTLY_RENDERED_NOTE = "The wearer's video of some takes was rendered from real motion capture, not filmed."
HEADLINE = ("E_pose", "E_vel", "A_accl", "mpjpe_root_aligned", "root_drift", "foot_skate", "contact_accuracy")


def compare_runs(runs: Sequence[Sequence[FragmentResult]], level: float, draws: int, seed: int) -> Comparison:
    """The policy of each run against its own PoseReg on the same fragments."""
    methods = {
        OURS: [[take.scores for take in run] for run in runs],
        BASELINE: [[take.pose_regression_scores for take in run] for run in runs],
    }
    return compare(methods, BASELINE, level, draws, seed)


def write_results(
    folder: Path,
    comparison: Comparison,
    runs: Sequence[Sequence[FragmentResult]],
    about: Mapping[str, Any],
) -> None:
    """``results.json``, ``results.md`` and ``takes.csv`` in ``folder``.

    ``about`` goes into the JSON beside the figures; it says at least ``split`` and what :func:`rendered_notes` reads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    reference = {m.key: m.scale * _mean([take.reference_scores.figure(m.key) for take in runs[0]]) for m in METRICS}
    resets = [[take.estimate.n_resets for take in run] for run in runs]
    diverged = sum(take.estimate.diverged for run in runs for take in run)
    result = {"reference": reference, "resets_per_take": resets, "diverged": diverged}
    write_json(folder / "results.json", {**about, **tables.as_dict(comparison), **result})
    runs_and_takes = (
        f"{len(runs)} run{'s' if len(runs) > 1 else ''} on {len(runs[0])} fragments, split {about['split']}."
    )
    notes = [runs_and_takes, *rendered_notes(about)]
    (folder / "results.md").write_text(tables.as_markdown(comparison) + "\n" + "\n".join(notes) + "\n")
    tables.write_csv(folder / "takes.csv", comparison)


def rendered_notes(about: Mapping[str, Any]) -> list[str]:
    """What is to be said where ``rendered_video`` is true of any take, and ``filmed_video`` perhaps of others."""
    if not about["rendered_video"]:
        return []
    return [PARTLY_RENDERED_NOTE if about.get("filmed_video") else RENDERED_NOTE]


def write_take(folder: Path, result: FragmentResult) -> Path:
    """``frames.csv``, ``estimate`` and ``reference`` as BVH and npz, ``pose_regression.npz``, in the take's folder."""
    folder = folder / file_name(result.motion.name)
    folder.mkdir(parents=True, exist_ok=True)
    write_columns_csv(folder / "frames.csv", {**result.scores.frames, **result.estimate.columns()})
    write_motion_files(folder, "estimate", result.motion)
    write_motion_files(folder, "reference", result.reference)
    write_motion(result.pose_regression, folder / "pose_regression.npz")
    return folder


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if v == v]
    return sum(finite) / len(finite) if finite else float("nan")
