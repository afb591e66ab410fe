"""What ``egopose evaluate`` does: load the runs, score them as their task asks, write the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.evaluation.estimation_run import run_evaluation, summary
from egopose.evaluation.forecast_run import run_forecast_evaluation
from egopose.evaluation.options import data_at, output_folder, physics_group
from egopose.evaluation.reconstruction_run import run_reconstruction, write_rollout_page
from egopose.evaluation.reports import evaluation_report
from egopose.evaluation.reset_threshold import choose_threshold
from egopose.evaluation.take_videos import take_videos
from egopose.pipeline.agent import Agent, load_agent
from egopose.tasks.task import task_of
from egopose.vision.corruption import Corruption


def _estimates(*arguments: Any) -> str:
    return summary(run_evaluation(*arguments))


def _evaluation_page(out: Path, agents: Sequence[Agent]) -> Path:
    return evaluation_report(out, agents[0].dataset.humanoid)


#: How policies of a task are scored, by what the task says; see :class:`egopose.tasks.task.Task`.
PROTOCOLS = {"estimates": _estimates, "forecasts": run_forecast_evaluation, "reconstruction": run_reconstruction}
#: And the page of what was found.
PAGES = {"estimates": _evaluation_page, "forecasts": _evaluation_page, "reconstruction": write_rollout_page}


def evaluate(values: Mapping[str, Any]) -> str:
    """Score the checkpoints that ``conf/evaluate.yaml`` names, and write all files.

    Args:
        values: ``conf/evaluate.yaml``, resolved.

    Returns:
        What the terminal shows.

    Raises:
        InputError: a checkpoint, the data or a setting cannot be used; names it.
    """
    if values["threshold_search"]["enabled"]:
        return choose_threshold(values)
    given = values["checkpoint"]
    paths = [str(p) for p in given] if isinstance(given, list) else [str(given)]
    overrides = physics_group(values["physics"]) or {}
    overrides |= {"corruption": values["corruption"]} if "corruption" in values else {}
    which, data = str(values["which"]), values["data_folder"]
    agents = [load_agent(path, which=which, overrides=overrides | data_at(data, path, which)) for path in paths]
    # A clip's data comes from no store, and nobody wore a camera.
    stored = agents[0].dataset.store_fingerprint is not None
    names, videos = take_videos(agents[0].config) if stored else ([], [])
    spoilt = Corruption.from_config(values) is not None
    part = f"{values['split']}-corrupted" if spoilt else str(values["split"])
    out = output_folder(values["out"], agents[0].path, part)
    protocol = task_of(agents[0].config).protocol
    text = PROTOCOLS[protocol](values, agents, names, videos, out)
    if values["report"]:
        text += f"\nreport: {PAGES[protocol](out, agents)}"
    return text
