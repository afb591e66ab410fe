"""A baseline from its configuration to a motion: trained, gone on with, loaded, placed in the world."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.small_store import configuration, fill_flow

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data import preparation
from egopose.data.preparation import flow_name, prepare, store_folder
from egopose.data.store import TakeStore
from egopose.data.windows import forecast_windows
from egopose.models.baselines.path_pose import PathPose
from egopose.models.baselines.recurrent import RecurrentForecaster
from egopose.pipeline.agent import load_agent
from egopose.pipeline.baselines import (
    forecast_qpos,
    load_baseline,
    path_pose_motion,
    regressed_motion,
    run_baseline_job,
)
from egopose.pipeline.dataset import load_dataset, run_dataset
from egopose.pipeline.run import build_run
from egopose.training.loop import train

SMALL = {
    "erd_fast": {"encoder": [8], "recurrent": 8, "layers": 1, "decoder": [8], "context": 6, "horizon": 9},
    "path_pose": {"clusters": 5, "hidden": [8], "reach": 3, "grid": 2},
}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The configuration of a store with flow and its state regressor."""
    config = configuration(tmp_path_factory.mktemp("baselines"))
    prepare(config, progress=False, flow=False)
    fill_flow(config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "_make_videos", lambda *_: None)
        load_dataset(config, progress=False)
    return config


@pytest.fixture(autouse=True)
def no_videos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "_make_videos", lambda *_: None)


@lru_cache
def chosen(name: str) -> dict[str, Any]:
    return compose_config("baseline", [f"baseline={name}"])


def configured(small: dict[str, Any], name: str, total_steps: int) -> dict[str, Any]:
    groups = {key: small[key] for key in ("data", "humanoid", "sim", "vision", "regressor")}
    values = chosen(name)["baseline"]
    optimiser = {**values["optimiser"], "batch": 4, "check_every": 2, "validation_share": 0.0}
    baseline = {**values, **SMALL[name], "optimiser": optimiser}
    training = {"total_steps": total_steps, "max_seconds": None}
    return {**chosen(name), **groups, "baseline": baseline, "training": training}


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_baseline(run).model.state_dict()


def test_a_forecaster_is_trained_goes_on_and_forecasts_from_where_it_stands(
    small: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("runs")
    whole, parted = folder / "whole", folder / "parted"
    run_baseline_job(configured(small, "erd_fast", 600), whole)
    short = configured(small, "erd_fast", 240)
    run_baseline_job(short, parted)
    marked = json.loads((parted / "finished.json").read_text())
    run_baseline_job(short, parted)
    assert json.loads((parted / "finished.json").read_text()) == marked
    run_baseline_job(configured(small, "erd_fast", 600), parted)
    assert json.loads((parted / "finished.json").read_text())["iteration"] > marked["iteration"]
    assert sorted(weights(parted)) == sorted(weights(whole))
    with pytest.raises(InputError, match="seed"):
        run_baseline_job({**short, "seed": 8}, parted)

    dataset = load_dataset(small, progress=False)
    # A baseline's run is judged on its own dataset, although its configuration names no task.
    own = run_dataset(configured(small, "erd_fast", 600), whole, progress=False)
    assert own.test == dataset.test
    assert torch.equal(own.states, dataset.states)
    model = load_baseline(whole).model
    assert isinstance(model, RecurrentForecaster)
    windows = forecast_windows(dataset.test, 6, 9, 5)
    assert dataset.states is not None
    offsets = dataset.takes.offsets.tolist()
    contexts = torch.stack([dataset.states[offsets[w.take] + w.start :][:6] for w in windows])
    futures = forecast_qpos(model, contexts, dataset, windows)
    assert futures.shape == (len(windows), 9, 59)
    assert np.linalg.norm(futures[:, :, 3:7], axis=-1) == pytest.approx(np.ones((len(windows), 9)))
    # PoseReg on the context goes to where the forecast goes on: a frame's way at no more than 10 m/s.
    fragment = type(windows[0])(windows[0].take, windows[0].start, 6, 0)
    last = regressed_motion(dataset, fragment).qpos[-1]
    assert np.linalg.norm(futures[0, 0, :2] - last[:2]) < 0.34


def test_path_pose_gives_a_motion_on_the_humanoids_skeleton(
    small: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("runs")
    config = configured(small, "path_pose", 64)
    run_baseline_job(config, folder / "paths")
    model = load_baseline(folder / "paths").model
    assert isinstance(model, PathPose)
    dataset = load_dataset(small, progress=False)
    flow = TakeStore.open(store_folder(config)).flow(flow_name(config))
    fragment = dataset.test[0]
    motion = path_pose_motion(model, flow, dataset, fragment, "test")
    first = int(dataset.takes.offsets[fragment.take]) + fragment.start
    assert len(motion) == fragment.stop - fragment.start
    assert motion.qpos[0, :2] == pytest.approx(dataset.reference["qpos"][first, :2].numpy())


def test_what_is_no_trained_baseline_is_refused_by_name(
    small: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("runs")
    with pytest.raises(InputError, match="model"):
        load_baseline(folder / "nowhere")
    config = configured(small, "erd_fast", 64)
    config["baseline"]["kind"] = "oracle"
    with pytest.raises(InputError, match="kind"):
        run_baseline_job(config, folder / "oracle")


def test_vgail_trains_saves_and_goes_on(small: dict[str, Any], tmp_path: Path) -> None:
    choice = compose_config("train", ["experiment=vgail"])
    discriminator = {**choice["algo"]["discriminator"], "hidden": [8], "batch": 8, "steps": 2}
    config = {**small, "task": choice["task"], "algo": {**small["algo"], "discriminator": discriminator}}
    dataset = load_dataset(config, progress=False)
    run = build_run(config, tmp_path / "run", dataset)
    before = {k: v.clone() for k, v in run.ppo.state()["discriminator"].state_dict().items()}
    train(run, [])
    after = run.ppo.state()["discriminator"].state_dict()
    assert any(not torch.equal(before[k], after[k]) for k in before)

    config["algo"]["iterations"] = 2
    again = build_run(config, tmp_path / "run", dataset)
    again.restore(tmp_path / "run" / "checkpoints" / "checkpoint-000000000008")
    assert all(torch.equal(v, after[k]) for k, v in again.ppo.state()["discriminator"].state_dict().items())
    assert train(again, []).frames == 16
    agent = load_agent(tmp_path / "run", dataset, "latest")
    assert agent.make_env("test").base_env.problem.action.kind == "torque"

    config["model"] = {**config["model"], "context": {**config["model"]["context"], "source": "trainable"}}
    with pytest.raises(InputError, match="frozen"):
        build_run(config, tmp_path / "other", dataset)
