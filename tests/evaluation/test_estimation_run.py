"""An evaluation from agents to files, on the real humanoid with a made-up motion and untrained networks."""

from __future__ import annotations

import csv
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.env_stand_in import Piece, group

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import TakeTable
from egopose.evaluation.estimation_run import run_evaluation, summary
from egopose.evaluation.options import output_folder, physics_group
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.inference.outputs import TakeVideo, file_name
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.pipeline.agent import Agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.vision.video import probe_video, write_video

FRAMES = 24
EVALUATE = {
    "split": "test",
    "causal": False,
    "lookahead": 10,
    "failsafe": {"mode": "value", "reset_threshold": 0.6, "fallen_height": 0.3},
    "failsafe_report": {"window": 5},
    "contact": {"height": 0.03, "speed": 0.5},
    "interval": {"level": 0.95, "draws": 50, "seed": 0},
    "survival": {"num_envs": 3, "seed": 1},
    "video": {"takes": 1, "size": 64},
    "threads": 1,
}


@pytest.fixture(scope="module")
def agent() -> Agent:
    humanoid = build_humanoid(HumanoidConfig.from_mapping(group("humanoid", "default")), SimConfig(substeps=3))
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (FRAMES, 1))
    qpos[:, 2] = 0.95
    qpos[:, 7:] = humanoid.rest_action + 0.05 * np.sin(np.linspace(0, 6, FRAMES))[:, None]
    states = reference_states(humanoid, Motion(humanoid.skeleton, qpos, 30.0))
    reference = torch.cat([states, states])
    heads = states["xpos"][:, humanoid.head, 2].min().expand(2).clone()
    takes = TakeTable(torch.tensor([0, FRAMES]), torch.tensor([FRAMES, FRAMES]), heads)
    regressed = humanoid_state(reference).float()
    dataset = Dataset(
        humanoid,
        reference,
        takes,
        train=[Piece(0, 0, FRAMES)],
        test=[Piece(0, 4, FRAMES), Piece(1, 0, 12)],
        visual_context=torch.zeros(2 * FRAMES, 5),
        joint_targets=reference["qpos"][:, 7:].float(),
        states=regressed + 0.01 * torch.randn(regressed.shape, generator=torch.Generator().manual_seed(0)),
    )
    config = {
        "seed": 5,
        "task": {**group("task", "residual"), "horizon": 12, "minimum": 6},
        "reward": group("reward", "estimation"),
        "regressor": {"std_floor": 0.05},
        "model": {**group("model", "fast"), "hidden": [8]},
    }
    actor, critic = build_networks(config, dataset, build_env(config, dataset, num_envs=1))
    make_env = partial(build_env, config, dataset)
    return Agent(actor, critic, config, dataset, make_env, Path("run/checkpoints/1"))


def test_everything_is_written_and_agrees(agent: Agent, tmp_path: Path) -> None:
    write_video(tmp_path / "wearer.mp4", [np.full((48, 64, 3), 90, np.uint8)] * FRAMES, 30.0)
    video = TakeVideo(tmp_path / "wearer.mp4", 0.0, rendered=True)
    try:
        results = run_evaluation(EVALUATE, [agent, agent], ["walk/1", "bow"], [video, None], tmp_path / "out")
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert [p.name for p in sorted((tmp_path / "out/takes").iterdir())] == ["bow_0-12", "walk_1_4-24"]
    saved = json.loads((tmp_path / "out/results.json").read_text())
    assert saved["rendered_video"]
    assert saved["takes"] == ["walk/1_4-24", "bow_0-12"]
    figure = saved["figures"]["ours"]["E_pose"]
    assert (figure["runs"], figure["takes"]) == (2, 2)
    assert saved["reference"]["E_pose"] == 0
    assert saved["reference"]["A_accl"] > 0
    assert set(saved["survival"][0]) == {"policy", "start_policy", "base_tracking", "reference_tracking"}
    # The untrained policy is its own start: the same networks from the same seed, the same starts.
    assert saved["survival"][0]["policy"]["frames"] > 0

    guarded = saved["failsafe"][0]
    assert (guarded["mode"], guarded["reset_threshold"], guarded["window_frames"]) == ("value", 0.6, 5)
    assert [len(take["confidence"]) for take in guarded["takes"]] == [FRAMES - 4, 12]

    take = tmp_path / "out/takes/walk_1_4-24"
    with (take / "frames.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == FRAMES - 4
    mean = np.mean([float(r["E_pose"]) for r in rows])
    assert mean == pytest.approx(saved["per_take"]["ours"]["E_pose"][0][0], rel=1e-5)
    clip = read_motion(take / "estimate.npz")
    positions = read_motion(take / "estimate.bvh").forward_kinematics()[0]
    np.testing.assert_allclose(positions, clip.forward_kinematics()[0], atol=1e-3)
    assert clip.confidence is not None
    np.testing.assert_allclose(clip.confidence, [float(r["confidence"]) for r in rows], rtol=1e-6)
    assert probe_video(take / "side_by_side.mp4").width == 3 * 64
    assert results.videos == [take / "side_by_side.mp4"]
    text = summary(results)
    assert "E_pose" in text
    assert str(results.folder) in text


def test_bad_settings_are_named(agent: Agent, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="split"):
        run_evaluation({**EVALUATE, "split": "all"}, [agent], ["a", "b"], [None, None], tmp_path)
    odd = {**EVALUATE, "failsafe": {**EVALUATE["failsafe"], "mode": "sometimes"}}
    with pytest.raises(InputError, match="mode"):
        run_evaluation(odd, [agent], ["a", "b"], [None, None], tmp_path)


def test_the_physics_to_score_on_is_a_group_by_name() -> None:
    assert physics_group(None) is None
    assert [physics_group(name)["sim"]["substeps"] for name in ("paper", "fast")] == [15, 4]
    with pytest.raises(InputError, match="sim"):
        physics_group("quantum")


def test_results_never_go_into_a_sealed_checkpoint() -> None:
    checkpoint = Path("runs/a/checkpoints/100")
    assert output_folder(None, checkpoint, "test") == Path("runs/a/evaluation/test")
    with pytest.raises(InputError, match="inside the checkpoint"):
        output_folder("runs/a/checkpoints/100/x", checkpoint, "test")


def test_names_become_plain_folders() -> None:
    assert file_name("../a b/c.bvh") == "a_b_c.bvh"
    assert file_name("..") == "take"
