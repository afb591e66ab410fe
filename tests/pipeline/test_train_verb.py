"""Configuration: found from anywhere, read with types, wrong values named; runs by command, resumed by command."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from helpers.train_command import (
    called,
    command,
    launcher,
    start,
)
from helpers.waiting import PATIENCE, wait_until
from omegaconf import OmegaConf

from egopose.checkpoint.checkpoint import find_checkpoint, read_json, verify
from egopose.checkpoint.resume import differences
from egopose.collection.collectors import CollectorSettings
from egopose.core.config import compose_config, convert, from_mapping, resolved, run_directory
from egopose.core.errors import InputError
from egopose.training.ppo import PPOSettings

__all__ = ["launcher"]  # a fixture


def composed(*overrides: str) -> dict[str, Any]:
    return compose_config("train", overrides)


@pytest.mark.parametrize(("algo", "gamma"), [("paper", 0.95), ("fast", 0.99)])
def test_algo_files_fill_the_settings(algo: str, gamma: float) -> None:
    values = composed(f"algo={algo}")["algo"]
    settings = PPOSettings.from_config({k: v for k, v in values.items() if k not in LOOP_KEYS})
    assert (settings.gamma, settings.lmbda, settings.clip_epsilon) == (gamma, 0.95, 0.2)


LOOP_KEYS = ("iterations", "steps_per_iteration", "critic_first")


def test_the_papers_numbers() -> None:
    algo = composed("experiment=paper")["algo"]
    expected = {
        "iterations": 3000,
        "steps_per_iteration": 50_000,
        "epochs": 10,
        "minibatch_size": None,
        "policy_lr": 5e-5,
        "value_lr": 3e-4,
        "policy_grad_norm": 40.0,
        "normalize_advantage": True,
        "entropy_coeff": 0.0,
    }
    assert {key: algo[key] for key in expected} == expected


@pytest.mark.parametrize("kind", ["sync", "multi_sync"])
def test_collector_files_fill_the_settings(kind: str) -> None:
    assert CollectorSettings.from_config(composed(f"collector={kind}")["collector"]).kind == kind


@dataclass(frozen=True)
class Example:
    count: int
    rate: float
    name: str = "x"
    sizes: tuple[int, ...] = ()
    limit: float | None = None


@pytest.mark.parametrize(
    ("values", "field", "cause"),
    [
        ({"rate": 1.0}, "count", "missing"),
        ({"count": 1, "rate": 1.0, "rat": 2}, "rat", "not a setting"),
        ({"count": 1.5, "rate": 1.0}, "count", "must be int"),
        ({"count": True, "rate": 1.0}, "count", "must be int"),
        ({"count": 1, "rate": "high"}, "rate", "must be float"),
        ({"count": 1, "rate": True}, "rate", "must be float"),
        ({"count": 1, "rate": 1.0, "sizes": 3}, "sizes", "must be a list"),
        ({"count": 1, "rate": 1.0, "sizes": [1, "a"]}, "sizes", "must be int"),
        ({"count": 1, "rate": 1.0, "limit": "none"}, "limit", "must be float"),
        ({"count": None, "rate": 1.0}, "count", "must be int"),
    ],
)
def test_wrong_values_are_named(values: dict[str, Any], field: str, cause: str) -> None:
    with pytest.raises(InputError, match=cause) as caught:
        from_mapping(Example, values, "conf/example.yaml")
    assert caught.value.field == field
    assert caught.value.source == "conf/example.yaml"


def test_right_values_are_converted() -> None:
    assert from_mapping(Example, {"count": 2.0, "rate": 1, "sizes": [1, 2], "limit": 3}, "x") == Example(
        2, 1.0, "x", (1, 2), 3.0
    )
    assert convert([1, 2.5], tuple[float, float], "x", "y") == (1.0, 2.5)


@pytest.mark.parametrize("override", ["algo.gamm=0.9", "algo=unheard_of", "=="])
def test_unknown_overrides_are_refused(override: str) -> None:
    with pytest.raises(InputError):
        composed(override)


def test_missing_and_broken_values_are_named() -> None:
    with pytest.raises(InputError, match=r"a\.b"):
        resolved(OmegaConf.create({"a": {"b": "???"}}))
    with pytest.raises(InputError, match="nowhere"):
        resolved(OmegaConf.create({"a": "${nowhere}"}))


def test_a_new_run_directory_never_exists_already(tmp_path: Path) -> None:
    first = Path(run_directory(str(tmp_path), None))
    first.mkdir()
    second = Path(run_directory(str(tmp_path), None))
    assert not second.exists()
    assert run_directory(str(tmp_path), "runs/x") == "runs/x"


def test_differences_are_named() -> None:
    first = {"a": {"b": 1, "c": [1, 2]}, "d": None}
    assert differences(first, {"a": {"b": 2, "c": [1, 2]}, "e": 3}) == [("a.b", 1, 2), ("e", None, 3)]


@pytest.fixture(scope="module")
def finished(launcher: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three iterations, made from a directory that is not the checkout's."""
    cwd = tmp_path_factory.mktemp("elsewhere")
    code, out, err = command(launcher, cwd, "algo.iterations=3", "logger=csv")
    assert code == 0, err
    (folder,) = (cwd / "runs").iterdir()
    assert str(folder) in out
    return folder


