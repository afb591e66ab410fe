"""The demonstration: from the embedded clips to a trained, evaluated policy, one stage after the other."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.checkpoint.pretrained import PREFIX, pretrained_names
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, store_folder
from egopose.evaluation.agents import survival_figures
from egopose.evaluation.estimation_run import run_evaluation, summary
from egopose.evaluation.forecast_run import run_forecast_evaluation
from egopose.evaluation.take_videos import take_videos
from egopose.pipeline.agent import load_agent
from egopose.pipeline.dataset import absolute_paths, load_dataset
from egopose.pipeline.networks import build_networks
from egopose.pipeline.training import run_training
from egopose.tasks.task import task_of

_BUDGETS = {"full": "demo", "short": "demo_short"}
_SHORTEST_TRAINING = 45.0  # s, on a machine so slow that the budget is used up before


def run_demo(budget: str, overrides: list[str]) -> Path:
    """Everything, one stage after the other; returns the folder of results.

    Args:
        budget: ``full`` or ``short``.
        overrides: of ``conf/train.yaml``.

    Raises:
        InputError: an unknown budget or setting.
    """
    if budget not in _BUDGETS:
        raise InputError("demo", "budget", f"must be one of {', '.join(_BUDGETS)}, not {budget!r}")
    began = time.monotonic()
    config = absolute_paths(compose_config("train", [f"experiment={_BUDGETS[budget]}", *overrides]))
    folder = (Path(config["output"]) / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")).resolve()
    folder.mkdir(parents=True)
    print(
        "egopose demo: embedded clips -> rendered wearer's video -> state regressor -> policy -> evaluation", flush=True
    )
    # Data and regressor first: what time they leave is training's.
    load_dataset(config)
    left = config["demo"]["seconds"] - config["demo"]["evaluation_seconds"] - (time.monotonic() - began)
    config["training"]["max_seconds"] = config["training"]["max_seconds"] or max(_SHORTEST_TRAINING, left)
    run_training(config, folder)

    agent = load_agent(folder, which="latest")
    names, videos = take_videos(agent.config)
    settings = compose_config("evaluate", [f"checkpoint={folder}"])
    results = run_evaluation(settings, [agent], names, videos, folder / "evaluation" / "test")
    print(summary(results), flush=True)

    # Held-out pieces are a few seconds long; the training takes show how long the body really stays up.
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

    shipped = show_shipped(agent.config, folder / "evaluation")
    minutes = (time.monotonic() - began) / 60
    report = {"budget": budget, "minutes": minutes, "survival_train": figures, "policy_over": ratios}
    (folder / "demo.json").write_text(json.dumps({**report, "shipped": shipped}, indent=1))
    print(f"\n{minutes:.1f} minutes; run, checkpoints, tables and videos: {folder}", flush=True)
    return folder


def show_shipped(config: Mapping[str, Any], out: Path) -> dict[str, str]:
    """Estimates and forecasts, by the weights that ship with the package, of the test fragments of ``config``'s data.

    Nobody seen in it was seen in their training: they learned from other people of the same collection. Prints the
    figures; writes what an evaluation writes.

    Args:
        config: of the run on the data, resolved.
        out: for a folder of each.

    Returns:
        The folder of each, by name; those that do not fit the data are left out, with a line.
    """
    written = {}
    for name in pretrained_names():
        own = read_json(find_checkpoint(f"{PREFIX}{name}"), "config")
        seen = {**own, "data": config["data"]}
        if (store_folder(seen), flow_name(seen)) != (store_folder(config), flow_name(config)):
            print(f"\n{PREFIX}{name}: made for another body or camera than this data's; left out", flush=True)
            continue
        agent = load_agent(f"{PREFIX}{name}", overrides={"data": config["data"]})
        names, videos = take_videos(agent.config)
        forecasts = task_of(own).protocol == "forecasts"
        settings = compose_config("evaluate", [f"checkpoint={PREFIX}{name}", *_looks(config, forecasts)])
        print(f"\n{PREFIX}{name} on the same held-out frames, of people it has not seen (docs/model-card.md):")
        try:
            if forecasts:
                print(run_forecast_evaluation(settings, [agent], names, videos, out / name), flush=True)
            else:
                print(summary(run_evaluation(settings, [agent], names, videos, out / name)), flush=True)
        except InputError as error:  # other data than the demo's own may be too short to forecast
            print(f"left out: {error}", flush=True)
            continue
        written[name] = str(out / name)
    return written


def _looks(config: Mapping[str, Any], forecasts: bool) -> list[str]:
    """Overrides of ``conf/evaluate.yaml`` by ``demo.shipped`` of the run."""
    chosen = config["demo"]["shipped"]
    return [
        f"video.takes={chosen['videos']}",
        *([f"forecast.{key}={chosen[key]}" for key in ("horizon", "samples")] if forecasts else []),
    ]
