"""One job of the study: its run trained as far as that is to be done, judged, its raw result written."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from study import Job

from egopose.core.config import compose_config, from_mapping
from egopose.core.result_files import write_json
from egopose.data.preparation import flow_name, store_folder
from egopose.data.store import TakeStore
from egopose.data.windows import ForecastWindow, forecast_windows
from egopose.evaluation.agents import evaluate_agent
from egopose.evaluation.baseline_scores import score_motions
from egopose.evaluation.forecast_metrics import score_forecasts, true_futures
from egopose.evaluation.forecast_run import ForecastSettings, forecast_windows_of, windows_of
from egopose.evaluation.protocols import ContactSettings, fragment_names, raw_figures
from egopose.inference.context_states import context_states
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.forecast_contexts import past_states
from egopose.inference.forecast_start import begin_forecasts
from egopose.inference.planners import read_planner
from egopose.models.baselines.path_pose import PathPose
from egopose.models.baselines.recurrent import RecurrentForecaster
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent, load_agent
from egopose.pipeline.baselines import (
    forecast_qpos,
    load_baseline,
    path_pose_motion,
    regressed_motion,
    run_baseline_job,
)
from egopose.pipeline.dataset import absolute_paths, load_dataset, run_dataset
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.regressor_input import seen_in_store
from egopose.pipeline.training import run_job as train_job
from egopose.tasks.dataset import Dataset
from egopose.training.logging import write_provenance
from egopose.training.survival import base_tracking, frames_survived, reference_tracking

Result = dict[str, Any]


def run_job(job: Job, runs: Path, results: Path, machine: Sequence[str]) -> None:
    """Train what is left to train, judge, write ``job.raw(results)`` whole or not at all.

    Args:
        job: which.
        runs: where run directories and the folds' own stores lie.
        results: where raw results go.
        machine: overrides for what differs between machines.

    Raises:
        InputError: settings or data do not fit.
        SystemExit: 130, training was interrupted; it goes on the next time.
    """
    begun = time.monotonic()
    folder = runs / job.run
    name = "baseline" if job.verb == "baseline" else "train"
    config = _config(name, [*job.overrides, *machine], job.store, runs)
    if job.verb == "train":
        train_job(config, folder)
    elif job.verb == "baseline":
        run_baseline_job(config, folder)
    else:
        write_provenance(folder, config)
        dataset = load_dataset(config)
        dataset.keep_regressor(folder)
        dataset.keep_provenance(folder)
    judged = config
    if job.evaluate:
        judged = _config(name, [*job.overrides, *job.evaluate, *machine], job.evaluate_store, runs)
    settings = compose_config("evaluate", ["checkpoint=none", *job.settings])
    result = (_forecasts if job.task == "forecasting" else _estimates)(job, folder, config, judged, settings)
    path = job.raw(results)
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {
        "fingerprint": job.fingerprint,
        **{key: getattr(job, key) for key in ("table", "method", "protocol", "fold", "seed", "task", "settings")},
        "overrides": [*job.overrides, *job.evaluate],
        "training": _training(folder),
        "versions": json.loads((folder / "versions.json").read_text()),
        "seconds_of_last_start": round(time.monotonic() - begun, 1),
    }
    part = path.with_suffix(".part")
    write_json(part, {**about, **result})
    os.replace(part, path)


def _config(name: str, overrides: Sequence[str], store: str, runs: Path) -> dict[str, Any]:
    own = [f"data.store={runs / 'stores' / store}"] if store else []
    return absolute_paths(compose_config(name, [*overrides, *own]))


def _training(folder: Path) -> Result | None:
    path = folder / "finished.json"
    return json.loads(path.read_text()) if path.is_file() else None


def _material(folder: Path, config: dict[str, Any], judged: dict[str, Any]) -> Dataset:
    return run_dataset(judged, folder, same_store=judged is config)


def _labels(config: dict[str, Any], fragments: Sequence[Any]) -> list[str]:
    return fragment_names([take.name for take in TakeStore.open(store_folder(config)).takes], fragments)


def _estimates(
    job: Job, folder: Path, config: dict[str, Any], judged: dict[str, Any], settings: dict[str, Any]
) -> Result:
    """Figures of every held-out fragment, see :func:`egopose.evaluation.protocols.raw_figures`."""
    contact = from_mapping(ContactSettings, settings["contact"], "conf/evaluate.yaml: contact")
    if job.verb == "train":
        other = {} if judged is config else {key: judged[key] for key in ("data", "vision")}
        # Not the best: which that is, is decided on test fragments while training.
        agent = load_agent(folder, which="latest", overrides=other)
        fragments = list(agent.dataset.test)
        labels = _labels(judged, fragments)
        failsafe = from_mapping(FailSafeSettings, settings["failsafe"], "conf/evaluate.yaml: failsafe")
        planner = read_planner(settings.get("planner"))
        threads = int(settings["threads"])
        lookahead = int(settings["lookahead"]) if settings["causal"] else None
        result = evaluate_agent(agent, fragments, labels, "test", failsafe, contact, threads, None, planner, lookahead)
        diverged = sum(one.estimate.diverged for one in result)
        survival = {"survival": _survival(agent, settings)} if job.survival else {}
        fallen = [int(one.estimate.fallen.sum()) for one in result]
        return raw_figures([one.scores for one in result]) | {"diverged": int(diverged), "fallen": fallen} | survival
    dataset = _material(folder, config, judged)
    fragments = list(dataset.test)
    labels = _labels(judged, fragments)
    if job.verb == "regressor":
        motions = [regressed_motion(dataset, f, label) for f, label in zip(fragments, labels, strict=True)]
    else:
        model = load_baseline(folder).model
        assert isinstance(model, PathPose), f"{job.method} estimates nothing"
        flow = TakeStore.open(store_folder(judged)).flow(flow_name(judged))
        motions = [path_pose_motion(model, flow, dataset, f, label) for f, label in zip(fragments, labels, strict=True)]
    return raw_figures(score_motions(motions, fragments, dataset, contact))


def _survival(agent: Agent, settings: dict[str, Any]) -> dict[str, list[int]]:
    """Frames to a fall of each episode on the training takes, from the same uniform starts whoever acts.

    ``policy``: its mean action. The others need no training, see :mod:`egopose.training.survival`.
    """
    env = agent.make_env("train", num_envs=int(settings["survival"]["num_envs"]), threads=int(settings["threads"]))
    acting = {"policy": agent.actor, "base_tracking": base_tracking(env), "reference_tracking": reference_tracking(env)}
    seed = int(settings["survival"]["seed"])
    out = {name: frames_survived(env, controller, seed).frames.tolist() for name, controller in acting.items()}
    env.close()
    return out


def _forecasts(
    job: Job, folder: Path, config: dict[str, Any], judged: dict[str, Any], settings: dict[str, Any]
) -> Result:
    """Figures of every held-out take by horizon: ``figures[metric][take][horizon]``, ``horizons`` in seconds."""
    own = {key: value for key, value in settings["forecast"].items() if key != "baselines"}
    forecast = from_mapping(ForecastSettings, own, "conf/evaluate.yaml: forecast")
    if job.verb == "train":
        agent = load_agent(folder, which="latest")
        dataset = agent.dataset
        windows = windows_of(agent, "test", forecast)
        # As the baselines: what the run's own state regressor sees in the contexts alone.
        pasts = past_states(agent, windows, "regressor")
        states = begin_forecasts(agent, windows, pasts)
        planner = read_planner(settings.get("planner"))
        futures = forecast_windows_of(agent, windows, states, 1, forecast, int(settings["threads"]), planner).qpos
    else:
        dataset = _material(folder, config, judged)
        baseline = load_baseline(folder)
        assert isinstance(baseline.model, RecurrentForecaster), f"{job.method} forecasts nothing"
        made = baseline.settings
        windows = forecast_windows(dataset.test, made.context, forecast.horizon or made.horizon, forecast.every)
        futures = forecast_qpos(baseline.model, _contexts(dataset, judged, windows), dataset, windows)[:, None]
    truth = _truth(dataset, windows)
    hands = [int(d) for d in dataset.humanoid.hand_dofs]
    scores = score_forecasts(truth, windows, futures, hands, 1.0 / dataset.humanoid.control_dt)
    takes = TakeStore.open(store_folder(judged)).takes
    return {
        "takes": [takes[number].name for number in sorted({w.take for w in windows})],
        "windows": len(windows),
        "horizons": scores.horizons.tolist(),
        "figures": {metric: scores.per_take(metric).tolist() for metric in scores.mean},
    }


def _contexts(dataset: Dataset, config: dict[str, Any], windows: Sequence[ForecastWindow]) -> torch.Tensor:
    """``[W, context, S]``: what the state regressor sees in the frames of each context alone."""
    assert dataset.regressor is not None
    model, source_config = load_regressor(dataset.regressor)
    store = TakeStore.open(store_folder(config))
    seen = seen_in_store(config, source_config["regressor"], store, flow_name(config))
    first = [int(dataset.takes.offsets[w.take]) + w.start for w in windows]
    return context_states(model, seen, first, windows[0].context)


def _truth(dataset: Dataset, windows: Sequence[ForecastWindow]) -> Array:
    reference = torch.as_tensor(dataset.reference["qpos"]).double().numpy()
    return true_futures(reference, dataset.takes.offsets.tolist(), windows)
