"""``python -m egopose.evaluate checkpoint=RUN_OR_CHECKPOINT [split=test] [out=DIR]``: score a policy beside PoseReg."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import shlex  # noqa: E402
import sys  # noqa: E402
from collections.abc import Mapping, Sequence  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from omegaconf import DictConfig  # noqa: E402

from egopose import weights  # noqa: E402
from egopose.config import command, from_mapping, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from egopose.evaluation.protocols import Comparison
    from egopose.evaluation.report import TakeVideo
    from egopose.pipeline import Agent


@dataclass(frozen=True)
class Results:
    """Where an evaluation was written, and what it found.

    Attributes:
        folder: of all files, see docs/howto-evaluate.md.
        comparison: the table.
        survival: frames survived per run, see :func:`egopose.evaluation.agents.survival_figures`.
        failsafe: of each run, see :func:`egopose.evaluation.agents.failsafe_figures`.
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
        agents: see :func:`egopose.pipeline.load_agent`; all on the same takes.
        names: of all takes of the material.
        videos: of all takes; None where there is none to show.
        out: folder of the results.

    Raises:
        InputError: a setting is missing or unknown, or the split holds no fragments.
    """
    import torch

    from egopose.evaluation import report
    from egopose.evaluation.agents import evaluate_agent, failsafe_figures, survival_figures
    from egopose.evaluation.protocols import ContactSettings, fragment_names
    from egopose.inference.failsafe import FailSafeSettings
    from egopose.inference.planner_settings import planned_kappa, planner_settings
    from egopose.pipeline import build_networks

    source = "conf/evaluate.yaml"
    failsafe = from_mapping(FailSafeSettings, config["failsafe"], f"{source}: failsafe")
    contact = from_mapping(ContactSettings, config["contact"], f"{source}: contact")
    planner = planner_settings(config.get("planner"))
    split, threads, material = str(config["split"]), int(config["threads"]), agents[0].material
    if split not in ("train", "test"):
        raise InputError(source, "split", f"must be train or test, not {split!r}")
    fragments = list(material.train if split == "train" else material.test)
    if not fragments:
        raise InputError(source, "split", f"the data has no {split} fragments")
    labels = fragment_names(names, fragments)

    window = int(config["failsafe_report"]["window"])
    runs = [
        evaluate_agent(agent, fragments, labels, split, failsafe, contact, threads, window, planner) for agent in agents
    ]
    guards = [failsafe.for_run(agent.config, planned_kappa(planner)) for agent in agents]
    guarded = [failsafe_figures(run, guard, window) for run, guard in zip(runs, guards, strict=True)]
    interval, survive = config["interval"], config["survival"]
    comparison = report.compare_runs(runs, float(interval["level"]), int(interval["draws"]), int(interval["seed"]))
    survival = []
    for agent in agents:
        env = agent.make_env(split, worlds=1)
        torch.manual_seed(int(agent.config["seed"]))
        start_policy, _ = build_networks(agent.config, agent.material, env)
        env.close()
        survival.append(
            survival_figures(agent, start_policy, split, int(survive["worlds"]), int(survive["seed"]), threads)
        )
    about = {
        "command": shlex.join(sys.orig_argv),
        "checkpoints": [str(agent.path) for agent in agents],
        "split": split,
        "corruption": agents[0].config.get("corruption"),
        "rendered_video": any(v is not None and v.rendered for v in videos),
        "filmed_video": any(v is not None and not v.rendered for v in videos),
        "settings": {key: config.get(key) for key in ("failsafe", "planner", "contact", "interval", "survival")},
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
            report.write_footage(folder, video, fragment.start, result.motion.fps)
        if video is None or (shown is not None and number >= shown):
            continue
        path = folder / "side_by_side.mp4"
        motions = {"reference": result.reference, "estimate": result.motion}
        report.write_side_by_side(path, material.humanoid, motions, video, fragment.start, int(config["video"]["size"]))
        written.append(path)
    return Results(out, comparison, survival, guarded, written, report.rendered_notes(about))


def summary(results: Results) -> str:
    """What the terminal shows at the end."""
    from egopose.evaluation import tables, triggers
    from egopose.evaluation.report import HEADLINE

    lines = [tables.as_text(results.comparison, HEADLINE)]
    for run, figures in enumerate(results.survival):
        parts = ", ".join(f"{name.replace('_', ' ')} {found['frames']:.1f}" for name, found in figures.items())
        lines.append(f"frames survived (run {run}): {parts}")
    lines += [f"fail-safe (run {run}): {triggers.as_text(found)}" for run, found in enumerate(results.failsafe)]
    lines += [f"video: {path}" for path in results.videos]
    return "\n".join([*lines, *results.notes, f"all results: {results.folder}"])


def output_folder(out: str | None, checkpoint: Path, split: str) -> Path:
    """Where results go: ``out``, or ``RUN/evaluation/SPLIT``, or ``evaluation/NAME/SPLIT`` here for ``weights:NAME``.

    Raises:
        InputError: ``out`` lies inside the checkpoint, whose files are sealed by checksums.
    """
    run = checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent
    # The package is no place for results.
    beside = Path("evaluation") / run.name if run.resolve().parent == weights.FOLDER else run / "evaluation"
    folder = beside / split if out is None else Path(out)
    if folder.resolve().is_relative_to(checkpoint.resolve()):
        raise InputError(folder, "out", "lies inside the checkpoint; choose another folder")
    return folder


def physics_group(name: str | None) -> dict[str, Any] | None:
    """The config group ``sim`` of that name, to score on other physics than a run was trained in; None for the run's.

    Raises:
        InputError: there is no such group.
    """
    from egopose.config import compose_config

    return None if name is None else {"sim": compose_config("prepare", [f"sim={name}"])["sim"]}


def data_at(folder: str | None, checkpoint: str, which: str) -> dict[str, Any]:
    """The run's own config group ``data`` with its folder there, to be an override; empty for None.

    Raises:
        InputError: None for shipped weights, which know no folder of this machine; the checkpoint cannot be read.
    """
    from egopose.training.checkpoint import find_checkpoint, read_json

    if folder is None and not weights.is_shipped(checkpoint):
        return {}
    data = read_json(find_checkpoint(checkpoint, which), "config")["data"]
    if folder is None:
        raise InputError(
            checkpoint, "data_folder", f"say where the set lies: data_folder=PATH ({data.get('about', '')})"
        )
    return {"data": {**data, "folder": str(Path(folder).expanduser().resolve())}}


@command("evaluate")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.pipeline import load_agent, take_videos
    from egopose.vision.corruption import Corruption

    try:
        values = resolved(config)
        given = values["checkpoint"]
        paths = [str(p) for p in given] if isinstance(given, list) else [str(given)]
        overrides = physics_group(values["physics"]) or {}
        overrides |= {"corruption": values["corruption"]} if "corruption" in values else {}
        which, data = str(values["which"]), values["data_folder"]
        agents = [load_agent(path, which=which, overrides=overrides | data_at(data, path, which)) for path in paths]
        names, videos = take_videos(agents[0].config)
        spoilt = Corruption.from_config(values) is not None
        part = f"{values['split']}-corrupted" if spoilt else str(values["split"])
        out = output_folder(values["out"], agents[0].path, part)
        if agents[0].config["task"]["name"] == "forecasting":
            from egopose.forecast_evaluation import run_forecast_evaluation

            print(run_forecast_evaluation(values, agents, names, videos, out), flush=True)
        else:
            print(summary(run_evaluation(values, agents, names, videos, out)), flush=True)
        if values["report"]:
            from egopose.report import evaluation_report

            print(f"report: {evaluation_report(out, agents[0].material.humanoid)}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
