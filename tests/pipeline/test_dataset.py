"""What a policy is judged by: its own state regressor, on the data it was trained on; one preparation at a time."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import logging
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.small_store import configuration, fill_flow
from helpers.waiting import wait_until

from egopose.checkpoint.checkpoint import RunCheckpoint, find_checkpoint, metadata_of
from egopose.core.errors import InputError
from egopose.data import preparation
from egopose.data.lock import store_lock
from egopose.data.preparation import fingerprint_of, flow_name, humanoid_of, prepare, store_folder
from egopose.data.store import TakeStore
from egopose.pipeline import regressor as regression
from egopose.pipeline.agent import load_agent
from egopose.pipeline.dataset import load_dataset, run_dataset
from egopose.pipeline.regressor import kept_tables, load_regressor, regressor_name, regressor_tables
from egopose.pipeline.run import build_run
from egopose.training.loop import train


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with flow, its F, and a run of one iteration."""
    folder = tmp_path_factory.mktemp("made")
    config = configuration(folder)
    prepare(config, progress=False, flow=False)
    fill_flow(config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "_make_videos", lambda *_: None)
        run = build_run(config, folder / "run", load_dataset(config, progress=False))
        train(run, [])
    return folder


@pytest.fixture
def no_videos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "_make_videos", lambda *_: None)


@pytest.fixture
def untrainable(monkeypatch: pytest.MonkeyPatch, no_videos: None) -> None:
    def refused(*_: Any) -> None:
        pytest.fail("the state regressor is being trained")

    monkeypatch.setattr(regression, "train_regressor", refused)


@pytest.fixture
def copied(made: Path) -> Any:
    """The folder, put back as it was after a test that damages it (its paths are in the run's configuration)."""
    kept = made.with_name(made.name + "-kept")
    shutil.copytree(made, kept)
    yield made
    shutil.rmtree(made)
    kept.rename(made)


# --- a policy keeps its own F ----------------------------------------------------------------------------------------


def test_an_agent_reads_the_table_its_own_regressor_made(
    made: Path, untrainable: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regression, "predict_takes", lambda *_: pytest.fail("the table is there already"))
    agent = load_agent(made / "run", which="latest")
    assert agent.dataset.regressor == made / "run" / "regressor"
    assert json.loads((made / "run" / "provenance.json").read_text())["store_fingerprint"] == fingerprint_of(
        agent.config
    )


def test_without_the_stores_table_the_runs_regressor_predicts_the_same(copied: Path, untrainable: None) -> None:
    before = load_agent(copied / "run", which="latest").dataset
    tables = {k: getattr(before, k).clone() for k in ("visual_context", "visual_features", "joint_targets", "states")}
    shutil.rmtree(copied / "store" / "regressors")
    shutil.rmtree(copied / "store" / "tables")
    for path in (copied / "run", find_checkpoint(copied / "run")):
        after = load_agent(path, which="latest").dataset
        for key, table in tables.items():
            assert torch.equal(getattr(after, key), table), key
    assert not (copied / "store" / "tables").exists()


def test_a_store_with_another_regressor_of_the_same_name_is_not_believed(copied: Path, untrainable: None) -> None:
    config = configuration(copied)
    store = TakeStore.open(copied / "store")
    name = regressor_name(config, store, flow_name(config))
    before = store.table(name)["visual_context"].clone()
    weights = store.root / "regressors" / name
    model, source_config = load_regressor(weights)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1.5)
    metadata = metadata_of("regressor", source_config["state_size"], 1, 0, 0.0)
    RunCheckpoint({"regressor": model, "config": source_config}).save(weights, metadata=metadata)
    store.write_table(name, {k: v + 1 for k, v in store.table(name).items()}, {"flow": flow_name(config)})
    loaded = load_agent(copied / "run", which="latest").dataset.visual_context
    assert loaded is not None
    assert torch.equal(loaded, before)


def test_with_neither_regressor_a_run_is_refused_and_nothing_trained(copied: Path, untrainable: None) -> None:
    shutil.rmtree(copied / "run" / "regressor")
    load_agent(copied / "run", which="latest")  # the store's own is left
    shutil.rmtree(copied / "store" / "tables")
    with pytest.raises(InputError, match=r"regressor: regressor: is missing"):
        load_agent(copied / "run", which="latest")


def test_a_run_of_another_store_is_refused(copied: Path, untrainable: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "PREPARATION_VERSION", preparation.PREPARATION_VERSION + 1)
    with pytest.raises(InputError, match=r"provenance\.json: store_fingerprint: the run was trained on a store"):
        load_agent(copied / "run", which="latest")
    monkeypatch.undo()
    (copied / "run" / "provenance.json").write_text("{}")
    with pytest.raises(InputError, match=r"store_fingerprint: is damaged"):
        load_agent(copied / "run", which="latest")


def test_older_runs_noted_no_store(copied: Path, untrainable: None) -> None:
    (copied / "run" / "provenance.json").unlink()
    load_agent(copied / "run", which="latest")


def test_a_run_does_not_go_on_with_another_store(made: Path, no_videos: None, tmp_path: Path) -> None:
    found = load_agent(made / "run", which="latest").dataset
    found.keep_provenance(tmp_path)
    found.keep_provenance(tmp_path)
    with pytest.raises(InputError, match="store_fingerprint"):
        dataclasses.replace(found, store_fingerprint="0" * 64).keep_provenance(tmp_path)


# --- fingerprints see code -------------------------------------------------------------------------------------------


