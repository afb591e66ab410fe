"""``python -m egopose.evaluate checkpoint=RUN_OR_CHECKPOINT [split=test] [out=DIR]``: score a policy beside PoseReg."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.evaluation import report, tables
from egopose.evaluation import resets as triggers
from egopose.evaluation.agents import evaluate_agent, failsafe_figures, survival_figures
from egopose.evaluation.protocols import Comparison, ContactSettings, fragment_names
from egopose.evaluation.report import HEADLINE
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.outputs import TakeVideo, write_footage, write_side_by_side
from egopose.inference.planners import planned_threshold, read_planner
from egopose.pipeline.agent import Agent
from egopose.pipeline.networks import build_networks

_GROUPS = ("failsafe", "planner", "contact", "interval", "survival")


@dataclass(frozen=True)
class Results:
    """Where an evaluation was written, and what it found.

    Attributes:
        folder: of all files, see docs/howto-evaluate.md.
        comparison: the table.
        survival: frames survived per run, see :func:`egopose.evaluation.agents.survival_figures`.
        failsafe: of each run, see :func:`egopose.evaluation.agents.failsafe_figures`; none where it is live.
        videos: the side-by-side MP4s.
        notes: what is to be said of the wearer's videos, where any was rendered.
    """

    folder: Path
    comparison: Comparison
    survival: list[dict[str, dict[str, float]]]
    failsafe: list[dict[str, Any]]
    videos: list[Path]
    notes: list[str]


def run_evaluation(
    config: Mapping[str, Any],
    agents: Sequence[Agent],
    names: Sequence[str],
    videos: Sequence[TakeVideo | None],
    out: Path,
) -> Results:
    """Score agents (runs of one method with different seeds) and write everything.

    Args:
        config: resolved ``conf/evaluate.yaml``.
        agents: see :func:`egopose.pipeline.agent.load_agent`; all on the same takes.
        names: of all takes of the dataset.
        videos: of all takes; None where there is none to show.
        out: folder of the results.

    Raises:
        InputError: a setting is missing or unknown, or the split holds no fragments.
    """
    source = "conf/evaluate.yaml"
    failsafe = from_mapping(FailSafeSettings, config["failsafe"], f"{source}: failsafe")
    contact = from_mapping(ContactSettings, config["contact"], f"{source}: contact")
    planner = read_planner(config.get("planner"))
    split, threads, dataset = str(config["split"]), int(config["threads"]), agents[0].dataset
    if split not in ("train", "test"):
        raise InputError(source, "split", f"must be train or test, not {split!r}")
    fragments = list(dataset.train if split == "train" else dataset.test)
    if not fragments:
        raise InputError(source, "split", f"the data has no {split} fragments")
    labels = fragment_names(names, fragments)

    window = int(config["failsafe_report"]["window"])
    lookahead = int(config["lookahead"]) if config["causal"] else None
    runs = [
        evaluate_agent(agent, fragments, labels, split, failsafe, contact, threads, window, planner, lookahead)
        for agent in agents
    ]
    guards = [failsafe.for_run(agent.config, planned_threshold(planner)) for agent in agents]
    guarded = []
    if lookahead is None:  # a live run's triggers are not simulated on
        guarded = [failsafe_figures(run, guard, window) for run, guard in zip(runs, guards, strict=True)]
    interval, survive = config["interval"], config["survival"]
    comparison = report.compare_runs(runs, float(interval["level"]), int(interval["draws"]), int(interval["seed"]))
    survival = []
    for agent in agents:
        env = agent.make_env(split, num_envs=1)
        torch.manual_seed(int(agent.config["seed"]))
        start_policy, _ = build_networks(agent.config, agent.dataset, env)
        env.close()
        survival.append(
            survival_figures(agent, start_policy, split, int(survive["num_envs"]), int(survive["seed"]), threads)
        )
    about = {
        "command": shlex.join(sys.orig_argv),
        "checkpoints": [str(agent.path) for agent in agents],
        "split": split,
        "corruption": agents[0].config.get("corruption"),
        "rendered_video": any(v is not None and v.rendered for v in videos),
        "filmed_video": any(v is not None and not v.rendered for v in videos),
        "settings": {key: config.get(key) for key in ("causal", "lookahead", *_GROUPS)},
        "survival": survival,
        "failsafe": guarded,
    }
    report.write_results(out, comparison, runs, about)

    shown = config["video"]["takes"]
    written = []
    for number, (fragment, result) in enumerate(zip(fragments, runs[0], strict=True)):
        folder = report.write_take(out / "takes", result)
        video = videos[fragment.take]
        if video is not None:
            write_footage(folder, video, fragment.start, result.motion.fps)
        if video is None or (shown is not None and number >= shown):
            continue
        path = folder / "side_by_side.mp4"
        motions = {"reference": result.reference, "estimate": result.motion}
        write_side_by_side(path, dataset.humanoid, motions, video, fragment.start, int(config["video"]["size"]))
        written.append(path)
    return Results(out, comparison, survival, guarded, written, report.rendered_notes(about))


def summary(results: Results) -> str:
    """What the terminal shows at the end."""
    lines = [tables.as_text(results.comparison, HEADLINE)]
    for run, figures in enumerate(results.survival):
        parts = ", ".join(f"{name.replace('_', ' ')} {result['frames']:.1f}" for name, result in figures.items())
        lines.append(f"frames survived (run {run}): {parts}")
    lines += [f"fail-safe (run {run}): {triggers.as_text(result)}" for run, result in enumerate(results.failsafe)]
    lines += [f"video: {path}" for path in results.videos]
    return "\n".join([*lines, *results.notes, f"all results: {results.folder}"])
