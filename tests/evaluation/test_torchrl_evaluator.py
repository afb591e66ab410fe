"""TorchRL's evaluator on checkpoints: the same survival figures, whoever runs the episodes."""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.estimation_run import configuration, estimation_dataset
from helpers.forecasting_run import configuration as forecasting_configuration
from helpers.forecasting_run import forecasting_dataset
from torchrl.render import RenderConfig, render_policy

from egopose.checkpoint.checkpoint import find_checkpoint
from egopose.core.errors import InputError
from egopose.evaluation import torchrl_evaluator
from egopose.evaluation.torchrl_evaluator import _checkpoint_env, _checkpoint_policy, _Trained, checkpoint_evaluator
from egopose.evaluation.torchrl_render import make_env, make_policy
from egopose.pipeline.agent import load_agent
from egopose.pipeline.run import build_run
from egopose.tasks.dataset import Dataset
from egopose.training.loop import train
from egopose.training.survival import frames_survived

WORLDS, SEED = 5, 7


def falling(config: dict[str, Any]) -> dict[str, Any]:
    """The body counts as fallen soon, so that episodes end at different times."""
    task = {**config["task"], "termination": {"enabled": True, "head_drop": 0.02}}
    return {**config, "task": task, "training": {**config["training"], "evaluation_num_envs": 12}}


@pytest.fixture(scope="module")
def estimating(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dataset]:
    folder, dataset = tmp_path_factory.mktemp("estimating"), estimation_dataset()
    train(build_run(falling(configuration()), folder, dataset), [])
    return folder, dataset


@pytest.fixture(scope="module")
def forecasting(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Dataset]:
    folder, dataset = tmp_path_factory.mktemp("forecasting"), forecasting_dataset()
    train(build_run(falling(forecasting_configuration()), folder, dataset), [])
    return folder, dataset


def survived(folder: Path, dataset: Dataset) -> tuple[float, float]:
    agent = load_agent(folder, dataset, which="latest")
    found = frames_survived(agent.make_env("test", num_envs=WORLDS), agent.actor, SEED)
    return found.mean, float(found.fell.double().mean())


def test_one_evaluator_loads_its_checkpoint_once(
    estimating: tuple[Path, Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = []
    monkeypatch.setattr(torchrl_evaluator, "load_agent", lambda *args: loaded.append(args) or load_agent(*args))
    folder, dataset = estimating
    evaluator = checkpoint_evaluator(folder, which="latest", num_envs=WORLDS, seed=SEED, dataset=dataset)
    try:
        evaluator.evaluate()
    finally:
        evaluator.shutdown()
    assert len(loaded) == 1


def test_what_makes_environment_and_policy_shares_an_agent_where_it_is_sent(estimating: tuple[Path, Dataset]) -> None:
    here = _Trained.of(*estimating, token="first")
    first, second = (pickle.dumps(partial(make, here)) for make in (_checkpoint_env, _checkpoint_policy))
    del here  # as in another process
    made = [pickle.loads(each) for each in (first, second)]
    assert made[0].args[0] is made[1].args[0]


def same_figures(folder: Path, dataset: Dataset, backend: str) -> None:
    evaluator = checkpoint_evaluator(folder, backend, which="latest", num_envs=WORLDS, seed=SEED, dataset=dataset)
    try:
        results = [evaluator.evaluate(), evaluator.evaluate()]
        assert evaluator.trigger_eval(step=30)
        results.append(evaluator.wait(60.0) or {})
    finally:
        evaluator.shutdown()
    assert results[2]["eval/step"] == 30
    for result in results:
        assert (result["eval/frames"], result["eval/fell"]) == pytest.approx(survived(folder, dataset))


def test_a_thread_finds_what_survival_is(estimating: tuple[Path, Dataset]) -> None:
    frames, fell = survived(*estimating)
    assert 0 < fell < 1
    assert 0 < frames < 11
    same_figures(*estimating, "thread")


def test_a_forecasting_policy_keeps_its_memory(forecasting: tuple[Path, Dataset]) -> None:
    same_figures(*forecasting, "thread")


@pytest.mark.parametrize("task", ["estimating", pytest.param("forecasting", marks=pytest.mark.slow)])
def test_a_process_of_its_own_finds_the_same(task: str, request: pytest.FixtureRequest) -> None:
    same_figures(*request.getfixturevalue(task), "process")


def test_other_backends_are_named(estimating: tuple[Path, Dataset]) -> None:
    with pytest.raises(InputError, match="backend: must be one of thread, process"):
        checkpoint_evaluator(estimating[0], "fork", dataset=estimating[1])


def test_torchrl_renders_a_checkpoint(estimating: tuple[Path, Dataset], tmp_path: Path) -> None:
    folder, dataset = estimating
    config = RenderConfig(
        ckpt=find_checkpoint(folder),
        env=lambda config: make_env(config, 64, dataset),
        policy=lambda ckpt_path: make_policy(ckpt_path, dataset),
        format="npz",
        max_steps=4,
        out=tmp_path / "rollout.npz",
    )
    try:
        result = render_policy(config)
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert result.warnings == []
    assert (tmp_path / "rollout.npz").is_file()
    (frames,) = result.frames
    pictures = [next(iter(bundle.frames.values())) for bundle in frames]
    assert {picture.shape for picture in pictures} == {(64, 64, 3)}
    assert all((picture != pictures[0]).any() for picture in pictures[1:])
