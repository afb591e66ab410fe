"""Files from strangers run nothing: no pickle is read, no class or function is looked up by a name in a file."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tensordict
import torch
from tensordict import TensorDict
from torchrl.checkpoint import GlobalRNGState

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of, read_json
from egopose.checkpoint.checksums import CHECKSUMS, _checksums
from egopose.core.config import check_arguments, compose_config
from egopose.core.errors import InputError
from egopose.core.safe_io import read_yaml
from egopose.core.safe_tensors import MAX_CHECKPOINT_BYTES, load_tensors
from egopose.data.store import TakeInfo, TakeStore
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Joint, Skeleton, hinges
from egopose.vision.video import read_frames, write_video

ROOT = Path(__file__).resolve().parents[2]
CASES = sorted((Path(__file__).parents[1] / "fuzz_cases").iterdir())


@pytest.fixture(scope="module")
def readers() -> ModuleType:
    """The readers as the fuzzer calls them."""
    spec = importlib.util.spec_from_file_location("fuzz_readers", ROOT / "experiments" / "fuzzing" / "readers.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz_readers"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_what_fuzzing_found_stays_mended(case: Path, readers: ModuleType, tmp_path: Path) -> None:
    reader = readers.READERS[case.name.split("-")[0]]
    path = tmp_path / f"m{reader.suffix}"
    shutil.copy(case, path)
    with pytest.raises(InputError) as caught:
        reader.read(path)
    assert len(str(caught.value)) < 400


@pytest.mark.slow
def test_the_fuzzer_runs_and_finds_nothing(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, str(ROOT / "experiments/fuzzing/fuzz.py"), "--runs", "4000"]
    subprocess.run([*command, "--output", str(tmp_path / "results.json")], check=True, timeout=300)
    assert json.loads((tmp_path / "results.json").read_text())["inputs"] == 4000


def test_the_source_reads_no_pickle() -> None:
    """But for the weights an installed package brings, by torch's reader of tensors alone.

    Benchmarks are left out: one times what workers would send each other, made by itself a line before.
    """
    forbidden = re.compile(
        r"pickle\.loads?\(|Unpickler|allow_pickle=True|torch\.load\(|joblib\.load|(?<![.\w])(eval|exec)\(|np\.load\("
        r"|numpy\.load|yaml\.(unsafe_|full_)?load\(|OmegaConf\.load\(|shelve|marshal|tensordict\.load\("
        r"|load_memmap\((?!.*allow_pickle=False)|instantiate\("
    )
    found = [
        (path.name, line.strip())
        for path in sorted((ROOT / "src").rglob("*.py"))
        if path.parent.name != "benchmarks"
        for line in path.read_text().splitlines()
        if forbidden.search(line)
    ]
    assert found == [("encoders.py", 'state = torch.load(file, weights_only=True, map_location="cpu")')]


SKELETON = Skeleton((Joint("root", -1, (0, 0, 0)), Joint("a", 0, (0, 0, 1), hinges("z"))))


def make_checkpoint(folder: Path) -> Path:
    torch.manual_seed(0)
    parts = {"policy": torch.nn.Linear(3, 2), "config": {"a": 1}, "rng": GlobalRNGState()}
    return RunCheckpoint(parts).save(folder, metadata=metadata_of("toy", 2, 1, 2, 0.5))


def make_store(folder: Path) -> TakeStore:
    clip = Motion(SKELETON, np.ones((4, 8)), 30.0)
    states = TensorDict({k: torch.zeros(4, 3) for k in ("qpos", "qvel", "xpos", "xquat", "com", "com_vel")}, [4])
    take = TakeInfo("a", "1", 0, 4, 1.0, "a.bvh", "videos/a.mp4", 0.0, True, ((0, 4),), 1.0)
    return TakeStore.create(folder, 30.0, "f", [take], [clip], states)


def test_every_loader_runs_where_no_pickle_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readers: ModuleType
) -> None:
    checkpoint, store = make_checkpoint(tmp_path / "checkpoint"), make_store(tmp_path / "store")
    store.write_table("t", {"x": torch.ones(4, 2)}, {"made": "here"})
    write_video(tmp_path / "a.mp4", [np.zeros((48, 64, 3), np.uint8)] * 3, 30.0)
    seeds = {name: reader.seeds() for name, reader in readers.READERS.items()}

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("a pickle is read")

    for name in ("load", "loads", "Unpickler", "_Unpickler", "_load", "_loads"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    policy = torch.nn.Linear(3, 2)
    assert RunCheckpoint({"policy": policy, "rng": GlobalRNGState()}).restore(checkpoint)["task"] == "toy"
    assert read_json(checkpoint, "config") == {"a": 1}
    opened = TakeStore.open(tmp_path / "store")
    assert len(opened.reference) == 4
    assert len(opened.clip(0)) == 4
    assert opened.table("t")["x"].shape == (4, 2)
    assert opened.table_card("t") == {"made": "here"}
    assert len(list(read_frames(tmp_path / "a.mp4"))) == 3
    assert compose_config("train")["seed"] == 0
    for name, reader in readers.READERS.items():
        for content in seeds[name]:
            path = tmp_path / f"m{reader.suffix}"
            path.write_bytes(content)
            reader.read(path)


class Boom:
    """Makes the folder it is given when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.marker),)


