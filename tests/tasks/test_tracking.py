"""The task of tracking: which fragments train, what is refused, and policies that begin from another run's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.toy_problem import make_run
from helpers.tracking_run import ALSO, TEST, TRAIN, StandInSources, configuration, tracking_dataset, weights_of

from egopose.collection.collectors import transform_state
from egopose.core.errors import InputError
from egopose.pipeline import training
from egopose.pipeline.dataset import absolute_paths
from egopose.pipeline.environment import build_env
from egopose.pipeline.run import build_run, start_from
from egopose.tasks.tracking import TASK
from egopose.training.loop import Run, iterate, train

# --- data ------------------------------------------------------------------------------------------------------------


def test_every_clip_trains_with_each_error_and_mirrored() -> None:
    """Three copies of two clips on either side; test fragments of the three copies on one."""
    dataset = tracking_dataset()
    assert [(p.take, p.start, p.stop) for p in dataset.train] == [
        (2 * copy + f.take, f.start, f.stop) for copy in range(6) for f in TRAIN
    ]
    assert [(p.take, p.start, p.stop) for p in dataset.test] == [
        (2 * copy + f.take, f.start, f.stop) for copy in range(3) for f in TEST
    ]
    assert dataset.reference.shape == (6 * 65,)
    for table in (dataset.states, dataset.path, dataset.joint_targets):
        assert table is not None
        assert len(table) == 6 * 65
    true = dataset.reference["qpos"][:65, 7:].float()
    torch.testing.assert_close(dataset.joint_targets[:65], true)


def test_without_mirroring_there_are_half_as_many() -> None:
    config = configuration()
    config["task"]["mirror"] = False
    assert len(tracking_dataset(config).train) == 3 * len(TRAIN)


def test_other_sets_train_and_are_not_tested() -> None:
    sources = StandInSources()
    dataset = tracking_dataset(configuration("elsewhere"), sources)
    assert sources.asked == [("cmu6", "elsewhere", ("1", "6", "7"))]
    assert [(p.take, p.start, p.stop) for p in dataset.test] == [
        (3 * copy + f.take, f.start, f.stop) for copy in range(3) for f in TEST
    ]
    other = [p for p in dataset.train if p.take % 3 == 2]
    assert [(p.start, p.stop) for p in other] == [(ALSO[0].start, ALSO[0].stop)] * 6
    offset = int(dataset.takes.offsets[other[0].take])
    assert dataset.reference["qpos"][offset, 0] > 99.0


@pytest.mark.parametrize("order", [[1], [1, 0], [0, 0]])
def test_the_truth_must_come_first_and_once(order: list[int]) -> None:
    config = configuration()
    config["task"]["errors"] = [config["task"]["errors"][number] for number in order]
    with pytest.raises(InputError, match="first and once") as caught:
        TASK.check(config)
    assert caught.value.field == "task.errors"


def test_an_errors_missing_setting_is_named() -> None:
    config = configuration()
    config["task"]["errors"] = [None, {"joints": 0.1}]
    with pytest.raises(InputError, match="missing") as caught:
        tracking_dataset(config)
    assert caught.value.source == "task.errors[1]"


def test_a_policy_that_does_not_see_the_motion_is_refused() -> None:
    config = configuration()
    config["model"]["inputs"] = []
    with pytest.raises(InputError, match="model=tracking"):
        TASK.check(config)


@pytest.mark.parametrize("ahead", [[], [0, 1], None])
def test_a_window_needs_frames_ahead(ahead: Any) -> None:
    config = configuration()
    dataset = tracking_dataset(config)
    config["task"] = {key: value for key, value in config["task"].items() if key != "ahead"}
    if ahead is not None:
        config["task"]["ahead"] = ahead
    with pytest.raises(InputError) as caught:
        build_env(config, dataset, num_envs=1)
    assert caught.value.field == "task.ahead"


def test_endings_can_be_switched_off_for_a_judgement() -> None:
    config = configuration()
    dataset = tracking_dataset(config)
    assert TASK.problem(config, dataset, None).ends_episode == {"fallen", "strayed"}
    assert TASK.problem(config, dataset, False).ends_episode == frozenset()


def test_folders_are_named_from_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a run can be resumed from anywhere."""
    monkeypatch.chdir(tmp_path)
    config = {**configuration("other"), "data": {"folder": None}}
    config["training"]["start_from"] = "runs/taught"
    found = absolute_paths(config)
    assert found["task"]["also"]["cmu6"]["folder"] == str(tmp_path / "other")
    assert found["training"]["start_from"] == str(tmp_path / "runs" / "taught")
    config["training"]["start_from"] = "pretrained:residual"
    config["task"]["also"]["cmu6"]["folder"] = None
    found = absolute_paths(config)
    assert found["task"]["also"]["cmu6"]["folder"] is None
    assert found["training"]["start_from"] == "pretrained:residual"


