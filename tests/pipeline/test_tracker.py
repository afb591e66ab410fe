"""Teaching a tracker by command: from two clips to a policy PPO begins with, and what is made again and what is not."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.mocap import short_clips

from egopose.checkpoint.checkpoint import verify
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.pipeline import tracker
from egopose.pipeline.dataset import load_dataset
from egopose.pipeline.run import build_run, start_from
from egopose.pipeline.tracker import train_tracker

SMALL = [
    "data.split.train_share=0.5",
    "data.split.shortest=8",
    "task.horizon=10",
    "task.minimum=5",
    "model.hidden=[16]",
    "model.critic.hidden=[16]",
    "collector=sync",
    "collector.num_envs=2",
    "collector.physics_threads=1",
    "algo.steps_per_iteration=8",
    "algo.iterations=1",
    "algo.minibatch_size=8",
    "seed=3",
]
TEACHING = [
    "task.errors=[null]",
    "rounds=2",
    "shard=1",
    "teacher.num_envs=2",
    "teacher.horizon=2",
    "teacher.every=2",
    "teacher.chunk=8",
    "cloning.seconds=1.0",
    "cloning.batch=16",
]


def settings(folder: Path, *overrides: str) -> dict[str, Any]:
    return compose_config("tracker", [*short_clips(folder), *SMALL, *TEACHING, f"out={folder / 'out'}", *overrides])


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted((folder / "out").rglob("*.npz"))}


@pytest.fixture
def few_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracker, "_SIMULATED", 32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("taught")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracker, "_SIMULATED", 32)
        train_tracker(settings(folder))
    return folder


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "field"),
    [
        ("teacher.every=3", "teacher.every"),
        ("training.start_from=elsewhere", "training.start_from"),
        ("task.name=estimation", "task"),
        ("teacher.cost.place=much", "place"),
        ("cloning.batch=1.5", "batch"),
    ],
)
def test_wrong_settings_are_named_before_anything_is_read(tmp_path: Path, override: str, field: str) -> None:
    with pytest.raises(InputError) as caught:
        train_tracker(settings(tmp_path, override))
    assert caught.value.field == field


def test_a_missing_folder_is_named() -> None:
    with pytest.raises(InputError, match="out"):
        compose_config("tracker", [])


# --- lessons on the disk ---------------------------------------------------------------------------------------------


def lessons_file(path: Path, **changed: Any) -> Path:
    arrays = {
        "frame": np.arange(3),
        "qpos": np.zeros((3, 9), np.float32),
        "qvel": np.zeros((3, 8), np.float32),
        "ctrl": np.zeros((3, 2), np.float32),
        "gains": np.zeros((3, 2, 16), np.float16),
    } | changed
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_lessons_come_back_as_they_were_kept(tmp_path: Path) -> None:
    lessons = tracker._read(lessons_file(tmp_path / "0.npz"), 9, 8, 2, 3)
    assert lessons.frame.tolist() == [0, 1, 2]
    assert lessons.gains.dtype == np.float16


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"ctrl": None}, "ctrl"),
        ({"qpos": np.zeros((3, 10), np.float32)}, "qpos"),
        ({"gains": np.zeros((2, 2, 16), np.float16)}, "gains"),
        ({"frame": np.array([0, 1, 3])}, "frame"),
        ({"frame": np.array([-1, 1, 2])}, "frame"),
        ({"frame": np.array([0.0, 1.0, 2.0])}, "frame"),
        ({"qvel": np.array([None] * 3)}, "qvel"),
    ],
)
def test_lessons_of_something_else_are_refused(tmp_path: Path, changed: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match="remove it") as caught:
        tracker._read(lessons_file(tmp_path / "0.npz", **changed), 9, 8, 2, 3)
    assert caught.value.field == field


@pytest.mark.parametrize("kept", [0, 40, -40])
def test_damaged_lessons_are_refused(tmp_path: Path, kept: int) -> None:
    path = lessons_file(tmp_path / "0.npz")
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(InputError, match="remove it"):
        tracker._read(path, 9, 8, 2, 3)


# --- end to end ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_two_rounds_leave_lessons_and_a_policy(made: Path) -> None:
    rounds = {name.split("/")[1] for name in files(made)}
    assert rounds == {"lessons_0", "lessons_1"}
    with np.load(made / "out" / "lessons_0" / "0000.npz") as lessons:
        assert len(lessons["frame"]) > 3
    for number in range(2):
        verify(made / "out" / f"round_{number}")
    first, second = (np.load(made / "out" / f"lessons_{number}" / "0000.npz")["qpos"] for number in range(2))
    assert first.shape != second.shape or (first != second).any()


@pytest.mark.slow
def test_a_lost_file_of_lessons_is_made_again_as_it_was(made: Path, few_worlds: None, monkeypatch: Any) -> None:
    """In whichever round, with the policy of that round; the others and the policies stay."""
    before = files(made)
    taught: list[int] = []
    teach = tracker.teach
    monkeypatch.setattr(tracker, "teach", lambda *args: taught.append(1) or teach(*args))
    monkeypatch.setattr(tracker, "clone", lambda *_: pytest.fail("a policy is taught again"))
    for lost in ("out/lessons_0/0001.npz", "out/lessons_1/0000.npz"):
        taught.clear()
        (made / lost).unlink()
        train_tracker(settings(made))
        assert taught == [1]
        with np.load(made / lost) as now:
            (made / "old.npz").write_bytes(before[lost])
            with np.load(made / "old.npz") as then:
                assert all((now[name] == then[name]).all() for name in then)
    assert files(made).keys() - {"old.npz"} == before.keys()


@pytest.mark.slow
def test_a_folder_of_other_settings_is_refused(made: Path) -> None:
    with pytest.raises(InputError, match="another out=FOLDER") as caught:
        train_tracker(settings(made, "teacher.horizon=3"))
    assert caught.value.field == "teacher.horizon"


@pytest.mark.slow
@pytest.mark.usefixtures("few_worlds")
def test_more_rounds_go_on_from_those_there_are(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "out", tmp_path / "out")
    before = (tmp_path / "out" / "round_1" / "manifest.json").stat().st_mtime_ns
    values = {**settings(made, "rounds=3"), "out": str(tmp_path / "out")}
    train_tracker(values)
    assert (tmp_path / "out" / "round_1" / "manifest.json").stat().st_mtime_ns == before
    verify(tmp_path / "out" / "round_2")


@pytest.mark.slow
def test_ppo_goes_on_from_a_round(made: Path, tmp_path: Path) -> None:
    """With the errors of conf/task/tracking, which the policy was not taught with."""
    config = compose_config("train", ["experiment=tracking", *short_clips(made), *SMALL])
    run = build_run(config, tmp_path, load_dataset(config, progress=False))
    start_from(run, str(made / "out" / "round_1"))
    assert int(run.collector.env.transform[1].count) == 1_000_000
    run.collector.shutdown()
