"""Judges trained runs on clean and on corrupted video: raw results for table.py.

    python experiments/noise/noise.py RUN [RUN ...] [--corruptions jitter drift] [--workers 1] [--results DIR]

A run is a directory of `egopose train` (ours, VGAIL) or of `egopose baseline baseline=path_pose`; each policy's run
brings the regressor along that it follows: VGAIL's is PoseReg, ours may be the blended one. Corruptions are those of
conf/corruption; the wearer's videos are rendered anew for each, once a store. What has been judged is not judged again.
To train on corrupted video: `egopose train ... corruption=jitter`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.core.result_files import write_json
from egopose.core.safe_io import read_yaml
from egopose.data.preparation import flow_name, store_folder
from egopose.data.store import TakeStore
from egopose.evaluation.agents import evaluate_agent
from egopose.evaluation.baseline_scores import score_motions
from egopose.evaluation.protocols import ContactSettings, fragment_names, raw_figures
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.planners import read_planner
from egopose.models.baselines.path_pose import PathPose
from egopose.pipeline.agent import load_agent
from egopose.pipeline.baselines import load_baseline, path_pose_motion
from egopose.pipeline.dataset import run_dataset
from egopose.vision.corruption import Corruption

HERE = Path(__file__).resolve().parent
CORRUPTIONS = ("none", "jitter", "drift", "shake", "dropped", "all")
Result = dict[str, Any]


def method_of(config: Mapping[str, Any]) -> str:
    """The method a run directory's ``config.yaml`` is of.

    Raises:
        InputError: it is of none that estimates.
    """
    if "baseline" in config:
        if config["baseline"].get("kind") != "path_pose":
            raise InputError("run", "baseline.kind", f"is {config['baseline'].get('kind')!r}, which estimates nothing")
        return "pathpose"
    if config["task"].get("context") is not None:
        raise InputError("run", "task", "this run forecasts; the noise study is of estimation")
    return "vgail" if "discriminator" in config["algo"] else "ours"


def regressor_of(config: Mapping[str, Any]) -> str:
    """What the state regressor of a policy's run is called: PoseReg is the network on flow alone."""
    return "posereg" if config["regressor"].get("kernel") is None else "blended"


def planner_of(config: Mapping[str, Any]) -> Any:
    """How a run's body looks ahead, as in `egopose evaluate`; VGAIL's torques cannot be planned for."""
    return compose_config("evaluate", ["checkpoint=none"])["planner"] if method_of(config) == "ours" else None


def judge(run: Path, config: Mapping[str, Any], corruption: Mapping[str, Any]) -> dict[str, Result]:
    """Figures by method on the test fragments, seen through ``corruption`` (a group of conf/corruption)."""
    settings = compose_config("evaluate", ["checkpoint=none"])
    contact = from_mapping(ContactSettings, settings["contact"], "conf/evaluate.yaml: contact")
    if method_of(config) == "pathpose":
        return {"pathpose": _path_pose(run, {**config, "corruption": corruption}, contact)}
    # Not the best: which that is, is decided on test fragments while training.
    overrides = {"corruption": corruption, "vision": config["vision"]}
    agent = load_agent(run, which="latest", overrides=overrides)
    fragments = list(agent.dataset.test)
    labels = _labels(agent.config, fragments)
    failsafe = from_mapping(FailSafeSettings, settings["failsafe"], "conf/evaluate.yaml: failsafe")
    planner, threads = read_planner(planner_of(config)), int(settings["threads"])
    result = evaluate_agent(agent, fragments, labels, "test", failsafe, contact, threads, planner=planner)
    return {
        method_of(config): raw_figures([one.scores for one in result]),
        regressor_of(agent.config): raw_figures([one.pose_regression_scores for one in result]),
    }


def _path_pose(run: Path, config: Mapping[str, Any], contact: ContactSettings) -> Result:
    dataset, model = run_dataset(config, run), load_baseline(run).model
    assert isinstance(model, PathPose)
    flow = TakeStore.open(store_folder(config)).flow(flow_name(config))
    labels = _labels(config, dataset.test)
    motions = [path_pose_motion(model, flow, dataset, f, label) for f, label in zip(dataset.test, labels, strict=True)]
    return raw_figures(score_motions(motions, dataset.test, dataset, contact))


def _labels(config: Mapping[str, Any], fragments: Sequence[Any]) -> list[str]:
    return fragment_names([take.name for take in TakeStore.open(store_folder(config)).takes], fragments)


def judge_all(runs: Sequence[Path], corruptions: Sequence[str], results: Path, workers: int | None = None) -> None:
    """Write ``results/raw/METHOD-FOLD-trained_WITH-seedK-CORRUPTION.json`` for what is not there yet.

    ``workers``: processes that render; None for as many as the run's configuration says.

    Raises:
        InputError: a run or corruption cannot be used.
    """
    for run in runs:
        config = read_yaml(run / "config.yaml", "config")
        if workers is not None:
            config["vision"]["workers"] = workers
        method, trained = method_of(config), _name_of(config.get("corruption"))
        methods = [method] if method == "pathpose" else [method, regressor_of(config)]
        fold = _fold(config["data"]["split"])
        planner = planner_of(config)
        for name in corruptions:
            corruption = compose_config("prepare", [f"corruption={name}"])["corruption"]
            places = {
                one: results / "raw" / f"{one}-{fold}-trained_{trained}-seed{config['seed']}-{name}.json"
                for one in methods
            }
            if all(_is_done(place, corruption, planner, run) for place in places.values()):
                continue
            print(f"{method}: {run} on {name}", flush=True)
            for one, result in judge(run, config, corruption).items():
                about = {"method": one, "fold": fold, "trained": trained, "seed": config["seed"], "corruption": name}
                place = places[one]
                place.parent.mkdir(parents=True, exist_ok=True)
                part = place.with_suffix(".part")
                write_json(
                    part, {**about, "settings": corruption, "planner": planner, "run": run.resolve().name, **result}
                )
                os.replace(part, place)


def _is_done(place: Path, corruption: Mapping[str, Any], planner: Any, run: Path) -> bool:
    try:
        result = json.loads(place.read_text())
        same = result["settings"] == corruption and result.get("planner") == planner
        return bool(same and result["run"] == run.resolve().name)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _name_of(corruption: Mapping[str, Any] | None) -> str:
    """The group of conf/corruption with these settings; ``other`` for settings of one's own."""
    if Corruption.from_config({"corruption": corruption}) is None:
        return "clean"
    groups = (
        name for name in CORRUPTIONS if compose_config("prepare", [f"corruption={name}"])["corruption"] == corruption
    )
    return next(groups, "other")


def _fold(split: Mapping[str, Any]) -> str:
    if split["kind"] == "time":
        return "subject" + "_".join(map(str, split.get("subjects") or ["s_all"]))
    return "without" + "_".join(map(str, split["test_subjects"]))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--corruptions", nargs="+", choices=CORRUPTIONS, default=CORRUPTIONS)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--results", type=Path, default=HERE)
    options = parser.parse_args()
    try:
        judge_all(options.runs, options.corruptions, options.results, options.workers)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
