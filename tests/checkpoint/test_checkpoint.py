"""Checkpoints: a round trip to the bit, every fault caused on purpose, no pickle, TorchRL's own readers."""

from __future__ import annotations

import hashlib
import json
import os
import pickletools
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.toy_problem import CONFIG, make_run
from torchrl.checkpoint import Checkpoint
from torchrl.render import load_checkpoint
from torchrl.render.checkpoint import infer_state_dict

from egopose.checkpoint import checkpoint as checkpoints
from egopose.checkpoint.checksums import CHECKSUMS, _checksums
from egopose.core import file_digests
from egopose.core.errors import InputError
from egopose.training.loop import Run, train


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """A toy run after two iterations and its checkpoint; not to be altered."""
    run = make_run(tmp_path_factory.mktemp("run"), iterations=2)
    return run, train(run, []).checkpoint


@pytest.fixture
def copy(saved: tuple[Run, Path], tmp_path: Path) -> Path:
    """A copy of the checkpoint to do harm to."""
    return Path(shutil.copytree(saved[1], tmp_path / "checkpoint"))


def reseal(folder: Path) -> None:
    """Make the checksums right again after a change, as someone would who meant it."""
    (folder / CHECKSUMS).write_text(json.dumps(_checksums(folder)))


def component(folder: Path, name: str) -> Path:
    return folder / str(Checkpoint.manifest(folder)["components"][name]["path"])


def test_round_trip_to_the_bit(saved: tuple[Run, Path], tmp_path: Path) -> None:
    run, path = saved
    other = make_run(tmp_path, seed=77)
    drawn = torch.get_rng_state()
    other.restore(path)
    for mine, theirs in zip(run.checkpoint().components.items(), other.checkpoint().components.items(), strict=True):
        if mine[0] in ("rng", "config"):
            continue
        assert_equal_trees(_state(mine[1]), _state(theirs[1]), mine[0])
    assert not torch.equal(drawn, torch.get_rng_state())
    again = other.save()
    rng = [json.loads((component(p, "rng") / "state.json").read_text()) for p in (path, again)]
    assert rng[0] == rng[1]


def _state(value: Any) -> Any:
    return value if isinstance(value, dict) else value.state_dict()


def assert_equal_trees(first: Any, second: Any, where: str) -> None:
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second), where
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_equal_trees(first[key], second[key], f"{where}.{key}")
    elif isinstance(first, (list, tuple)):
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            assert_equal_trees(a, b, f"{where}[{i}]")
    else:
        assert first == second, where


def test_no_file_is_a_pickle(saved: tuple[Run, Path]) -> None:
    files = [p for p in saved[1].rglob("*") if p.is_file()]
    assert {p.suffix for p in files} <= {".json", ".memmap"}
    for file in files:
        data = file.read_bytes()
        if file.suffix == ".json":
            json.loads(data)
        # A pickle of protocol 2 or later begins with PROTO and can be walked to its STOP.
        if data[:1] == b"\x80" and data[1:2] in b"\x02\x03\x04\x05":
            with pytest.raises(Exception, match=r".*"):
                list(pickletools.genops(data))


def truncate(folder: Path) -> str:
    file = next((component(folder, "policy") / "state").rglob("*.memmap"))
    file.write_bytes(file.read_bytes()[:-4])
    return file.relative_to(folder).as_posix()


def flip_a_byte(folder: Path) -> str:
    file = next((component(folder, "critic") / "state").rglob("*.memmap"))
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(bytes(data))
    return file.relative_to(folder).as_posix()


def remove_a_file(folder: Path) -> str:
    file = component(folder, "policy_optimizer") / "state.json"
    file.unlink()
    return file.relative_to(folder).as_posix()


def add_a_file(folder: Path) -> str:
    (folder / "extra.bin").write_bytes(b"x")
    return "extra.bin"


def edit_the_manifest(folder: Path) -> str:
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace('"toy"', '"other"'))
    return "manifest.json"


def break_the_manifest(folder: Path) -> str:
    (folder / "manifest.json").write_text("{")
    return "manifest.json"


def take_the_manifest_away(folder: Path) -> str:
    (folder / "manifest.json").unlink()
    return "manifest.json"


def break_the_checksums(folder: Path) -> str:
    (folder / CHECKSUMS).write_text("[")
    return CHECKSUMS


def newer_schema(folder: Path) -> str:
    _edit_metadata(folder, schema=checkpoints.SCHEMA + 1)
    return "schema"


def another_task(folder: Path) -> str:
    _edit_metadata(folder, task="forecasting")
    return "task"


def another_action_size(folder: Path) -> str:
    _edit_metadata(folder, action_size=52)
    return "action_size"


def _edit_metadata(folder: Path, **values: Any) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["metadata"] |= values
    (folder / "manifest.json").write_text(json.dumps(manifest))
    reseal(folder)


def remove_a_key(folder: Path) -> str:
    file = component(folder, "policy") / "state.json"
    state = json.loads(file.read_text())
    key = state["items"].pop(0)[0]["value"]
    file.write_text(json.dumps(state))
    reseal(folder)
    return f"policy.{key}"


def add_a_key(folder: Path) -> str:
    file = component(folder, "critic") / "state.json"
    state = json.loads(file.read_text())
    state["items"].append([{"kind": "value", "value": "surplus"}, state["items"][0][1]])
    file.write_text(json.dumps(state))
    reseal(folder)
    return "critic.surplus"


def change_a_shape(folder: Path) -> str:
    file = component(folder, "policy") / "state.json"
    state = json.loads(file.read_text())
    # The first weight points to the first bias's tensor.
    state["items"][0][1] = state["items"][1][1]
    file.write_text(json.dumps(state))
    reseal(folder)
    return f"policy.{state['items'][0][0]['value']}"