# --- learning --------------------------------------------------------------------------------------------------------


def made(folder: Path, **changed: Any) -> Run:
    config = configuration(**changed)
    return build_run(config, folder, tracking_dataset(config))


def test_a_policy_trains_and_resumes_to_the_bit(tmp_path: Path) -> None:
    whole = made(tmp_path / "whole")
    train(whole, [])
    half = made(tmp_path / "half", iterations=2)
    outcome = train(half, [])
    resumed = made(tmp_path / "half")
    resumed.restore(outcome.checkpoint)
    train(resumed, [])
    assert resumed.counters.iteration == whole.counters.iteration == 4
    for key, value in weights_of(whole).items():
        assert torch.equal(value, weights_of(resumed)[key]), key


def test_while_the_critic_learns_first_the_policy_stays(tmp_path: Path) -> None:
    """Its weights and its step size; then both learn."""
    run = make_run(tmp_path, critic_first=2)
    batches, kept = iter(run.collector), weights_of(run)
    critic = {key: value.clone() for key, value in run.ppo.critic.state_dict().items()}
    for _ in range(2):
        figures = iterate(run, batches)
        assert figures["kl"] == pytest.approx(0.0, abs=1e-7)
        assert figures["policy_lr"] == 3e-3
        for key, value in weights_of(run).items():
            assert torch.equal(value, kept[key]), key
    changed = [not torch.equal(value, critic[key]) for key, value in run.ppo.critic.state_dict().items()]
    assert any(changed)
    figures = iterate(run, batches)
    assert figures["kl"] > 1e-6
    assert any(not torch.equal(value, kept[key]) for key, value in weights_of(run).items())


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = made(tmp_path_factory.mktemp("taught"), iterations=2)
    train(run, [])
    return run


def test_a_run_begins_from_anothers_policy_and_normaliser(taught: Run, tmp_path: Path) -> None:
    """And critic; but optimisers and counters are new."""
    run = made(tmp_path / "run")
    start_from(run, str(taught.folder))
    for key, value in weights_of(taught).items():
        assert torch.equal(value, weights_of(run)[key]), key
    before, after = transform_state(taught.collector), transform_state(run.collector)
    assert before.keys() == after.keys()
    for key in before:
        assert torch.equal(before[key], after[key]), key
    assert any(float(value.double().abs().max()) > 0 for value in after.values())
    for key, value in taught.ppo.critic.state_dict().items():
        assert torch.equal(value, run.ppo.critic.state_dict()[key]), key
    assert run.counters.iteration == 0
    assert run.ppo.policy_optimizer.state_dict()["state"] == {}
    iterate(run, iter(run.collector))


def test_policies_of_another_shape_are_refused(taught: Run, tmp_path: Path) -> None:
    config = configuration()
    config["model"]["hidden"] = [9]
    run = build_run(config, tmp_path, tracking_dataset(config))
    with pytest.raises(InputError, match=r"has shape .* where .* is expected") as caught:
        start_from(run, str(taught.folder))
    assert "policy" in caught.value.field


def test_a_run_that_is_not_there_is_refused(taught: Run, tmp_path: Path) -> None:
    run = made(tmp_path / "run")
    with pytest.raises(InputError, match="does not exist"):
        start_from(run, str(tmp_path / "nowhere"))
    toy = make_run(tmp_path / "toy", iterations=1)
    train(toy, [])
    with pytest.raises(InputError) as caught:
        start_from(run, str(toy.folder))
    assert caught.value.field == "action_size"


def test_only_a_new_run_looks_for_the_other(taught: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that goes on has a policy of its own, and the other run may be gone by then."""
    asked: list[str] = []
    monkeypatch.setattr(training, "start_from", lambda run, path: asked.append(path))
    monkeypatch.setattr(training, "build_evaluation", lambda run, dataset: None)
    monkeypatch.setattr(training, "with_forecasts", lambda config, dataset, folder: dataset)
    config = configuration(iterations=1)
    config |= {"logger": {"kind": "csv"}, "data": {}}
    config["training"]["start_from"] = "elsewhere"
    dataset = tracking_dataset(config)
    training.run_training(config, tmp_path, None, dataset)
    assert asked == ["elsewhere"]
    (checkpoint,) = (tmp_path / "checkpoints").glob("*[0-9]")
    config["algo"]["iterations"] = 2
    training.run_training(config, tmp_path, checkpoint, dataset)
    assert asked == ["elsewhere"]