NON_TENSOR = "<class 'tensordict.tensorclass.NonTensorData'>"
NON_TENSOR_STACK = "<class 'tensordict.tensorclass.NonTensorStack'>"


def class_by_name(state: Path, marker: Path) -> None:
    """What ``TensorDict.load_memmap`` obeys: a class named in meta.json, its fields in a pickle beside it."""
    (state / "meta.json").write_text(json.dumps({"_type": NON_TENSOR}))
    (state / "other.pickle").write_bytes(pickle.dumps({"data": Boom(marker)}))


def stack_by_name(state: Path, marker: Path) -> None:
    (state / "meta.json").write_text(json.dumps({"_type": NON_TENSOR_STACK, "stack_dim": 0, "data": "pickle.pkl"}))
    (state / "pickle.pkl").write_bytes(pickle.dumps([Boom(marker)]))


def nested_class(state: Path, marker: Path) -> None:
    meta = json.loads((state / "meta.json").read_text())
    (state / "meta.json").write_text(json.dumps({**meta, "deep": {"type": "NonTensorData"}}))
    (state / "deep").mkdir()
    class_by_name(state / "deep", marker)


@pytest.mark.parametrize("harm", [class_by_name, stack_by_name, nested_class])
def test_a_folder_of_tensors_with_a_pickle(harm: Callable[[Path, Path], None], tmp_path: Path) -> None:
    folder, marker = tmp_path / "tensors", tmp_path / "ran"
    TensorDict({"a": torch.ones(3)}, []).memmap(folder)
    harm(folder, marker)
    with pytest.raises(InputError, match="is damaged"):
        load_tensors(folder, "tensors")
    assert not marker.exists()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:  # whether the library takes offence at what the pickle gave comes after it ran
            tensordict.load(folder)
        except Exception as error:
            print(error)
    assert marker.exists(), "the case is harmless: it proves nothing"


@pytest.mark.parametrize("harm", [class_by_name, stack_by_name, nested_class])
@pytest.mark.parametrize("place", ["reference", "tables/t"])
def test_a_store_with_a_pickle(harm: Callable[[Path, Path], None], place: str, tmp_path: Path) -> None:
    store, marker = make_store(tmp_path / "store"), tmp_path / "ran"
    store.write_table("t", {"x": torch.ones(4, 2)}, {})
    harm(store.root / place, marker)
    with pytest.raises(InputError, match="is damaged"):
        _ = store.reference if place == "reference" else store.table("t")
    assert not marker.exists()


