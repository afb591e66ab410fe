"""The demonstrations: the pretrained weights on a person they have not seen, and training on the embedded clips."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.checkpoint.pretrained import ABOUT, PREFIX, pretrained_names, pretrained_run
from egopose.core import safe_io
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import prepare
from egopose.evaluation.agents import survival_figures
from egopose.evaluation.demo_page import DemoPageSettings, write_demo_page
from egopose.evaluation.estimation_run import run_evaluation, summary
from egopose.evaluation.run import PROTOCOLS
from egopose.evaluation.take_videos import take_videos
from egopose.pipeline.agent import load_agent
from egopose.pipeline.dataset import absolute_paths, load_dataset
from egopose.pipeline.networks import build_networks
from egopose.pipeline.training import run_training
from egopose.tasks.task import task_of

_BUDGETS = {"full": "train_demo", "short": "train_demo_short"}
_SHORTEST_TRAINING = 45.0  # s, on a machine so slow that the budget is used up before


def run_demo(overrides: list[str]) -> Path:
    """Estimates and forecasts by the pretrained weights, on one page; returns the page.

    Args:
        overrides: of ``conf/train.yaml``.

    Raises:
        InputError: an unknown setting, or no weights fit the data.
    """
    config, folder = _begun("demo", overrides)
    seconds: dict[str, float] = {}
    print("egopose demo: a walk of an unseen person -> rendered wearer's video -> estimate and forecast -> page")
    written = show_shipped(config, folder, seconds)
    if not written:
        raise InputError("demo", "data", "no pretrained weights can be shown on it")
    with _stage("page", seconds):
        settings = from_mapping(DemoPageSettings, config["demo"]["page"], "conf/experiment/demo.yaml: demo.page")
        page = write_demo_page(written, settings, folder / "demo.html")
    (folder / "demo.json").write_text(json.dumps({"seconds": seconds, "shipped": _paths(written)}, indent=1))
    print("\n" + "\n".join(f"{stage:<40}{spent:>6.1f} s" for stage, spent in seconds.items()))
    print(f"{'all':<40}{sum(seconds.values()):>6.1f} s")
    print("\nto train a policy yourself: make train-demo   (or: egopose demo train=true)")
    print(f"the page, for any browser: {page}", flush=True)
    return page


def run_training_demo(budget: str, overrides: list[str]) -> Path:
    """From the embedded clips to a trained, evaluated policy, stage after stage; returns the folder of results.

    Args:
        budget: ``full`` or ``short``.
        overrides: of ``conf/train.yaml``.

    Raises:
        InputError: an unknown budget or setting.
    """
    if budget not in _BUDGETS:
        raise InputError("demo", "budget", f"must be one of {', '.join(_BUDGETS)}, not {budget!r}")
    began = time.monotonic()
    config, folder = _begun(_BUDGETS[budget], overrides)
    seconds: dict[str, float] = {}
    print(
        "egopose demo: embedded clips -> rendered wearer's video -> state regressor -> policy -> evaluation", flush=True
    )
    # Data and regressor first: what time they leave is training's.
    with _stage("data, state regressor", seconds):
        load_dataset(config)
    left = config["demo"]["seconds"] - config["demo"]["evaluation_seconds"] - (time.monotonic() - began)
    config["training"]["max_seconds"] = config["training"]["max_seconds"] or max(_SHORTEST_TRAINING, left)
    with _stage("training", seconds):
        run_training(config, folder)

    with _stage("evaluation", seconds):
        agent = load_agent(folder, which="latest")
        names, videos = take_videos(agent.config)
        settings = compose_config("evaluate", [f"checkpoint={folder}"])
        results = run_evaluation(settings, [agent], names, videos, folder / "evaluation" / "test")
    print(summary(results), flush=True)

    # Held-out pieces are a few seconds long; the training takes show how long the body really stays up.
    with _stage("survival", seconds):
        env = agent.make_env("train", num_envs=1)
        start, _ = build_networks(agent.config, agent.dataset, env)
        env.close()
        survive = settings["survival"]
        figures = survival_figures(
            agent, start, "train", int(survive["num_envs"]), int(survive["seed"]), int(settings["threads"])
        )
    policy = figures["policy"]["frames"]
    ratios = {name: policy / result["frames"] for name, result in figures.items() if name != "policy"}
    print("\nframes survived from random starts on the training takes (at most 199):")
    for name, result in figures.items():
        beaten = "" if name == "policy" else f"   policy survives {ratios[name]:.2f} times as long"
        print(f"  {name.replace('_', ' '):<20}{result['frames']:>7.1f}{beaten}")

    minutes = (time.monotonic() - began) / 60
    report = {"budget": budget, "minutes": minutes, "seconds": seconds, "survival_train": figures}
    report |= {"policy_over": ratios}
    (folder / "demo.json").write_text(json.dumps(report, indent=1))
    print(f"\n{minutes:.1f} minutes; run, checkpoints, tables and videos: {folder}", flush=True)
    return folder


def show_shipped(config: Mapping[str, Any], out: Path, seconds: dict[str, float]) -> dict[str, Path]:
    """Estimates and forecasts, by the weights that ship with the package, of the test fragments of ``config``'s data.

    Meant for ``conf/data/demo``, whose people no weights have learned from. Prints the figures; writes what an
    evaluation writes. Weights whose task is scored by neither estimates nor forecasts are passed over.

    Args:
        config: resolved, with ``data`` and ``demo.shipped``.
        out: for a folder of each.
        seconds: of each stage, in their order; those of this one are added.

    Returns:
        The folder of each, by name; those that cannot be shown are left out, with a line.
    """
    written = {}
    for name in filter(is_scored, pretrained_names()):
        own = read_json(find_checkpoint(f"{PREFIX}{name}"), "config")
        seen = {**own, "data": config["data"]}
        protocol = task_of(own).protocol
        settings = compose_config("evaluate", [f"checkpoint={PREFIX}{name}", *_looks(config, protocol)])
        print(f"\n{PREFIX}{name} on frames of people it has not seen (docs/model-card.md):", flush=True)
        try:
            with _stage(f"{name}: video, optical flow", seconds):
                prepare(seen)
            with _stage(f"{name}: {protocol}", seconds):
                agent = load_agent(f"{PREFIX}{name}", overrides={"data": config["data"]})
                names, videos = take_videos(agent.config)
                print(PROTOCOLS[protocol](settings, [agent], names, videos, out / name), flush=True)
        except InputError as error:  # other data than the demo's own may be too short to forecast
            print(f"left out: {error}", flush=True)
            continue
        written[name] = out / name
    return written


def is_scored(name: str) -> bool:
    """Whether the pretrained weights are a policy of a task that :data:`PROTOCOLS` know."""
    about = safe_io.read_json(pretrained_run(name) / ABOUT, "weights")
    try:
        return task_of({"task": {"name": about.get("task")}}).protocol in PROTOCOLS
    except InputError:
        return False


def _looks(config: Mapping[str, Any], protocol: str) -> list[str]:
    """Overrides of ``conf/evaluate.yaml`` by ``demo.shipped``."""
    chosen = config["demo"]["shipped"]
    return [
        f"video.takes={chosen['videos']}",
        *([f"forecast.{key}={chosen[key]}" for key in ("horizon", "samples")] if protocol == "forecasts" else []),
    ]


def _begun(experiment: str, overrides: list[str]) -> tuple[dict[str, Any], Path]:
    """The resolved configuration and a new folder under its ``output``, named after the time."""
    config = absolute_paths(compose_config("train", [f"experiment={experiment}", *overrides]))
    folder = (Path(config["output"]) / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")).resolve()
    folder.mkdir(parents=True)
    return config, folder


@contextmanager
def _stage(name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Keeps how long a stage took that came to its end."""
    began = time.monotonic()
    yield
    seconds[name] = time.monotonic() - began


def _paths(written: Mapping[str, Path]) -> dict[str, str]:
    return {name: str(folder) for name, folder in written.items()}
