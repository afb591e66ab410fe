"""Runs that end as they should not: killed, cut off from the disk, from a worker or from the data, fed with NaN."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.toy_problem import make_run
from helpers.train_command import called, command, launcher, start
from helpers.waiting import PATIENCE

from egopose import bench
from egopose.benchmarks.processes import end_of, family
from egopose.checkpoint import checkpoint as checkpoints
from egopose.checkpoint.resume import continued_job, finished, mark_finished, only_process
from egopose.core.errors import InputError
from egopose.core.safe_tensors import load_tensors
from egopose.envs.transforms import VisualContext
from egopose.training.logging import CsvCurves
from egopose.training.loop import Run, TrainingStopped, interrupts_held, train
from egopose.training.ppo import TrainingDiverged

__all__ = ["launcher"]  # a fixture

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray: pip install 'egopose[ray]'")
needs_joblib = pytest.mark.skipif(
    importlib.util.find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="needs pip install 'egopose[sweep]'"
)
linux = pytest.mark.skipif(sys.platform != "linux", reason="kills processes")


# --- kill -9 ---------------------------------------------------------------------------------------------------------


def killed(capsys: pytest.CaptureFixture[str], rounds: int, *overrides: str) -> dict[str, Any]:
    bench.main(["resume", "--json", "--rounds", str(rounds), *overrides])
    return dict(json.loads(capsys.readouterr().out.strip().splitlines()[-1]))


@linux
@pytest.mark.parametrize("rounds", [3, pytest.param(50, marks=pytest.mark.slow)])
def test_killed_at_random_moments_it_ends_as_if_left_alone(rounds: int, capsys: pytest.CaptureFixture[str]) -> None:
    result = killed(capsys, rounds)
    assert (result["kills"], result["bit_equal"], result["curves_equal"]) == (rounds, True, True)
    assert (result["loaded_equal"], result["orphans"]) == (True, 0)


@linux
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", pytest.param("ray", marks=needs_ray)])
def test_with_workers_nothing_is_lost_or_left(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    result = killed(capsys, 3, f"collector={kind}", "collector.num_envs=2")
    assert (result["kills"], result["orphans"], result["iterations"]) == (3, 0, 15)
    assert (result["loaded_equal"], result["curves_whole"]) == (True, True)
    assert result["most_lost"] <= 2  # a checkpoint every second iteration
    assert (result["bit_equal"], result["curves_equal"]) == (True, True)


# --- checkpoints -----------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A toy run of three iterations with a checkpoint of each of the last two."""
    train(make_run(tmp_path, iterations=3, checkpoint_every=1), [])
    assert len(stored(tmp_path)) == 2
    return tmp_path


def stored(folder: Path) -> list[str]:
    return sorted(p.name for p in (folder / "checkpoints").iterdir())


def harm(checkpoint: Path) -> None:
    file = next((checkpoint / "components").rglob("*.memmap"))
    file.write_bytes(bytes(b ^ 1 for b in file.read_bytes()))