def torch_pickle(state: Path, marker: Path) -> None:
    shutil.rmtree(state)
    torch.save({"weight": Boom(marker)}, state.parent / "state.pt")


def archive(state: Path, marker: Path) -> None:
    class_by_name(state, marker)
    shutil.make_archive(str(state.parent / "state"), "zip", state)
    shutil.rmtree(state)
    (state.parent / "state.zip").rename(state.parent / "state.tdz")


def link(state: Path, marker: Path) -> None:
    """A tensor that is a file elsewhere: mapped for writing it would be changed."""
    file = state / "tensor_00000000.memmap"
    file.rename(marker.parent / "elsewhere")
    file.symlink_to(marker.parent / "elsewhere")


def sparse(state: Path, marker: Path) -> None:
    with (state / "tensor_00000000.memmap").open("r+b") as stream:
        stream.truncate(MAX_CHECKPOINT_BYTES + 1)


def change_meta(**change: Any) -> Callable[[Path, Path], None]:
    def harm(state: Path, marker: Path) -> None:
        meta = json.loads((state / "meta.json").read_text())
        meta["tensor_00000000"] |= change
        (state / "meta.json").write_text(json.dumps(meta))

    return harm


def change_state(text: str) -> Callable[[Path, Path], None]:
    return lambda state, marker: (state.parent / "state.json").write_text(text) and None


def outside(state: Path, marker: Path) -> None:
    manifest = state.parents[2] / "manifest.json"
    content = json.loads(manifest.read_text())
    content["components"]["policy"]["path"] = "../../elsewhere"
    manifest.write_text(json.dumps(content))


HARMS: dict[str, Callable[[Path, Path], None]] = {
    "class by name": class_by_name,
    "stack by name": stack_by_name,
    "nested class": nested_class,
    "torch pickle": torch_pickle,
    "archive": archive,
    "link": link,
    "sparse file": sparse,
    "petabytes": change_meta(shape=[2**40, 2**10]),
    "overflow": change_meta(shape=[2**40] * 8),
    "negative": change_meta(shape=[-1, 3]),
    "nested": change_meta(is_nested=True),
    "type": change_meta(dtype="torch.classes"),
    "numpy objects": change_state('{"kind": "numpy", "key": "tensor_00000000", "dtype": "O"}'),
    "numpy gigabyte": change_state('{"kind": "numpy", "key": "tensor_00000000", "dtype": "V1000000000"}'),
    "numpy scalar": change_state('{"kind": "numpy_scalar", "dtype": "V4", "value": 2000000000}'),
    "path": change_state('{"kind": "path", "value": "/etc/passwd"}'),
    "deep": change_state('{"kind": "list", "items": [' * 50_000),
    "no state": change_state("[[[7]]]"),
    "outside": outside,
}


@pytest.mark.parametrize("name", HARMS)
def test_a_hostile_checkpoint(name: str, tmp_path: Path) -> None:
    """Its checksums are right: whoever meant it makes them so."""
    folder, marker = make_checkpoint(tmp_path / "checkpoint"), tmp_path / "ran"
    component = json.loads((folder / "manifest.json").read_text())["components"]["policy"]["path"]
    HARMS[name](folder / component / "state", marker)
    if name != "sparse file":
        (folder / CHECKSUMS).write_text(json.dumps(_checksums(folder)))
    policy = torch.nn.Linear(3, 2)
    before = policy.weight.detach().clone()
    with pytest.raises(InputError):
        RunCheckpoint({"policy": policy}).restore(folder)
    assert not marker.exists()
    assert torch.equal(policy.weight, before)


