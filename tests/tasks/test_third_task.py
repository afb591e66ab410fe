"""A task of one's own takes one file and one YAML: it is trained by the same command as the package's."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.mocap import short_clips
from tasks.reach_task import TASK, ReachProblem

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.pipeline.dataset import load_dataset
from egopose.pipeline.environment import build_env
from egopose.tasks.task import VARIABLE, task_of

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def overrides(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    split = ["data.split.train_share=0.5", "data.split.shortest=12"]
    return [*short_clips(tmp_path_factory.mktemp("reach")), *split, "collector.num_envs=4", "seed=1"]


def environment() -> dict[str, str]:
    paths = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, VARIABLE: "reach_task", "PYTHONPATH": paths}


def train(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "egopose.train", f"--config-dir={HERE / 'conf'}", "task=reach", *words]
    command += ["algo.steps_per_iteration=128", "training.evaluate_every=2", "training.evaluation_num_envs=4"]
    return subprocess.run(
        [*command, f"hydra.run.dir={folder}"], env=environment(), capture_output=True, text=True, timeout=600
    )


def test_the_command_trains_it_for_five_iterations(overrides: list[str], tmp_path: Path) -> None:
    ended = train(tmp_path / "run", *overrides, "algo.iterations=5")
    assert ended.returncode == 0, ended.stderr
    with (tmp_path / "run" / "curves.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(float(row["iteration"])) for row in rows] == [1, 2, 3, 4, 5]
    assert all(0.0 < float(row["reward_hand_at_point"]) < 1.0 for row in rows)
    assert not any(name in rows[0] for name in ("reward_pose", "reward_root_pose"))
    assert read_json(find_checkpoint(tmp_path / "run"), "config")["task"]["name"] == "reach"
    again = train(tmp_path / "run", f"resume={tmp_path / 'run'}", "algo.iterations=6")
    assert again.returncode == 0, again.stderr
    assert "resuming" in again.stdout


def test_observation_ending_reward_and_box_are_the_tasks_own(
    overrides: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, "tasks.reach_task")
    config = compose_config("train", [*overrides]) | _reach()
    assert task_of(config) is TASK
    env = build_env(config, load_dataset(config, progress=False), num_envs=3)
    base = env.base_env
    assert isinstance(base.problem, ReachProblem)
    first = env.reset()
    assert first["hand_height"].shape == (3, 1)
    tops = torch.from_numpy(base.physics.box_tops[:, 0].copy())
    assert ((tops[:, 2] >= 0.3) & (tops[:, 2] <= 0.6)).all()
    assert len(tops[:, 2].unique()) == 3, "each world has a box of its own"
    after = env.rand_step(first)["next"]
    hand = base.body_state()["xpos"][:, base.problem.hand]
    point = tops + torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    distance = (hand - point).norm(dim=-1)
    torch.testing.assert_close(
        after["reward"].squeeze(-1), torch.exp(-2.0 * distance.square()).float(), rtol=1e-5, atol=1e-7
    )
    torch.testing.assert_close(after["hand_height"].squeeze(-1), hand[:, 2].float())
    assert not after["hand_away"].any()
    base.problem.far = 0.01
    ended = env.rand_step(first)["next"]
    assert ended["hand_away"].all()
    assert ended["terminated"].all()
    env.close()


def test_an_unknown_task_is_told_which_there_are() -> None:
    config = {"task": {"name": "juggle"}}
    with pytest.raises(InputError, match=r"task\.name: there is no task 'juggle'; there are estimation, forecasting"):
        task_of(config)


def test_a_module_without_a_task_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "helpers.mocap")
    with pytest.raises(InputError, match=f"{VARIABLE}: helpers.mocap: gives no task"):
        task_of({"task": {"name": "juggle"}})


def _reach() -> dict:
    import yaml

    own = yaml.safe_load((HERE / "conf" / "task" / "reach.yaml").read_text())
    base = compose_config("train")
    own["reward"]["terms"] = {key: row for key, row in own["reward"]["terms"].items() if row is not None}
    own["model"] = {**base["model"], **own["model"], "context": {**base["model"]["context"], "source": "none"}}
    return own
