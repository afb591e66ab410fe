"""Weights given away: a run's estimates to the bit, nothing of its machine, refused when damaged, in the wheel."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hatchling.builders.wheel import WheelBuilder
from torchrl.checkpoint import Checkpoint

from egopose.checkpoint import pretrained as weights
from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.checkpoint.checksums import seal
from egopose.checkpoint.package import package_run
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.evaluation.options import data_at, output_folder
from egopose.evaluation.package_figures import describe_run
from egopose.inference.video import estimate_video
from egopose.inference.video_regression import seen_in, video_dataset
from egopose.pipeline.agent import _other_store
from egopose.pipeline.regressor import load_regressor
from egopose.pipeline.run import build_run
from egopose.vision.video import write_video

ROOT = Path(__file__).resolve().parents[2]
NAME = "people_estimation"
LARGEST = 42e6  # bytes of all that ships: policies 17, networks of pictures and keypoints 12, BlazePose 9.4, clips 2.7


def settings(run: Path, out: Path, **changed: Any) -> dict[str, Any]:
    return {**compose_config("package", [f"run={run}", "name=mine"]), "out": str(out), **changed}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that training keeps: the shipped regressor, an untrained policy, optimisers, paths of this machine."""
    folder = tmp_path_factory.mktemp("run")
    config = read_json(find_checkpoint(f"{weights.PREFIX}{NAME}"), "config")
    config["data"] = {**config["data"], "folder": str(folder), "store": str(folder / "store")}
    config["output"] = str(folder)
    config["collector"] |= {"num_envs": 2, "env_groups": 1, "physics_threads": 1}
    config["algo"] |= {"steps_per_iteration": 16, "minibatch_size": 16}
    regressor, source_config = load_regressor(weights.FOLDER / NAME / "regressor")
    flow = np.zeros((210, 2, 32, 32), np.float16)
    dataset, _ = video_dataset(
        humanoid_of(config), seen_in(humanoid_of(config), regressor, flow, source_config), "none"
    )
    seen_by = replace(dataset, regressor=weights.FOLDER / NAME / "regressor")
    made = build_run(config, folder, seen_by)
    made.save()
    made.collector.shutdown()
    return folder


@pytest.fixture(scope="module")
def shipped(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return package_run(settings(run, tmp_path_factory.mktemp("shipped") / "mine"), describe_run)


def test_only_what_using_them_takes_is_shipped(run: Path, shipped: Path) -> None:
    manifest = Checkpoint.manifest(find_checkpoint(shipped))
    assert set(manifest["components"]) == {"policy", "critic", "transforms", "config"}
    assert "policy_optimizer" in Checkpoint.manifest(find_checkpoint(run))["components"]
    for path in shipped.rglob("*"):
        assert not path.is_file() or str(run).encode() not in path.read_bytes(), path
    config = read_json(find_checkpoint(shipped), "config")
    assert config["data"]["folder"] is None
    assert config["model"] == read_json(find_checkpoint(run), "config")["model"]


def test_shipped_weights_estimate_as_their_run_to_the_bit(run: Path, shipped: Path, tmp_path: Path) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (96, 220, 3)).astype(np.uint8)
    video = tmp_path / "walk.mp4"
    write_video(video, [texture[:, 3 * t : 3 * t + 128] for t in range(24)], 30.0)
    found = []
    for folder in (run, shipped):
        values = compose_config("estimate", [f"video={video}", f"checkpoint={folder}", "which=latest", "size=64"])
        out = estimate_video({**values, "out": str(tmp_path / folder.name)})
        with np.load(out / "estimate.npz", allow_pickle=False) as clip:
            found.append({key: clip[key] for key in clip.files})
        found[-1]["frames"] = np.frombuffer((out / "frames.csv").read_bytes(), np.uint8)
    assert found[0].keys() == found[1].keys()
    for key, value in found[0].items():
        assert value.tobytes() == found[1][key].tobytes(), key


@pytest.mark.parametrize("which", ["policy", "regressor", "weights.json", "added", "gone"])
def test_damage_is_refused_by_the_files_name(which: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    copy = shutil.copytree(ROOT / "src" / "egopose" / "weights" / NAME, tmp_path / NAME)
    path = {"added": copy / "more.json", "gone": copy / "figures.md", "weights.json": copy / "weights.json"}.get(which)
    if path is None:
        part = copy / "regressor" if which == "regressor" else copy / "checkpoints"
        path = max(part.rglob(f"*{which}/state/*.memmap"), key=lambda p: p.stat().st_size)
    if which == "gone":
        path.unlink()
    else:
        content = bytearray(path.read_bytes() if path.exists() else b"{}")
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(path.relative_to(copy).as_posix())):
        find_checkpoint(f"{weights.PREFIX}{NAME}")