def test_a_damaged_checkpoint_is_put_aside_for_the_one_before(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, last = stored(folder)
    harm(folder / "checkpoints" / last)
    assert checkpoints.find_checkpoint(folder).name == before  # looking alone changes nothing
    assert stored(folder) == [before, last]
    assert "does not match its checksum" in capsys.readouterr().err
    assert checkpoints.recover(folder) == folder / "checkpoints" / before
    assert stored(folder) == [before, f"damaged-{last}"]
    message = capsys.readouterr().err
    assert "does not match its checksum" in message
    assert f"put aside as damaged-{last}, going on from {folder / 'checkpoints' / before}" in message
    run = make_run(folder, iterations=3, checkpoint_every=1)
    run.restore(checkpoints.find_checkpoint(folder))
    assert train(run, []).checkpoint.name == last


def test_without_a_manifest_it_is_damaged_too(folder: Path) -> None:
    before, last = stored(folder)
    (folder / "checkpoints" / last / "manifest.json").unlink()
    assert checkpoints.recover(folder) == folder / "checkpoints" / before


def test_where_all_are_damaged_they_stay_for_the_user(folder: Path) -> None:
    names = stored(folder)
    for name in names:
        harm(folder / "checkpoints" / name)
    with pytest.raises(InputError, match="does not match its checksum"):
        checkpoints.recover(folder)
    assert stored(folder) == names


def test_what_a_kill_leaves_is_cleared_or_taken_back(folder: Path) -> None:
    root, (before, last) = folder / "checkpoints", stored(folder)
    shutil.copytree(root / before, root / f".{last}.part-0a1b")
    (root / f"..{last}.part-0a1b.stage-2c3d").mkdir()
    shutil.copytree(root / before, root / f".{before}.delete-4e5f")
    os.replace(root / last, root / f".{last}.backup-6a7b")  # killed between the two renames of a replacement
    assert checkpoints.recover(folder) == root / last
    assert stored(folder) == [before, last]


def test_a_checkpoint_there_is_not_written_again(folder: Path) -> None:
    path = folder / "checkpoints" / stored(folder)[-1]
    run = make_run(folder, iterations=3)
    run.restore(path)
    written = (path / "manifest.json").read_text()
    assert train(run, []).checkpoint == path
    assert (path / "manifest.json").read_text() == written


def test_two_checkpoints_at_least_are_kept(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="keep_last: must be at least 2"):
        make_run(tmp_path, keep_last=1)


def test_curves_cut_off_in_a_row_lose_that_row_alone(tmp_path: Path) -> None:
    curves = CsvCurves(tmp_path / "curves.csv")
    for i in range(1, 13):
        curves.write(100 * i, {"iteration": float(i), "reward": 0.5})
    text = (tmp_path / "curves.csv").read_text()
    (tmp_path / "curves.csv").write_text(text[: text.index("12.0") + 1] + "\0\0")
    again = CsvCurves(tmp_path / "curves.csv", iteration=12)
    assert [row["iteration"] for row in again.rows] == [str(float(i)) for i in range(1, 12)]


# --- the disk --------------------------------------------------------------------------------------------------------

FULL_DISK = """
import resource, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from helpers.toy_problem import make_run
from egopose.checkpoint.checkpoint import recover, verify
from egopose.training.logging import build_loggers
from egopose.training.loop import TrainingStopped, train

def ended(folder, run, loggers):
    try:
        train(run, loggers)
    except TrainingStopped as error:
        message = str(error)
    found = recover(folder)
    assert message.endswith(f"the last checkpoint is {{found}}"), message
    assert not list(folder.glob("checkpoints/.*"))
    again = make_run(folder)
    again.restore(found)
    return message, run.counters.iteration - again.counters.iteration

folder = Path(sys.argv[1])
train(make_run(folder / "limit", iterations=1), [])
run = make_run(folder / "limit")
run.restore(recover(folder / "limit"))
before = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (8000, before[1]))  # less than the state of the random generators
message, lost = ended(folder / "limit", run, [])
resource.setrlimit(resource.RLIMIT_FSIZE, before)
assert "cannot be written: [Errno 27] File too large" in message, message
if sys.argv[2:]:
    small = Path(sys.argv[2])
    run = make_run(small, iterations=1000, checkpoint_every=1)
    message, lost = ended(small, run, build_loggers({{"kind": "tensorboard"}}, small, {{}}))
    assert "No space left on device" in message, message
    assert lost == 1 and run.counters.iteration >= 3
print("whole", len(sys.argv) - 1)
"""


@linux
def test_a_full_disk_ends_the_run_and_leaves_its_checkpoints_whole(tmp_path: Path) -> None:
    """A limit on a file's size, and where users may mount one of their own, a disk of 900 kB."""
    disk, program = tmp_path / "disk", tmp_path / "program.py"
    disk.mkdir()
    program.write_text(FULL_DISK.format(tests=str(Path(__file__).parents[1])))
    words = [sys.executable, str(program), str(tmp_path / "runs")]
    mount = ["unshare", "-Urm", "sh", "-c", f'mount -t tmpfs -o size=900k none {disk} && exec "$@"', "sh"]
    mounts = shutil.which("unshare") and subprocess.run([*mount, "true"], capture_output=True).returncode == 0
    words = [*mount, *words, str(disk)] if mounts else words
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.stdout.split() == ["whole", "2" if mounts else "1"], done.stderr


# --- workers, NaN, features ------------------------------------------------------------------------------------------


@linux
def test_workers_outlive_ctrl_c_and_are_missed_when_killed(tmp_path: Path) -> None:
    with interrupts_held():
        run = make_run(tmp_path, iterations=9, collector={"kind": "multi_sync", "workers": 2}, evaluate_every=1)
    workers = [worker.pid for worker in run.collector._collector.procs]

    def strike(iteration: int) -> dict[str, float]:
        if iteration == 1:  # a terminal sends Ctrl-C to all processes at once
            for worker in workers:
                os.kill(worker, signal.SIGINT)
        if iteration == 4:
            os.kill(workers[1], signal.SIGKILL)
        return {"score": 0.0}

    try:
        with pytest.raises(TrainingStopped, match="-9") as caught:
            train(run, [], strike)
    finally:
        run.collector.shutdown()
    found = checkpoints.find_checkpoint(tmp_path)
    assert str(found) in str(caught.value)
    # A checkpoint every third iteration, and one of the last whole one when the worker was missed.
    assert checkpoints.verify(found)["iteration"] == 4


LONG_STEP = """
import os, sys, time
sys.path.insert(0, {tests!r})
from functools import partial
from torchrl.envs import TransformedEnv
from helpers.toy_problem import COLLECTOR, ToyEnv, networks
from egopose.collection.collectors import CollectorSettings, build_collector

class Slow(ToyEnv):
    def _step(self, tensordict):
        # In one write, which no other worker's comes between.
        os.write(1, b"step %d\\n" % os.getpid())
        time.sleep(600)

def slow(worker):
    return TransformedEnv(Slow(2))

if __name__ == "__main__":
    settings = CollectorSettings.from_config({{**COLLECTOR, "kind": "multi_sync", "workers": 2}})
    next(iter(build_collector(settings, slow, networks()[0], 8)))
"""


@linux
def test_a_killed_learner_leaves_no_workers(tmp_path: Path) -> None:
    """Not even such as are in the middle of a step that takes ten minutes."""
    program = tmp_path / "program.py"
    program.write_text(LONG_STEP.format(tests=str(Path(__file__).parents[1])))
    with subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True) as learner:
        assert learner.stdout is not None
        try:
            steps = [learner.stdout.readline().split() for _ in range(2)]
            started = family(os.getpid())
            workers = {process for process in started if process[0] in {int(pid) for _, pid in steps}}
            assert len(workers) == 2
        finally:  # or a failure would wait ten minutes for the step's end
            learner.kill()
    assert end_of(workers, PATIENCE)[1] == set()