@pytest.mark.parametrize(
    "config",
    [
        {"model": {"hidden": [60_000, 60_000]}},
        {"model": {"hidden": [300] * 1000}},
        {"model": {"context": {"hidden_size": 1e9}}},
        {"vision": {"encoder": {"input_size": 512, "features": 2048, "channels": [64, 512]}}},
        {"vision": {"workers": 10**6}},
        {"vision": {"flow": {"working_size": float("nan")}}},
    ],
)
def test_a_checkpoint_that_asks_for_too_much(config: dict[str, Any], tmp_path: Path) -> None:
    RunCheckpoint({"config": config}).save(tmp_path / "c", metadata=metadata_of("toy", 2, 1, 2, 0.5))
    with pytest.raises(InputError, match=r"at most|too large"):
        read_json(tmp_path / "c", "config")


YAMLS = {
    "object": "a: !!python/object/apply:os.mkdir [MARKER]\n",
    "name": "a: !!python/name:os.system\n",
    "laughs": "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60)),
    "itself": "a: &a [*a]\n",
    "deep": "[" * 20_000,
    "deep mapping": "{a: " * 20_000,
    "big": "a: " + "x" * 2**19,
    "many": "[" + "1," * 100_000 + "]",
    "bytes": "a: \x07",
    "twice": "a: 1\na: 2\n",
    "interpolation": "a: ${oc.env:",
}


@pytest.mark.parametrize("name", YAMLS)
def test_a_hostile_yaml(name: str, tmp_path: Path) -> None:
    path, marker = tmp_path / "config.yaml", tmp_path / "ran"
    path.write_text(YAMLS[name].replace("MARKER", str(marker)))
    with pytest.raises(InputError, match=r"config\.yaml"):
        read_yaml(path, "config")
    assert not marker.exists()


def test_interpolations_of_a_file_stay_text(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("a: ${oc.env:HOME}\nb: ${oc.decode:1}\n")
    assert read_yaml(path, "config") == {"a": "${oc.env:HOME}", "b": "${oc.decode:1}"}


FOLDERS = {
    "callback": "# @package _global_\nhydra:\n  callbacks:\n    x: {_target_: os.mkdir, path: MARKER}\n",
    "packaged": "# @package hydra.callbacks.x\n_target_: os.mkdir\npath: MARKER\n",
    "dotted": "hydra.launcher._target_: os.mkdir\n",
    "logging": "# @package hydra.job_logging\nhandlers: {x: {(): os.mkdir, path: MARKER}}\n",
    "stream": "# @package hydra.job_logging\nhandlers: {x: {class: logging.StreamHandler, stream: ext://os.environ}}\n",
    "search path": "hydra: {searchpath: ['pkg://antigravity']}\n",
    "tag": "a: !!python/object/apply:os.mkdir [MARKER]\n",
}


@pytest.mark.parametrize("name", FOLDERS)
@pytest.mark.parametrize("option", ["--config-dir={}", "-cd={}", "hydra.searchpath=[file://{}]"])
def test_a_folder_of_configuration_calls_nothing(name: str, option: str, tmp_path: Path) -> None:
    folder = tmp_path / "theirs" / "experiment"
    folder.mkdir(parents=True)
    (folder / "x.yaml").write_text(FOLDERS[name].replace("MARKER", str(tmp_path / "ran")))
    with pytest.raises(InputError, match=r"x\.yaml"):
        check_arguments(["experiment=x", option.format(tmp_path / "theirs")])
    (folder / "x.yaml").write_text("# @package _global_\nseed: 7\n")
    check_arguments(["experiment=x", option.format(tmp_path / "theirs")])


def test_no_rerun_from_a_pickle(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pickle"):
        check_arguments(["--experimental-rerun", str(tmp_path / "config.pickle")])


def test_an_override_that_leads_nowhere_is_one_error() -> None:
    with pytest.raises(InputError):
        compose_config("train", ["seed=${no_such_resolver:import os}"])


def test_a_motion_of_objects_is_not_unpickled(tmp_path: Path) -> None:
    path, marker = tmp_path / "a.npz", tmp_path / "ran"
    np.savez(path, poses=np.array([Boom(marker)], dtype=object), trans=np.zeros((1, 3)))
    with pytest.raises(InputError, match="pickled objects"):
        read_motion(path)
    assert not marker.exists()
