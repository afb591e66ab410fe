"""Which figures a take gets, and how methods are compared over takes and training runs.

A figure is the mean over a take's frames; a table's figure is the unweighted mean over takes, then over runs (the
paper's protocol), with a bootstrap interval over both.

What is held out is the split's (``conf/data``): ``kind: time`` is the paper's single subject, ``kind: subject`` its
cross subject. In the wild is a cross-subject run judged by E_key on videos of unseen rooms and other cameras
(``vision=wild``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from egopose.data.fragments import FragmentLike
from egopose.evaluation import metrics, position_metrics
from egopose.evaluation.keypoints import motion_keypoints, side_view_error
from egopose.evaluation.statistics import Interval, mean_interval, ratio_interval
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.model import HumanoidModel
from egopose.motion.contacts import contact_labels
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class ContactSettings:
    """When a sole point stands on the ground: at or below ``height`` (m) and no faster than ``speed`` (m/s)."""

    height: float
    speed: float


@dataclass(frozen=True)
class Metric:
    """How a figure is shown: smaller is better for all of them but ``contact_accuracy``."""

    key: str
    label: str
    unit: str
    decimals: int
    scale: float = 1.0


METRICS = (
    Metric("E_pose", "E_pose", "rad", 3),
    Metric("E_vel", "E_vel", "", 3),
    Metric("A_accl", "A_accl", "", 3),
    Metric("A_accl_actuated", "A_accl (actuated)", "rad/s^2", 3),
    Metric("E_key", "E_key, side view", "", 3),
    Metric("mpjpe", "MPJPE", "mm", 1, 1e3),
    Metric("mpjpe_root_aligned", "MPJPE, roots aligned", "mm", 1, 1e3),
    Metric("mpjpe_procrustes", "PA-MPJPE", "mm", 1, 1e3),
    Metric("wa_mpjpe", "WA-MPJPE", "mm", 1, 1e3),
    Metric("w_mpjpe", "W-MPJPE", "mm", 1, 1e3),
    Metric("root_translation_error", "root translation error", "mm", 1, 1e3),
    Metric("root_drift", "root drift", "mm", 1, 1e3),
    Metric("foot_skate", "foot skate", "mm/s", 1, 1e3),
    Metric("ground_penetration", "ground penetration", "mm", 2, 1e3),
    Metric("contact_accuracy", "contact accuracy", "%", 1, 1e2),
    Metric("jitter", "jitter", "m/s^3", 1),
)


@dataclass(frozen=True)
class TakeScores:
    """The figures of one method on one take.

    Args:
        name: of the take (with its frames, where it is a fragment).
        frames: per-frame figures, each of at most T values: metrics of differences have fewer and end with the take.
        scalars: figures that are no mean over all frames (``foot_skate``, ``E_key``).
        resets: how often the fail-safe restarted the humanoid; 0 for kinematic methods.
    """

    name: str
    frames: Mapping[str, Array]
    scalars: Mapping[str, float] = field(default_factory=dict)
    resets: int = 0

    def figure(self, key: str) -> float:
        """The take's value of a metric: the mean over its frames; NaN where it has none."""
        if key in self.scalars:
            return self.scalars[key]
        return float(np.mean(self.frames[key])) if key in self.frames else float("nan")


def score_take(
    name: str, estimate: Array, reference: Array, humanoid: HumanoidModel, contact: ContactSettings, resets: int = 0
) -> TakeScores:
    """All figures of an estimated ``qpos [T, nq]`` against the reference's.

    Raises:
        ValueError: shapes differ, or fewer than 4 frames.
    """
    hands, fps = [int(d) for d in humanoid.hand_dofs], 1.0 / humanoid.control_dt
    motions = [Motion(humanoid.skeleton, qpos, fps) for qpos in (estimate, reference)]
    positions, true_positions = (motion.forward_kinematics()[0] for motion in motions)
    soles, true_soles = (sole_positions(humanoid, motion) for motion in motions)
    contacts, true_contacts = (
        contact_labels(points, fps, height=contact.height, speed=contact.speed) for points in (soles, true_soles)
    )
    frames = {
        "E_pose": metrics.pose_error(estimate, reference, hands),
        "E_vel": metrics.velocity_error(estimate, reference, hands, fps),
        "A_accl": metrics.acceleration(estimate, hands, fps),
        "A_accl_actuated": metrics.acceleration_actuated(estimate, hands, fps),
        "mpjpe": position_metrics.mpjpe(positions, true_positions),
        "mpjpe_root_aligned": position_metrics.mpjpe_root_aligned(positions, true_positions),
        "mpjpe_procrustes": position_metrics.mpjpe_procrustes(positions, true_positions),
        "wa_mpjpe": position_metrics.wa_mpjpe(positions, true_positions),
        "w_mpjpe": position_metrics.w_mpjpe(positions, true_positions),
        "root_translation_error": position_metrics.root_translation_error(positions[:, 0], true_positions[:, 0]),
        "root_drift": position_metrics.root_drift(positions[:, 0], true_positions[:, 0]),
        "ground_penetration": position_metrics.ground_penetration(soles),
        "contact_accuracy": position_metrics.contact_accuracy(contacts, true_contacts),
        "jitter": position_metrics.jitter(positions, fps),
    }
    seen, true_seen = (
        motion_keypoints(humanoid.skeleton, p, qpos) for p, qpos in ((positions, estimate), (true_positions, reference))
    )
    scalars = {
        "foot_skate": position_metrics.foot_skate(soles, contacts, fps),
        "E_key": side_view_error(seen, true_seen)[0],
    }
    return TakeScores(name, frames, scalars, resets)