def test_the_preparations_version_is_part_of_fingerprint_and_folder(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = configuration(made)
    config["data"] = {**config["data"], "store": None}
    first, folder = fingerprint_of(config), store_folder(config)
    monkeypatch.setattr(preparation, "PREPARATION_VERSION", preparation.PREPARATION_VERSION + 1)
    assert fingerprint_of(config) != first
    assert store_folder(config) != folder
    with pytest.raises(InputError, match="another version of the preparation"):
        prepare(configuration(made), progress=False, flow=False)


# --- one process at a time -------------------------------------------------------------------------------------------

HOLDER = """
import sys
from pathlib import Path
from egopose.data.lock import store_lock
with store_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


def hold(root: Path) -> subprocess.Popen[str]:
    """A process that holds the store's lock until it is told, or ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(root)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_preparation_waits_and_says_so(made: Path, capfd: pytest.CaptureFixture[str]) -> None:
    process, said = hold(made / "store"), ""

    def waits() -> bool:
        nonlocal said
        said += capfd.readouterr().err
        return "waiting: another process is at work on the store" in said

    with ThreadPoolExecutor() as pool:
        second = pool.submit(prepare, configuration(made), progress=False, flow=False)
        wait_until(waits, "the second preparation says that it waits")
        assert not second.done()
        process.communicate("end\n")
        second.result()
    assert process.returncode == 0
    said += capfd.readouterr().err
    assert said.count("waiting") == 1
    prepare(configuration(made), progress=False, flow=False)
    assert "waiting" not in capfd.readouterr().err


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    process = hold(tmp_path / "store")
    process.kill()
    process.wait()
    with store_lock(tmp_path / "store"):
        pass


def test_a_failed_preparation_holds_nothing(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "PREPARATION_VERSION", preparation.PREPARATION_VERSION + 1)
    with pytest.raises(InputError):
        prepare(configuration(made), progress=False, flow=False)
    with (made / "store.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


# --- F's training, resumed -------------------------------------------------------------------------------------------


class _Stopped(Exception):
    pass


def test_the_regressors_training_goes_on_where_it_stopped(
    copied: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    config = configuration(copied)
    store, humanoid, flow = TakeStore.open(copied / "store"), humanoid_of(config), flow_name(config)
    whole = {k: v.clone() for k, v in regressor_tables(config, store, humanoid, flow)[0].items()}
    shutil.rmtree(store.root / "regressors")
    shutil.rmtree(store.root / "tables")
    part = store.root / "regressors" / (regressor_name(config, store, flow) + ".part")
    epochs: list[int] = []

    def stops_after_two(progress: Any) -> None:
        epochs.append(progress.epoch)
        if progress.epoch == 2:
            raise _Stopped

    monkeypatch.setattr(regression, "_report", stops_after_two)
    with pytest.raises(_Stopped):
        regressor_tables(config, store, humanoid, flow)
    assert (part / "checksums.json").is_file()
    assert not [f for f in part.rglob("*") if f.suffix in (".pt", ".pkl", ".pickle")]
    with pytest.raises(InputError, match="holds none"):
        kept_tables(config, store, humanoid, flow, copied / "nowhere")
    monkeypatch.setattr(regression, "_report", lambda progress: epochs.append(progress.epoch))
    again, weights = regressor_tables(config, store, humanoid, flow)
    assert epochs == [1, 2, 3, 4]
    assert "going on after epoch 2" in capfd.readouterr().err
    assert not part.exists()
    for key, table in whole.items():
        assert torch.equal(again[key], table), key
    assert load_regressor(weights)[0] is not None


def test_a_damaged_part_is_named(copied: Path) -> None:
    config = configuration(copied)
    store, flow = TakeStore.open(copied / "store"), flow_name(config)
    name = regressor_name(config, store, flow)
    shutil.rmtree(store.root / "tables")
    (store.root / "regressors" / f"{name}.part").mkdir()
    with pytest.raises(InputError, match=r"\.part"):
        regressor_tables(config, store, humanoid_of(config), flow)


def test_a_feature_file_that_vanished_is_named_and_put_back_the_run_goes_on(copied: Path, untrainable: None) -> None:
    """A running training keeps what it has mapped; see test_survival.py."""
    config = configuration(copied)
    (file,) = (copied / "store" / "tables").glob("*/visual_context.memmap")
    file.rename(copied / "elsewhere")
    with pytest.raises(InputError, match=r"visual_context\.memmap is cut off or missing") as caught:
        run_dataset(config, copied / "run")
    assert str(file.parent) in str(caught.value)
    (copied / "elsewhere").rename(file)
    run = build_run(config, copied / "run", run_dataset(config, copied / "run"))
    run.restore(find_checkpoint(copied / "run"))
    assert run.counters.iteration == 1


# --- a quiet start ---------------------------------------------------------------------------------------------------


def test_imports_are_quiet_without_a_screen_and_force_no_backend() -> None:
    program = (
        "import logging, os; logging.basicConfig(level=logging.INFO)\n"
        "from egopose.core.runtime import prepare_runtime; prepare_runtime()\n"
        "before = os.environ.get('MUJOCO_GL')\n"
        "from dm_control import mujoco\n"
        "assert os.environ.get('MUJOCO_GL') == before\n"
        "logging.getLogger('absl').warning('still heard')\n"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MUJOCO_GL", "PYTHONWARNINGS")}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == f"{logging.getLevelName(logging.WARNING)}:absl:still heard\n"