@linux
@pytest.mark.slow
@needs_ray
@pytest.mark.parametrize("between", [True, False], ids=["between-batches", "in-a-batch"])
def test_a_killed_worker_of_ray_is_missed(between: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=os.pathsep)
    run = make_run(tmp_path, iterations=9, collector={"kind": "ray", "workers": 2}, evaluate_every=1)
    names = {pid: Path(f"/proc/{pid}/comm").read_text() for pid, _ in family(os.getpid())}
    worker = next(pid for pid, name in names.items() if name.startswith("ray::Worker"))

    def strike(iteration: int) -> dict[str, float]:
        if iteration == 4:
            threading.Timer(0.0 if between else 0.01, os.kill, (worker, signal.SIGKILL)).start()
            time.sleep(1.0 if between else 0.0)
        return {"score": 0.0}

    try:
        with pytest.raises(TrainingStopped, match="a worker of Ray ended") as caught:
            train(run, [], strike)
    finally:
        run.collector.shutdown()
    found = checkpoints.find_checkpoint(tmp_path)
    assert str(found) in str(caught.value)
    assert checkpoints.verify(found)["iteration"] >= 4


def test_nan_ends_in_a_message_and_the_checkpoint_before_goes_on(tmp_path: Path) -> None:
    run = make_run(tmp_path, iterations=9, checkpoint_every=1, evaluate_every=1, minibatch_size=None, epochs=4)

    def poison(iteration: int) -> dict[str, float]:
        if iteration == 3:
            run.collector._carrier["humanoid_state"].fill_(float("nan"))
            run.collector.env.base_env.x.fill_(float("nan"))
        return {"score": 1.0}

    def healthy(path: Path) -> Run:
        again = make_run(tmp_path, iterations=9, minibatch_size=None, epochs=4)
        again.restore(path)
        return again

    with pytest.raises(TrainingDiverged, match=r"not finite .*the last checkpoint is") as caught:
        train(run, [], poison)
    before, last = (tmp_path / "checkpoints" / name for name in stored(tmp_path))
    assert str(last) in str(caught.value)
    assert checkpoints.verify(before)["iteration"] == 2
    assert train(healthy(before), []).iteration == 9