def test_a_run_directory_holds_what_was_run(finished: Path) -> None:
    assert OmegaConf.load(finished / "config.yaml").algo.iterations == 3
    assert "torchrl" in json.loads((finished / "versions.json").read_text())
    assert set(json.loads((finished / "git.json").read_text())) == {"commit", "dirty"}
    assert len((finished / "curves.csv").read_text().splitlines()) == 4
    assert verify(find_checkpoint(finished))["iteration"] == 3


def test_resumed_by_command_with_more_iterations(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    code, out, err = called(tmp_path, f"resume={folder}", "algo.iterations=5")
    assert code == 0, err
    assert "after iteration 3" in out
    assert len((folder / "curves.csv").read_text().splitlines()) == 6
    assert read_json(find_checkpoint(folder), "config")["algo"]["iterations"] == 5


def test_what_a_run_keeps_cannot_be_changed(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    code, _, err = called(tmp_path, f"resume={folder}", "algo.gamma=0.9")
    assert code == 2
    assert "algo.gamma" in err
    assert len(err.splitlines()) == 1


def test_what_a_run_keeps_cannot_be_changed_in_its_file(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    config = OmegaConf.load(folder / "config.yaml")
    config.algo.gamma = 0.5
    OmegaConf.save(config, folder / "config.yaml")
    code, _, err = called(tmp_path, f"resume={folder}")
    assert (code, "algo.gamma" in err) == (2, True)


def test_an_unknown_run_is_refused_and_not_made(tmp_path: Path) -> None:
    code, _, err = called(tmp_path, "resume=nowhere")
    assert code == 2
    assert err.strip() == "error: nowhere: resume: no such folder"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signals_save_and_tell_how_to_go_on(number: int, launcher: Path, tmp_path: Path) -> None:
    process = start(launcher, tmp_path, "algo.iterations=100000", "logger=csv")
    curves: list[Path] = []

    def two_iterations() -> bool:
        curves[:] = (tmp_path / "runs").glob("*/curves.csv")
        return bool(curves) and len(curves[0].read_text().splitlines()) > 2

    wait_until(two_iterations, "two iterations stand in the curves")
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    folder = curves[0].parent
    assert f"python -m egopose.train resume={folder}" in out
    assert verify(find_checkpoint(folder))["iteration"] >= 2


@pytest.mark.slow
def test_multirun(tmp_path: Path) -> None:
    code, _, err = called(tmp_path, "--multirun", "algo.iterations=1", "logger=csv", "seed=0,1")
    assert code == 0, err
    (sweep,) = (tmp_path / "runs" / "sweeps").iterdir()
    seeds = [read_json(find_checkpoint(sweep / job), "config")["seed"] for job in ("0", "1")]
    assert seeds == [0, 1]
