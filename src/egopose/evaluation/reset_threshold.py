"""Choosing the fail-safe's threshold for a run, on its training takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from egopose.core.errors import InputError
from egopose.core.result_files import write_json
from egopose.evaluation import metrics
from egopose.evaluation import resets as triggers
from egopose.evaluation.agents import estimate_and_judge
from egopose.evaluation.options import output_folder, physics_group
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.video_regression import require_estimation
from egopose.pipeline.agent import Agent, load_agent

_SOURCE = "conf/evaluate.yaml"


def try_thresholds(agent: Agent, thresholds: Sequence[float], window: int, threads: int) -> list[dict[str, Any]]:
    """The fail-safe at each reset_threshold on all training fragments.

    Args:
        agent: see :func:`egopose.pipeline.agent.load_agent`.
        thresholds: to be tried.
        window: frames, see :func:`egopose.evaluation.resets.take_triggers`.
        threads: of the physics.

    Returns:
        A row a reset_threshold: ``reset_threshold``, ``E_pose`` (rad, mean over takes), and
            :func:`egopose.evaluation.resets.summary`.
    """
    humanoid, worlds = agent.dataset.humanoid, len(agent.dataset.train)
    hands = [int(dof) for dof in humanoid.hand_dofs]
    truth = torch.as_tensor(agent.dataset.reference["qpos"]).double().numpy()
    rows = []
    for reset_threshold in thresholds:
        settings = FailSafeSettings("value", float(reset_threshold), 0.0)
        estimates, judged = estimate_and_judge(agent, worlds, "train", settings, threads, window)
        errors = [
            metrics.pose_error(e.qpos, truth[e.start : e.start + len(e.qpos)], hand_dofs=hands).mean()
            for e in estimates
        ]
        result = triggers.summary([one for one in judged if one is not None], 1.0 / humanoid.control_dt)
        rows.append({"reset_threshold": float(reset_threshold), "E_pose": float(np.mean(errors)), **result})
    return rows


def chosen(rows: Sequence[Mapping[str, Any]]) -> float:
    """The reset_threshold of the largest F1 (see :func:`egopose.evaluation.resets.summary`); of several, the smallest.

    Raises:
        InputError: nothing ever fell and nothing triggered: any reset_threshold is as good.
    """
    reported = [row for row in rows if row["f1"] is not None]
    if not reported:
        raise InputError(
            _SOURCE, "threshold_search.tried", "no fall and no trigger on the training takes: nothing to choose by"
        )
    best = max(row["f1"] for row in reported)
    return float(min(row["reset_threshold"] for row in reported if row["f1"] == best))


def as_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table for the terminal."""
    keys = ("triggers", "foreseen", "late", "false_alarm", "cut_short", "missed")
    lines = [
        "reset_threshold     F1  " + "  ".join(key.replace("_", " ") for key in keys) + "  median lead  fallen  E_pose"
    ]
    for row in rows:
        counts = "  ".join(f"{row[key]:>{len(key)}d}" for key in keys)
        f1, lead = ("-" if row[key] is None else f"{row[key]:.2f}" for key in ("f1", "median_lead_frames"))
        lines.append(
            f"{row['reset_threshold']:5.3f}  {f1:>5}  {counts}  {lead:>11}  {row['fallen_share']:6.1%}"
            f"  {row['E_pose']:.3f}"
        )
    return "\n".join(lines)


def choose_threshold(values: Mapping[str, Any]) -> str:
    """Try the thresholds of ``conf/evaluate.yaml`` on a run's training takes; what the terminal shows.

    Args:
        values: ``conf/evaluate.yaml``, resolved; its group ``threshold_search`` says which to try.

    Raises:
        InputError: a setting is wrong, or nothing ever fell.
    """
    settings = values["threshold_search"]
    thresholds, given = settings["tried"], values["out"]
    if not isinstance(thresholds, list) or not thresholds or not all(isinstance(k, int | float) for k in thresholds):
        raise InputError(_SOURCE, "threshold_search.tried", f"must be a list of numbers, not {thresholds!r}")
    agent = load_agent(str(values["checkpoint"]), None, str(values["which"]), physics_group(values["physics"]))
    require_estimation(agent.config, agent.path)
    own = FailSafeSettings("value", None, 0.0).for_run(agent.config).reset_threshold
    assert own is not None
    usual = round(own, 3)
    window = int(values["failsafe_report"]["window"])
    rows = try_thresholds(agent, sorted({*thresholds, usual}), window, int(values["threads"]))
    folder = output_folder(None, agent.path, "train").parent if given is None else Path(str(given))
    folder.mkdir(parents=True, exist_ok=True)
    reset_threshold = chosen(rows)
    result = {"checkpoint": str(agent.path), "chosen": reset_threshold, "default": usual, "rows": rows}
    write_json(folder / "reset_threshold.json", result)
    best = f"best here: failsafe.reset_threshold={reset_threshold:g}"
    return f"{as_text(rows)}\nevaluate takes {usual:g} unless told otherwise; {best}"