def test_weights_that_are_not_finite_are_never_saved(folder: Path) -> None:
    names = stored(folder)
    run = make_run(folder, iterations=9)
    next(run.ppo.critic.parameters()).data[0] = float("inf")
    with pytest.raises(TrainingDiverged, match=r"critic\..* is not finite"):
        run.save()
    assert stored(folder) == names


def test_features_that_vanish_are_read_on_and_missed_by_name_at_the_next_start(tmp_path: Path) -> None:
    from tensordict import TensorDict

    table = torch.randn(50, 4)
    TensorDict({"visual_context": table}, batch_size=[50]).memmap(tmp_path / "table")
    context = VisualContext(load_tensors(tmp_path / "table", "table")["visual_context"])
    (tmp_path / "table" / "visual_context.memmap").unlink()
    frames = torch.arange(50)[:, None]
    assert torch.equal(context._apply_transform(frames), table)  # mapped: the system keeps it for who has it open
    with pytest.raises(InputError, match=r"table: .*visual_context\.memmap is cut off or missing"):
        load_tensors(tmp_path / "table", "table")


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three iterations that came to its end, with checkpoints of the last two."""
    cwd = tmp_path_factory.mktemp("done")
    code, _, err = called(cwd, "algo.iterations=3", "training.checkpoint_every=1", "logger=csv")
    assert code == 0, err
    (folder,) = (cwd / "runs").iterdir()
    return folder


def test_resumed_from_another_directory_before_its_first_checkpoint(done: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(done, tmp_path / "run"))
    shutil.rmtree(folder / "checkpoints")
    (tmp_path / "elsewhere").mkdir()
    code, out, err = called(tmp_path / "elsewhere", "resume=../run")
    assert code == 0, err
    assert f"run directory: {folder}" in out
    assert not any((tmp_path / "elsewhere").iterdir())
    with (folder / "curves.csv").open() as stream, (done / "curves.csv").open() as first:
        rows = [[row["reward"] for row in csv.DictReader(file)] for file in (stream, first)]
    assert rows[0] == rows[1]


#: joblib's processes know nothing of the launcher: on their path, this runs it when they import what it changes.
STAND_IN = """
import runpy
import sys
from importlib.machinery import PathFinder

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name != "egopose.pipeline.training":
            return None
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec(name, path)
        execute = spec.loader.exec_module

        def execute_and_change(module):
            execute(module)
            runpy.run_path({launcher!r})

        spec.loader.exec_module = execute_and_change
        return spec

sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize("how", ["basic", pytest.param("local", marks=[needs_joblib, pytest.mark.slow], id="joblib")])
def test_a_sweep_runs_no_finished_job_again_and_goes_on_with_a_half_one(
    how: str, done: Path, launcher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(STAND_IN.format(launcher=str(launcher)))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    jobs = [tmp_path / "sweep" / number for number in "012"]
    for job in jobs[:2]:
        shutil.copytree(done, job)
    # The second job as a kill in its third iteration would have left it.
    (jobs[1] / "finished.json").unlink()
    shutil.rmtree(checkpoints.find_checkpoint(jobs[1]))
    written = checkpoints.find_checkpoint(jobs[0]).stat().st_mtime_ns
    same = ("algo.iterations=3", "training.checkpoint_every=1", "logger=csv")
    sweep = ("--multirun", "hydra.sweep.dir=sweep", f"hydra/launcher={how}", "training.evaluation_seed=1,2,3")
    # joblib's processes print past this one's streams.
    run = called if how == "basic" else partial(command, launcher)
    code, out, err = run(tmp_path, *sweep, *same)
    assert code == 0, err
    assert f"{jobs[0]}: finished already after 3 iterations" in out
    assert checkpoints.find_checkpoint(jobs[0]).stat().st_mtime_ns == written
    assert f"resuming {jobs[1]} after iteration 2" in out
    assert f"run directory: {jobs[2]}" in out
    scores = [json.loads((job / "finished.json").read_text())["score"] for job in jobs]
    assert scores == [scores[0]] * 3


def test_a_job_of_another_sweep_is_refused_by_its_field(done: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(done, tmp_path / "0"))
    config = checkpoints.read_json(checkpoints.find_checkpoint(folder), "config")
    assert continued_job(folder, config) == checkpoints.find_checkpoint(folder)
    with pytest.raises(InputError, match=r"is 0 in the job .* not 7: give another hydra.sweep.dir"):
        continued_job(folder, {**config, "seed": 7})


def test_a_larger_budget_reopens_a_finished_job(tmp_path: Path) -> None:
    config = {"algo": {"iterations": 3}, "training": {"total_steps": None, "max_seconds": 9.0}}
    mark_finished(tmp_path, config, {"score": 2.0})
    assert finished(tmp_path, config) is not None
    assert finished(tmp_path, {**config, "algo": {"iterations": 4}}) is None
    (tmp_path / "finished.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        finished(tmp_path, config)


def test_what_is_no_run_is_refused_and_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from egopose import train as command_line

    monkeypatch.setattr(sys, "argv", ["train", f"resume={tmp_path}"])
    with pytest.raises(SystemExit) as stop:
        command_line.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == f"error: {tmp_path}: config.yaml: is missing: this is no run directory\n"
    assert not any(tmp_path.iterdir())


@linux
def test_one_process_trains_in_a_run_directory(tmp_path: Path) -> None:
    with (
        only_process(tmp_path),
        pytest.raises(InputError, match="another process is training"),
        only_process(tmp_path),
    ):
        pass
    with only_process(tmp_path):
        pass


@linux
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["multi_sync", pytest.param("ray", marks=needs_ray)])
def test_ctrl_c_at_a_terminal_saves_whatever_collects(
    kind: str, launcher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A terminal sends it to every process of the command."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]), prepend=os.pathsep)
    words = ("algo.iterations=100000", "training.checkpoint_every=1", f"collector={kind}", "logger=csv")
    process = start(launcher, tmp_path, *words, start_new_session=True)
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip().removeprefix("run directory: "))
    while len(list(folder.glob("checkpoints/checkpoint-*"))) < 2:
        assert process.poll() is None
    started = family(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert f"python -m egopose.train resume={folder}" in out
    found = checkpoints.recover(folder)
    assert found is not None
    with (folder / "curves.csv").open() as file:
        assert checkpoints.verify(found)["iteration"] == float(list(csv.DictReader(file))[-1]["iteration"])
    assert end_of(started, PATIENCE)[1] == set()


@linux
@pytest.mark.slow
def test_a_second_ctrl_c_stops_at_once_and_keeps_what_is_saved(launcher: Path, tmp_path: Path) -> None:
    process = start(launcher, tmp_path, "algo.iterations=100000", "training.checkpoint_every=1", "logger=csv")
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip().removeprefix("run directory: "))
    while len(list(folder.glob("checkpoints/checkpoint-*"))) < 2:
        assert process.poll() is None
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.002)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    assert f"python -m egopose.train resume={folder}" in out
    assert checkpoints.recover(folder) is not None
