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
from egopose.inference.failsafe import FailSafeSettings, paper_kappa
from egopose.inference.video_regression import require_estimation
from egopose.pipeline.agent import Agent, load_agent

_SOURCE = "conf/evaluate.yaml"


def try_kappas(agent: Agent, kappas: Sequence[float], window: int, threads: int) -> list[dict[str, Any]]:
    """The fail-safe at each kappa on all training fragments.

    Args:
        agent: see :func:`egopose.pipeline.agent.load_agent`.
        kappas: to be tried.
        window: frames, see :func:`egopose.evaluation.resets.take_triggers`.
        threads: of the physics.

    Returns:
        A row a kappa: ``kappa``, ``E_pose`` (rad, mean over takes), and :func:`egopose.evaluation.resets.summary`.
    """
    humanoid, worlds = agent.material.humanoid, len(agent.material.train)
    hands = [int(dof) for dof in humanoid.hand_dofs]
    truth = torch.as_tensor(agent.material.reference["qpos"]).double().numpy()
    rows = []
    for kappa in kappas:
        settings = FailSafeSettings("value", float(kappa), 0.0)
        estimates, judged = estimate_and_judge(agent, worlds, "train", settings, threads, window)
        errors = [
            metrics.pose_error(e.qpos, truth[e.start : e.start + len(e.qpos)], hand_dofs=hands).mean()
            for e in estimates
        ]
        found = triggers.summary([one for one in judged if one is not None], 1.0 / humanoid.control_dt)
        rows.append({"kappa": float(kappa), "E_pose": float(np.mean(errors)), **found})
    return rows


def chosen(rows: Sequence[Mapping[str, Any]]) -> float:
    """The kappa of the largest F1 (see :func:`egopose.evaluation.resets.summary`); of several, the smallest.

    Raises:
        InputError: nothing ever fell and nothing triggered: any kappa is as good.
    """
    told = [row for row in rows if row["f1"] is not None]
    if not told:
        raise InputError(
            _SOURCE, "reset_threshold.tried", "no fall and no trigger on the training takes: nothing to choose by"
        )
    best = max(row["f1"] for row in told)
    return float(min(row["kappa"] for row in told if row["f1"] == best))


def as_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table for the terminal."""
    keys = ("triggers", "foreseen", "late", "false_alarm", "cut_short", "missed")
    lines = ["kappa     F1  " + "  ".join(key.replace("_", " ") for key in keys) + "  median lead  fallen  E_pose"]
    for row in rows:
        counts = "  ".join(f"{row[key]:>{len(key)}d}" for key in keys)
        f1, lead = ("-" if row[key] is None else f"{row[key]:.2f}" for key in ("f1", "median_lead_frames"))
        lines.append(
            f"{row['kappa']:5.3f}  {f1:>5}  {counts}  {lead:>11}  {row['fallen_share']:6.1%}  {row['E_pose']:.3f}"
        )
    return "\n".join(lines)


def choose_threshold(values: Mapping[str, Any]) -> str:
    """Try the thresholds of ``conf/evaluate.yaml`` on a run's training takes; what the terminal shows.

    Args:
        values: ``conf/evaluate.yaml``, resolved; its group ``reset_threshold`` says which to try.

    Raises:
        InputError: a setting is wrong, or nothing ever fell.
    """
    settings = values["reset_threshold"]
    kappas, given = settings["tried"], values["out"]
    if not isinstance(kappas, list) or not kappas or not all(isinstance(k, int | float) for k in kappas):
        raise InputError(_SOURCE, "reset_threshold.tried", f"must be a list of numbers, not {kappas!r}")
    agent = load_agent(str(values["checkpoint"]), None, str(values["which"]), physics_group(values["physics"]))
    require_estimation(agent.config, agent.path)
    usual = round(paper_kappa(float(agent.config["algo"]["gamma"])), 3)
    window = int(values["failsafe_report"]["window"])
    rows = try_kappas(agent, sorted({*kappas, usual}), window, int(values["threads"]))
    folder = output_folder(None, agent.path, "train").parent if given is None else Path(str(given))
    folder.mkdir(parents=True, exist_ok=True)
    kappa = chosen(rows)
    found = {"checkpoint": str(agent.path), "chosen": kappa, "default": usual, "rows": rows}
    write_json(folder / "reset_threshold.json", found)
    return f"{as_text(rows)}\nevaluate takes {usual:g} unless told otherwise; best here: failsafe.kappa={kappa:g}"
