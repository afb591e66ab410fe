"""What an evaluation leaves behind: tables, JSON, CSV, motions as BVH and npz, and side-by-side videos."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egopose.evaluation import tables
from egopose.evaluation.agents import FragmentResult
from egopose.evaluation.compose import side_by_side
from egopose.evaluation.protocols import METRICS, Comparison, compare
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import write_motion
from egopose.motion.motion import Motion
from egopose.vision.video import iter_frames, write_video

OURS, BASELINE = "ours", "PoseReg"
FOOTAGE = "wearer.json"
RENDERED_NOTE = "The wearer's video was rendered from real motion capture, not filmed."
PARTLY_RENDERED_NOTE = "The wearer's video of some takes was rendered from real motion capture, not filmed."
HEADLINE = ("E_pose", "E_vel", "A_accl", "mpjpe_root_aligned", "root_drift", "foot_skate", "contact_accuracy")


@dataclass(frozen=True)
class TakeVideo:
    """The wearer's video of a take: the motion's time t is the video's ``t + sync_offset`` seconds.

    ``taken_at`` is the rate of filming where the file's stamps are not of it, see
    :func:`egopose.vision.video.read_frames`.
    """

    path: Path
    sync_offset: float
    rendered: bool
    taken_at: float | None = None

    @property
    def label(self) -> str:
        """Says in the picture where it comes from."""
        return "wearer's view (rendered)" if self.rendered else "wearer's view"


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
    found = {"reference": reference, "resets_per_take": resets, "diverged": diverged}
    tables.write_json(folder / "results.json", {**about, **tables.as_dict(comparison), **found})
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
    tables.write_columns_csv(folder / "frames.csv", {**result.scores.frames, **result.estimate.columns()})
    write_motion_files(folder, "estimate", result.motion)
    write_motion_files(folder, "reference", result.reference)
    write_motion(result.pose_regression, folder / "pose_regression.npz")
    return folder


def write_footage(folder: Path, video: TakeVideo, start: int, fps: float) -> None:
    """``wearer.json``: where the wearer's video of what lies in ``folder`` is, and how it fits.

    Args:
        folder: of a take or a window.
        video: of the take.
        start: frame of the take that the folder's motions begin at. fps: of the motions.
    """
    found = {
        "video": str(video.path.resolve()),
        "sync_offset": video.sync_offset,
        "start": start / fps,
        "taken_at": video.taken_at,
        "rendered": video.rendered,
    }
    tables.write_json(folder / FOOTAGE, found)


def write_motion_files(folder: Path, name: str, motion: Motion) -> None:
    """``NAME.bvh`` for other programs, ``NAME.npz`` for this one."""
    write_motion(motion, folder / f"{name}.bvh")
    write_motion(motion, folder / f"{name}.npz")


def write_side_by_side(
    path: Path, humanoid: HumanoidModel, motions: Mapping[str, Motion], video: TakeVideo, start: int, size: int
) -> None:
    """The motions from beside and the wearer's view, in step.

    Args:
        path: the MP4.
        humanoid: whose model is drawn.
        motions: label -> motion, all of one length.
        video: of the take the motions lie in.
        start: frame of the take the motions begin at.
        size: pixels a panel.

    Raises:
        InputError: the video cannot be read or ends before the motions.
        RuntimeError: no OpenGL here.
    """
    first = next(iter(motions.values()))
    seen = iter_frames(video.path, first.fps, video.sync_offset + start / first.fps, len(first), video.taken_at)
    bodies = {label: motion.qpos for label, motion in motions.items()}
    write_video(path, side_by_side(humanoid.mj_model, bodies, seen, video.label, size), first.fps)


def file_name(name: str) -> str:
    """A take's name as a folder's: letters, digits, dot, dash and underscore stay."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "take"


def _mean(values: Sequence[float]) -> float:
    finite = [v for v in values if v == v]
    return sum(finite) / len(finite) if finite else float("nan")
