"""Networks of a checkpoint without its data: the very numbers of the agent's, and no store is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.estimation_run import configuration, estimation_dataset
from tensordict import TensorDict

from egopose.checkpoint import pretrained as weights
from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.envs.transforms import StateNormalizer
from egopose.evaluation.torchrl_render import make_policy
from egopose.inference.stream.build import still_frames
from egopose.pipeline import dataset as datasets
from egopose.pipeline.agent import load_agent, load_policy
from egopose.pipeline.forecaster import still_forecasts
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.run import build_run
from egopose.training.loop import train


@pytest.mark.parametrize("name", weights.pretrained_names())
def test_shipped_policies_load_without_data(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datasets, "prepare", lambda *_: pytest.fail("data is prepared"))
    path = f"{weights.PREFIX}{name}"
    alone = load_policy(path)
    config = read_json(find_checkpoint(path), "config")
    regressor, source_config = load_regressor(weights.FOLDER / name / "regressor")
    frames = 2 if config.get("forecaster") is None else config["task"]["context"] + config["task"]["minimum"]
    dataset = still_frames(humanoid_of(config), regressor, source_config, frames)
    if config.get("forecaster") is not None:
        dataset = still_forecasts(config, dataset)
    agent = load_agent(path, dataset)
    env = agent.make_env(num_envs=1, whole_fragments=True)
    generator = torch.Generator().manual_seed(0)
    seen = TensorDict(
        {
            key: torch.randn(3, spec.shape[-1], generator=generator)
            for key, spec in env.observation_spec.items()
            if spec.dtype == torch.float32
        },
        [3],
    )
    mean = agent.actor.get_dist(seen.clone()).mean
    assert torch.equal(alone.actor.get_dist(seen.clone()).mean, mean)
    assert torch.equal(make_policy(path).get_dist(seen.clone()).mean, mean)
    assert torch.equal(alone.critic(seen.clone())["state_value"], agent.critic(seen.clone())["state_value"])
    (normalizer,) = (part for part in env.transform.modules() if isinstance(part, StateNormalizer))
    raw = torch.from_numpy(np.random.default_rng(1).normal(size=(3, len(normalizer.mean))))
    assert torch.equal(alone.normalizer.normalize(raw), normalizer.normalize(raw))
    assert alone.normalizer.frozen


def test_networks_that_read_a_table_are_told_apart(tmp_path: Path) -> None:
    train(build_run(configuration("trainable", iterations=2), tmp_path, estimation_dataset()), [])
    with pytest.raises(InputError, match="trainable reads the features of its data") as caught:
        load_policy(tmp_path, which="latest")
    assert caught.value.field == "model.context.source"
