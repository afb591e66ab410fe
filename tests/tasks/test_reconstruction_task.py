"""The task of a reconstruction: its clip is its data, one command trains it, and the run goes on to the bit."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.clip_folder import clip_folder, scene_of_two_steps, standing_plan
from helpers.mocap import default_humanoid

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.starts import Piece
from egopose.evaluation.reconstruction_run import one_after_the_other
from egopose.evaluation.run import evaluate
from egopose.humanoid.physics import BatchedPhysics
from egopose.inference.clip_rollout import after, roll_out, until
from egopose.inference.scene_values import window_value
from egopose.pipeline.agent import Agent, load_agent
from egopose.scene.clip import read_clip
from egopose.scene.scene_file import Box, Contact, read_scene
from egopose.scene.simulated import load_simulated
from egopose.tasks.reconstruction import TASK, ranges_of, touches_of
from egopose.tasks.task import task_of

SMALL = (
    "algo.steps_per_iteration=64",
    "algo.minibatch_size=16",
    "algo.critic_first=1",
    "collector.num_envs=4",
    "collector.physics_threads=1",
    "collector.update_threads=1",
    "model.hidden=[16]",
    "training.evaluate_every=0",
    "training.checkpoint_every=1",
)
CLONING = ("task.cloning.rounds=2", "task.cloning.bodies=8", "task.cloning.steps=40", "task.cloning.nearby=1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = clip_folder(tmp_path_factory.mktemp("clip") / "step", scene_of_two_steps())
    standing_plan(out, 12).save(out / "plan.npz")
    return out


def train(run: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "egopose.train", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    words = [f"task.clip={folder}", f"task.start_from={folder / 'plan.npz'}", *CLONING, "algo.iterations=2"]
    ended = train(out, "experiment=reconstruction", *words, *SMALL, f"hydra.run.dir={out}")
    assert ended.returncode == 0, ended.stderr
    assert "taught by the plan, round 1" in ended.stderr
    return out


def weights(path: Path) -> dict[str, torch.Tensor]:
    agent = load_agent(path, which="latest")
    return {**agent.actor.state_dict(), **{f"critic.{k}": v for k, v in agent.critic.state_dict().items()}}


def test_the_command_trains_and_a_run_cut_off_goes_on_to_the_bit(run: Path, tmp_path: Path) -> None:
    import shutil

    whole, half = tmp_path / "whole", tmp_path / "half"
    for copy in (whole, half):
        shutil.copytree(run, copy)
    assert train(whole, f"resume={whole}", "algo.iterations=4").returncode == 0
    for iterations in (3, 4):
        ended = train(half, f"resume={half}", f"algo.iterations={iterations}")
        assert ended.returncode == 0, ended.stderr
        assert "resuming" in ended.stdout
        assert "taught" not in ended.stderr
    one, other = weights(whole), weights(half)
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


def test_evaluate_leaves_a_motion_that_physics_plays_again_to_the_bit(run: Path, tmp_path: Path) -> None:
    values = compose_config("evaluate", [f"checkpoint={run}", f"out={tmp_path / 'out'}", "threads=1", "report=true"])
    told = evaluate(values)
    page = tmp_path / "out" / "reconstruction.html"
    assert f"report: {page}" in told
    assert "Where it fails" in page.read_text()
    assert "frames until an ending" in told
    assert "scene by the values" in told
    motion = load_simulated(tmp_path / "out" / "simulated.npz")
    assert len(motion) == 24
    humanoid = load_agent(run).dataset.humanoid
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps)
    physics.set_state(slice(None), motion.qpos[:1], motion.qvel[:1])
    physics.place_boxes(slice(None), motion.box_tops[None], motion.box_headings[None])
    for t, ctrl in enumerate(motion.ctrl):
        physics.step(ctrl[None])
        np.testing.assert_array_equal(physics.qpos[0], motion.qpos[t + 1])
    physics.close()
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert figures["frames"] == 24
    assert 0 < figures["mpjpe"] < 1000
    assert set(figures["terms"]) >= {"clip_pose", "up_hint", "contact_match", "landing"}
    fit = json.loads((tmp_path / "out" / "scene_fit.json").read_text())
    assert set(fit["changes"]) == {"step.along", "step.height", "second.height"}
    assert -0.1 - 1e-9 <= fit["changes"]["step.height"] <= 0.2 + 1e-9
    box = read_scene(tmp_path / "out" / "scene_by_values.yaml").box("step")
    assert box.height == pytest.approx(0.2 + fit["changes"]["step.height"], abs=1e-3)


def test_the_slope_of_a_windows_value_is_exact(run: Path) -> None:
    agent = load_agent(run, which="latest")
    assert agent.dataset.clip is not None  # type: ignore[attr-defined]
    ranges = ranges_of(agent.dataset.clip.scene)  # type: ignore[attr-defined]
    value = window_value(agent, ranges, 0, 11)
    e = torch.tensor([0.2, -0.4, 0.1], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(e), e)
    step = 2e-3  # over which no unit of the network switches
    for k in range(3):
        apart = torch.zeros(3, dtype=torch.float64)
        apart[k] = step
        with torch.no_grad():
            differences = (value(e + apart) - value(e - apart)) / (2 * step)
        assert slope[k].item() == pytest.approx(differences.item(), rel=0.05, abs=1e-3)


def config_of(folder: Path | None, *words: str) -> dict[str, Any]:
    clip = [] if folder is None else [f"task.clip={folder}"]
    return compose_config("train", ["experiment=reconstruction", *clip, *words])


def dataset_of(folder: Path, *words: str) -> Any:
    return TASK.dataset(config_of(folder, *words), None)  # type: ignore[arg-type]


def test_a_rollout_of_a_later_window_goes_on_from_what_was_before(run: Path) -> None:
    agent = load_agent(run, which="latest")
    plan = agent.dataset.plan  # type: ignore[attr-defined]
    piece = Piece(0, 4, 10)
    env = agent.make_env(num_envs=1, whole_fragments=True, falls_end=False, fragments=[piece])
    rollout = roll_out(env, agent.actor, piece)
    env.close()
    assert (rollout.first, len(rollout.motion)) == (4, 6)
    np.testing.assert_array_equal(rollout.motion.qpos[0], plan.qpos[4])
    whole = after(rollout, plan)
    assert len(whole) == 10
    cut = until(whole, 7)
    assert (len(cut.qpos), len(cut.qvel), len(cut.ctrl)) == (7, 7, 6)
    assert len(until(whole, 0)) == 2
    np.testing.assert_array_equal(whole.qpos[:5], plan.qpos[:5])


def in_window(agent: Agent, number: int | None) -> Agent:
    return replace(agent, config={**agent.config, "task": {**agent.config["task"], "window": number}})


def test_policies_of_windows_act_one_after_the_other(run: Path) -> None:
    """The same network twice: what it does is what it does alone, for nothing in it depends on the window."""
    agent = load_agent(run, which="latest")
    one = one_after_the_other([in_window(agent, 1)], threads=1)
    two = one_after_the_other([in_window(agent, 1), in_window(agent, 2)], threads=1)
    assert (len(two.motion), len(two.rewards), len(two.touched)) == (24, 23, 23)
    np.testing.assert_array_equal(two.motion.qpos[:21], one.motion.qpos[:21])
    # From the hand-over on physics is begun anew from the same state.
    np.testing.assert_allclose(two.motion.qpos, one.motion.qpos, atol=1e-6)
    with pytest.raises(InputError, match=r"task\.window: is None"):
        one_after_the_other([agent], threads=1)


def test_it_is_a_task_of_the_house(folder: Path) -> None:
    config = config_of(folder)
    assert task_of(config) is TASK
    dataset = dataset_of(folder)
    assert [tuple(piece) for piece in dataset.train] == [(0, 0, 24)]
    assert dataset.store_fingerprint is None


def test_a_window_trains_on_its_frames_and_frees_its_boxes(folder: Path, tmp_path: Path) -> None:
    assert [tuple(piece) for piece in dataset_of(folder, "task.window=1").train] == [(0, 0, 24)]
    assert [tuple(piece) for piece in dataset_of(folder, "task.window=2").train] == [(0, 15, 24)]
    with pytest.raises(InputError, match=r"task\.window: 3 must be from 1 to 2"):
        dataset_of(folder, "task.window=3")


def test_only_the_boxes_of_a_window_vary_but_all_are_seen(tmp_path: Path) -> None:
    """So every window's networks have the same shapes, and the next can begin with them."""
    two = scene_of_two_steps()
    third = Box("third", (0.4, 0.4), (2.0, 0.0), 1.0, 0.0, {"along": (-0.1, 0.1)})
    contacts = (*two.contacts, Contact("right_hand", "third", 22, 23))
    folder = clip_folder(tmp_path / "three", replace(two, boxes=(*two.boxes, third), contacts=contacts))
    sizes = set()
    for window, varies in (("1", [True, True, False]), ("3", [False, True, True]), ("null", [True] * 3)):
        words = [f"task.window={window}"]
        problem = TASK.problem(config_of(folder, *words), dataset_of(folder, *words), None)
        assert problem.varies.tolist() == varies
        change = problem.changes(50, torch.Generator().manual_seed(0))
        assert (change.abs().amax((0, 2)) > 0).tolist() == varies
        sizes.add(tuple(problem.observation_sizes.items()))
    assert len(sizes) == 1


def test_feet_without_contacts_in_the_scene_stand_on_the_floor(tmp_path: Path) -> None:
    clip = read_clip(clip_folder(tmp_path / "bare"))
    touches = touches_of(clip, default_humanoid(4))
    assert touches.shape == (24, 4, 1)
    np.testing.assert_array_equal(touches[:, :2, 0].numpy(), clip.touching)
    assert not touches[:, 2:].any()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["task.clip=null"], r"task\.clip: name the folder"),
        (["task.targets=rest"], r"task\.targets: must be clip or plan"),
        (["task.targets=plan"], r"task\.targets: plan needs task\.start_from"),
        (["model.context.source=frozen"], r"model\.context\.source"),
        (["task.start_from=nowhere.npz"], "nowhere"),
    ],
)
def test_what_does_not_fit_is_told(folder: Path, words: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        dataset_of(folder, *words)


def test_a_plan_of_another_scene_is_told(folder: Path, tmp_path: Path) -> None:
    bare = clip_folder(tmp_path / "bare")
    with pytest.raises(InputError, match="box_headings: has 2 boxes, the scene 0"):
        dataset_of(bare, f"task.start_from={folder / 'plan.npz'}")