@pytest.mark.parametrize(
    ("name", "said"), [("people_estimaton", "did you mean pretrained:people"), ("x", f"there are .*{NAME}")]
)
def test_a_wrong_name_is_told_the_right_ones(name: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        find_checkpoint(f"{weights.PREFIX}{name}")


def test_the_former_prefix_is_still_read() -> None:
    assert find_checkpoint(f"weights:{NAME}") == find_checkpoint(f"pretrained:{NAME}")
    assert weights.is_pretrained(f"weights:{NAME}")
    assert weights.is_pretrained(f"pretrained:{NAME}")
    assert not weights.is_pretrained(f"runs/pretrained:{NAME}")
    assert data_at("/data", f"weights:{NAME}", "best") == data_at("/data", f"pretrained:{NAME}", "best")
    with pytest.raises(InputError, match=r"weights:people_estimaton.*did you mean pretrained:people_estimation"):
        find_checkpoint("weights:people_estimaton")


def test_a_path_that_was_overlooked_is_refused(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    made = find_checkpoint(copy)
    value = made / Checkpoint.manifest(made)["components"]["config"]["path"] / "value.json"
    config = json.loads(value.read_text())
    value.write_text(json.dumps({**config, "extra": {"file": "/home/me/secret"}}))
    seal(made)
    with pytest.raises(InputError, match="extra\\.file"):
        package_run(settings(copy, tmp_path / "out"), describe_run)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="name"):
        package_run(settings(run, tmp_path / "out", name="../up"), describe_run)


@pytest.mark.parametrize("group", ["bandai", "tennis", "people"])
def test_weights_of_data_whose_licence_forbids_it_are_not_packaged(group: str, run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "run")
    made = find_checkpoint(copy)
    value = made / Checkpoint.manifest(made)["components"]["config"]["path"] / "value.json"
    data = compose_config("prepare", [f"data={group}"])["data"]
    value.write_text(json.dumps({**json.loads(value.read_text()), "data": data}))
    seal(made)
    with pytest.raises(InputError, match=f"data.ship: the licence of the set {group} does not let weights"):
        package_run(settings(copy, tmp_path / "out"), describe_run)
    assert not (tmp_path / "out").exists()


def test_figures_are_means_with_intervals_and_the_first_is_divided(run: Path, tmp_path: Path) -> None:
    raws = {}
    for method, scale in (("ours", 1.0), ("PoseReg", 2.0)):
        raw = {"takes": ["a", "b"], "figures": {"E_pose": [scale, 3 * scale]}, "resets": [1, 0], "frames": [600, 300]}
        raws[method] = str(tmp_path / f"{method}.json")
        Path(raws[method]).write_text(json.dumps(raw))
    out = package_run(settings(run, tmp_path / "out", figures=raws), describe_run)
    about = json.loads((out / weights.ABOUT).read_text())
    assert about["figures"]["ours"]["E_pose"] == {"value": 2.0, "low": 1.0, "high": 3.0}
    assert about["figures"]["ours"]["resets_per_minute"] == pytest.approx(2.0)
    assert about["ratios"]["PoseReg"]["E_pose"]["value"] == 0.5
    assert (
        "| E_pose (rad) | 2.000 [1.000, 3.000] | 4.000 [2.000, 6.000] | 0.50 [0.50, 0.50] |"
        in (out / "figures.md").read_text()
    )


def test_results_of_shipped_weights_go_beside_the_user_and_data_may_lie_elsewhere(tmp_path: Path) -> None:
    name = f"{weights.PREFIX}{NAME}"
    assert output_folder(None, find_checkpoint(name), "test") == Path("evaluation") / NAME / "test"
    data = data_at(str(tmp_path), name, "best")["data"]
    assert data["folder"] == str(tmp_path)
    assert data["split"] == read_json(find_checkpoint(name), "config")["data"]["split"]
    assert not _other_store(
        read_json(find_checkpoint(name), "config"), {**read_json(find_checkpoint(name), "config"), "data": data}
    )


@pytest.mark.parametrize("name", weights.pretrained_names())
def test_what_ships_is_whole_small_and_on_its_card(name: str) -> None:
    folder = weights.pretrained_run(name)
    card = (ROOT / "docs" / "model-card.md").read_text()
    assert (weights.FOLDER / "MODEL_CARD.md").read_text() == card
    assert (folder / "figures.md").read_text() in card
    assert f"`{weights.PREFIX}{name}`" in card
    sizes = [path.stat().st_size for path in weights.FOLDER.rglob("*") if path.is_file()]
    assert sum(sizes) < LARGEST
    assert not list(weights.FOLDER.rglob("*.pkl")) + list(weights.FOLDER.rglob("*.pt"))
    regressor, _ = load_regressor(folder / "regressor")
    assert all(value.isfinite().all() for value in regressor.state_dict().values() if torch.is_floating_point(value))


def test_the_wheel_holds_them(tmp_path: Path) -> None:
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    found = set(zipfile.ZipFile(built).namelist())
    assert Path(built).stat().st_size < LARGEST
    wanted = {path for path in weights.FOLDER.rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {f"egopose/{path.relative_to(ROOT / 'src' / 'egopose').as_posix()}" for path in wanted} <= found


def test_git_ignores_none_of_them() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    files = [str(path) for path in weights.FOLDER.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    done = subprocess.run(["git", "check-ignore", *files], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == ""


def test_help_of_the_verb(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "egopose.package", f"run={tmp_path}", "name=mine"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "checkpoints: is missing" in done.stderr