def fragment_names(takes: Sequence[str], fragments: Sequence[FragmentLike]) -> list[str]:
    """``TAKE_START-STOP`` of each, by which its figures are known; ``takes`` are the names of all takes."""
    return [f"{takes[f.take]}_{f.start}-{f.stop}" for f in fragments]


def raw_figures(scores: Sequence[TakeScores]) -> dict[str, Any]:
    """A method's raw result: ``takes``, ``figures[metric][take]`` in the units of :data:`METRICS`, ``resets[take]``,
    ``frames[take]``."""
    return {
        "takes": [one.name for one in scores],
        "figures": {m.key: [m.scale * one.figure(m.key) for one in scores] for m in METRICS},
        "resets": [one.resets for one in scores],
        "frames": [len(one.frames["E_pose"]) for one in scores],
    }


@dataclass(frozen=True)
class Comparison:
    """Methods by metrics.

    Attributes:
        takes: names of the takes, in order.
        figures: ``figures[method][metric]``, in the units of :data:`METRICS`.
        ratios: ``ratios[method][metric]`` to ``baseline`` on the same takes.
        baseline: the method others are divided by.
        resets: mean over runs of the sum over takes.
        per_take: ``per_take[method][metric][run][take]``.
    """

    takes: tuple[str, ...]
    figures: Mapping[str, Mapping[str, Interval]]
    ratios: Mapping[str, Mapping[str, Interval]]
    baseline: str
    resets: Mapping[str, float]
    per_take: Mapping[str, Mapping[str, list[list[float]]]]


def compare(
    methods: Mapping[str, Sequence[Sequence[TakeScores]]],
    baseline: str,
    level: float = 0.95,
    draws: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Means with intervals over runs and takes, and ratios to the baseline on the same takes.

    Args:
        methods: per method its runs (training seeds), per run its takes; all runs on the same takes in the same order.
        baseline: one of ``methods``; it has one run, or as many as each of the others.
        level: of the intervals.
        draws, seed: of the bootstrap.

    Raises:
        ValueError: the baseline is missing or the takes differ.
    """
    if baseline not in methods:
        raise ValueError(f"no method {baseline!r} to compare with; there are {', '.join(methods)}")
    takes = tuple(s.name for s in methods[baseline][0])
    for method, runs in methods.items():
        for run in runs:
            if tuple(s.name for s in run) != takes:
                raise ValueError(f"{method} was not scored on the takes of {baseline}")
    scores = {
        method: {m.key: np.array([[m.scale * take.figure(m.key) for take in run] for run in runs]) for m in METRICS}
        for method, runs in methods.items()
    }
    figures = {
        method: {k: mean_interval(v, level, draws, seed) for k, v in table.items() if np.isfinite(v).any()}
        for method, table in scores.items()
    }
    ratios = {
        method: {
            k: ratio_interval(v, scores[baseline][k], level, draws, seed)
            for k, v in table.items()
            if k in figures[method] and k in figures[baseline] and figures[baseline][k].value > 0
        }
        for method, table in scores.items()
        if method != baseline
    }
    resets = {
        method: float(np.mean([sum(take.resets for take in run) for run in runs])) for method, runs in methods.items()
    }
    per_take = {method: {k: v.tolist() for k, v in table.items()} for method, table in scores.items()}
    return Comparison(takes, figures, ratios, baseline, resets, per_take)