def remove_a_component(folder: Path) -> str:
    manifest = json.loads((folder / "manifest.json").read_text())
    shutil.rmtree(folder / manifest["components"].pop("critic")["path"])
    (folder / "manifest.json").write_text(json.dumps(manifest))
    reseal(folder)
    return "critic"


@pytest.mark.parametrize(
    "harm",
    [
        truncate,
        flip_a_byte,
        remove_a_file,
        add_a_file,
        edit_the_manifest,
        break_the_manifest,
        take_the_manifest_away,
        break_the_checksums,
        newer_schema,
        another_task,
        another_action_size,
        remove_a_key,
        add_a_key,
        change_a_shape,
        remove_a_component,
    ],
)
def test_each_fault_is_refused_by_name(harm: Callable[[Path], str], copy: Path, tmp_path: Path) -> None:
    field = harm(copy)
    run = make_run(tmp_path / "run")
    before = {key: value.clone() for key, value in run.ppo.critic.state_dict().items()}
    with pytest.raises(InputError) as caught:
        run.restore(copy)
    assert caught.value.field == field
    assert str(copy) in str(caught.value)
    if harm not in (remove_a_key, change_a_shape):  # the critic comes before the policy in the order of loading
        assert_equal_trees(before, dict(run.ppo.critic.state_dict()), "critic")


def test_networks_of_another_size_are_refused(saved: tuple[Run, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        make_run(tmp_path, size=3).restore(saved[1])
    assert caught.value.field == "action_size"


def test_another_number_of_worlds_is_refused(saved: tuple[Run, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="simulation"):
        make_run(tmp_path, num_envs=4).restore(saved[1])


def test_unknown_run_directories(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        checkpoints.find_checkpoint(tmp_path / "nowhere")
    with pytest.raises(InputError, match="neither a run directory"):
        checkpoints.find_checkpoint(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(InputError, match="none yet"):
        checkpoints.find_checkpoint(tmp_path)


def test_the_last_and_the_best_are_kept(tmp_path: Path) -> None:
    scores = {1: 5.0, 2: 9.0, 3: 1.0, 4: 2.0, 5: 3.0}
    run = make_run(tmp_path, iterations=5, checkpoint_every=1, keep_last=2, evaluate_every=1)
    train(run, [], lambda iteration: {"score": scores[iteration]})
    kept = [checkpoints.verify(p)["iteration"] for p in sorted((tmp_path / "checkpoints").iterdir())]
    assert kept == [2, 4, 5]
    assert checkpoints.verify(checkpoints.find_checkpoint(tmp_path))["iteration"] == 5
    assert checkpoints.verify(checkpoints.find_checkpoint(tmp_path, "best"))["score"] == 9.0


def test_the_best_holds_the_very_weights_that_were_judged(tmp_path: Path) -> None:
    """Evaluations and regular checkpoints fall on other iterations; a score must not stick to later weights."""
    run = make_run(tmp_path, iterations=8, checkpoint_every=2, keep_last=2, evaluate_every=3)
    judged = {}

    def evaluate(iteration: int) -> dict[str, float]:
        judged[iteration] = {key: value.clone() for key, value in run.ppo.actor.state_dict().items()}
        return {"score": {3: 9.0, 6: 1.0}[iteration]}

    train(run, [], evaluate)
    best = checkpoints.find_checkpoint(tmp_path, "best")
    assert checkpoints.verify(best)["iteration"] == 3
    again = make_run(tmp_path / "again")
    again.restore(best)
    assert_equal_trees(judged[3], dict(again.ppo.actor.state_dict()), "actor")
    scores = [checkpoints.verify(p)["score"] for p in sorted((tmp_path / "checkpoints").iterdir())]
    assert scores == [9.0, 1.0, checkpoints.NOT_JUDGED]  # of iterations 3, 6 and 8


def test_a_failing_save_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make_run(tmp_path, iterations=1)
    path = train(run, []).checkpoint

    def full(folder: Path) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "seal", full)
        run.counters.frames += 1
        with pytest.raises(checkpoints.SaveFailed, match="cannot be written: no space"):
            run.save()
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    checkpoints.verify(path)


def test_torchrl_reads_it(saved: tuple[Run, Path]) -> None:
    payload = load_checkpoint(saved[1])
    weights = infer_state_dict(payload)
    for key, value in saved[0].ppo.actor.state_dict().items():
        assert torch.equal(weights[key], value)
    assert payload["frames"] == saved[0].counters.frames
    assert payload["config"] == CONFIG


def test_every_file_is_hashed_once_however_often_it_is_looked_at(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted: Counter[str] = Counter()
    original = hashlib.file_digest

    def counting(stream: Any, algorithm: str) -> Any:
        counted[stream.name] += os.fstat(stream.fileno()).st_size
        return original(stream, algorithm)

    monkeypatch.setattr(hashlib, "file_digest", counting)
    monkeypatch.setattr(file_digests, "_SETTLED_AFTER", -(10**12))  # the copy was made a moment ago
    files = [p for p in copy.rglob("*") if p.is_file() and p.name != CHECKSUMS]
    for _ in range(2):
        checkpoints.verify(copy)
        assert checkpoints.has_component(copy, "policy")
        assert checkpoints.read_json(copy, "config")["task"]["name"] == "toy"
        checkpoints.RunCheckpoint({}).restore(copy, set())
    assert counted == {str(file): file.stat().st_size for file in files}
    name = flip_a_byte(copy)
    with pytest.raises(InputError, match="does not match its checksum") as caught:
        checkpoints.read_json(copy, "config")
    assert caught.value.field == name
