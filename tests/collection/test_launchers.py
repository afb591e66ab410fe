"""Sweeps by Hydra's launchers: joblib runs jobs here; Slurm's and Ray's configurations compose, and make launchers."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from egopose.core.config import register_resolvers
from egopose.core.config_files import config_dir

JOB = """
import json, os, pathlib, sys
import hydra
from hydra.core.hydra_config import HydraConfig
from egopose.core.config import config_dir, register_resolvers
register_resolvers()

@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="train")
def main(config):
    out = pathlib.Path(HydraConfig.get().runtime.output_dir)
    (out / "job.json").write_text(json.dumps([config.seed, config.collector.kind, os.getpid()]))
    return float(config.seed)

main()
"""


def sweep(folder: Path, launcher: str, *more: str) -> list[list]:
    """Two jobs of training's configuration that only write down what they were given."""
    (folder / "job.py").write_text(JOB)
    command = [sys.executable, "job.py", "--multirun", f"hydra/launcher={launcher}", "seed=1,2", *more]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 0, done.stderr
    return sorted(json.loads(path.read_text()) for path in folder.glob("runs/sweeps/*/*/job.json"))


def test_joblib_runs_a_sweep_in_processes_of_its_own(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs pip install 'egopose[sweep]'")
    jobs = sweep(tmp_path, "local", "collector=multi_sync")
    assert [job[:2] for job in jobs] == [[1, "multi_sync"], [2, "multi_sync"]]
    assert os.getpid() not in {job[2] for job in jobs}


@pytest.mark.parametrize(
    ("name", "package", "launcher"),
    [
        ("local", "hydra_joblib_launcher", "JoblibLauncher"),
        ("slurm", "hydra_submitit_launcher", "SlurmLauncher"),
        ("ray_cluster", "hydra_ray_launcher", "RayLauncher"),
    ],
)
def test_launchers_compose_with_training(name: str, package: str, launcher: str) -> None:
    register_resolvers()
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        config = compose("train", [f"hydra/launcher={name}", "collector.physics_threads=3"], return_hydra_config=True)
    chosen = config.hydra.launcher
    assert chosen._target_.startswith(f"hydra_plugins.{package}.")
    if name == "slurm":
        assert chosen.cpus_per_task == 3
    if name == "ray_cluster":
        assert chosen.ray.remote.num_cpus == 3
    if importlib.util.find_spec(f"hydra_plugins.{package}") is not None:
        plain = OmegaConf.create({key: value for key, value in chosen.items() if not str(value).startswith("${hydra")})
        assert type(instantiate(plain)).__name__ == launcher
