"""Training on the real environment with a stand-in body: resumes to the bit, loads into TorchRL's own tools."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.estimation_run import assert_equal, configuration, estimation_dataset
from torchrl.collectors import Evaluator
from torchrl.render import load_checkpoint

from egopose.checkpoint.checkpoint import compare_states
from egopose.core.errors import InputError
from egopose.envs.transforms import StateNormalizer, TrackingError, VisualContext
from egopose.models.feedback import BalanceFeedback
from egopose.pipeline.agent import load_agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.run import build_evaluation, build_run
from egopose.tasks.dataset import Dataset
from egopose.training.loop import train


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return estimation_dataset()


@pytest.mark.parametrize("context", ["frozen", "trainable"])
def test_resumed_equals_uninterrupted_to_the_bit(context: str, dataset: Dataset, tmp_path: Path) -> None:
    whole = build_run(configuration(context, evaluate_every=1), tmp_path / "whole", dataset)
    train(whole, [], build_evaluation(whole, dataset))
    half = build_run(configuration(context, evaluate_every=1, iterations=2), tmp_path / "half", dataset)
    outcome = train(half, [], build_evaluation(half, dataset))
    torch.manual_seed(123)
    again = build_run({**configuration(context, evaluate_every=1), "seed": 9}, tmp_path / "half", dataset)
    again.restore(outcome.checkpoint)
    train(again, [], build_evaluation(again, dataset))
    for name, part in whole.checkpoint().components.items():
        if name in ("policy", "critic", "transforms", "simulation"):
            assert_equal(part.state_dict(), again.checkpoint().components[name].state_dict(), name)


@pytest.fixture(scope="module")
def trained(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    run = build_run(configuration(), folder, dataset)
    train(run, [])
    return folder


def test_an_agent_is_what_was_trained(trained: Path, dataset: Dataset) -> None:
    agent = load_agent(trained, dataset, which="latest")
    env = agent.make_env(num_envs=3)
    (normalizer,) = (m for m in env.transform.modules() if isinstance(m, StateNormalizer))
    assert normalizer.frozen
    assert normalizer.count > 100
    before = normalizer.mean.clone()
    env.rollout(5, agent.actor, break_when_any_done=False)
    assert torch.equal(before, normalizer.mean)
    weights = load_checkpoint(agent.path)["model_state_dict"]
    compare_states(agent.actor.state_dict(), weights, "policy")


def test_an_agent_for_other_features_is_refused(trained: Path, dataset: Dataset) -> None:
    wider = Dataset(**{**vars(dataset), "visual_context": torch.zeros(dataset.reference.shape[0], 7)})
    with pytest.raises(InputError, match=r"critic\..*has shape \[300, 158\] where \[300, 160\]"):
        load_agent(trained, wider, which="latest")


def test_torchrl_evaluator_runs_it(trained: Path, dataset: Dataset) -> None:
    agent = load_agent(trained, dataset, which="latest")
    layout = {"auto_register_policy_transforms": False, "traj_format": "padded"}  # TorchRL's next defaults differ
    evaluator = Evaluator(
        agent.make_env(num_envs=2), agent.actor, num_trajectories=2, max_steps=12, collector_kwargs=layout
    )
    try:
        result = evaluator.evaluate()
    finally:
        evaluator.shutdown()
    assert 0 < float(result["eval/reward"]) <= 12


def test_what_a_policy_sees_is_built_in_order(dataset: Dataset) -> None:
    """The context and the tracking error of the raw state, which the normaliser changes last."""
    env = build_env(configuration(), dataset, num_envs=2)
    kinds = [type(t) for t in env.transform]
    assert set(kinds) == {TrackingError, VisualContext, StateNormalizer}
    assert kinds[-1] is StateNormalizer
    (tracking,) = (t for t in env.transform if isinstance(t, TrackingError))
    assert dataset.states is not None
    assert torch.equal(tracking.table, dataset.states)
    # PIECES: frames 0-39 of the first take (at 0), 5-24 of the second (at 40).
    seen = torch.cat([dataset.states[0:40], dataset.states[45:65]])
    torch.testing.assert_close(tracking.scale, seen.std(dim=0).clamp_min(0.05))
    assert (tracking.scale == 0.05).any()
    assert (tracking.scale > 0.05).any()


def test_starts_on_a_perfect_regressors_states_show_no_error(dataset: Dataset) -> None:
    """Here the regressor's states are the reference's, where episodes start."""
    env = build_env(configuration(), dataset, num_envs=4)
    td = env.reset()
    size = env.observation_spec["humanoid_state"].shape[-1]
    assert td["tracking_error"].shape == (4, 2 * size)
    torch.testing.assert_close(td["tracking_error"][:, :size], torch.zeros(4, size), atol=1e-4, rtol=0.0)
    assert td["tracking_error"][:, size:].abs().max() > 1e-2


def test_training_moves_the_gains(trained: Path, dataset: Dataset) -> None:
    agent = load_agent(trained, dataset, which="latest")
    (feedback,) = (m for m in agent.actor.modules() if isinstance(m, BalanceFeedback))
    assert feedback.gains.shape == (3, 3)
    assert (feedback.gains != 0).all()


def test_a_tracking_error_needs_the_regressors_states(dataset: Dataset) -> None:
    with pytest.raises(InputError, match="trained state regressor") as caught:
        build_env(configuration(), replace(dataset, states=None), num_envs=1)
    assert caught.value.field == "model.inputs"


def test_feedback_for_another_body_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    config = configuration()
    config["model"]["feedback"] = {**config["model"]["feedback"], "roll": [["Tail_0"]]}
    with pytest.raises(InputError, match="Tail_0") as caught:
        build_run(config, tmp_path, dataset)
    assert caught.value.field == "feedback.roll"


@pytest.mark.skipif(sys.platform != "linux", reason="starts processes")
@pytest.mark.slow
def test_two_processes_collect(dataset: Dataset, tmp_path: Path) -> None:
    config = configuration(iterations=2)
    config["collector"] = {**config["collector"], "kind": "multi_sync", "workers": 2}
    run = build_run(config, tmp_path, dataset)
    try:
        outcome = train(run, [])
    finally:
        run.collector.shutdown()
    assert outcome.frames == 96
    load_agent(outcome.checkpoint, dataset)
