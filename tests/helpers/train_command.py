"""The training command in a process of its own."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import textwrap
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from egopose.pipeline import training
from egopose.train import main
from egopose.training.loop import Run, interrupts_held
from helpers.toy_problem import make_run
from helpers.waiting import PATIENCE

TESTS = Path(__file__).parents[1]


# The command, on the toy problem: `pipeline` is replaced by one that builds it.
LAUNCHER = """
import sys
sys.path.insert(0, {tests!r})
from helpers.toy_problem import make_run
from egopose.pipeline import training
from egopose.training.loop import interrupts_held
def build_run(config, folder, dataset):
    with interrupts_held():
        return make_run(folder, seed=config["seed"], config=config, iterations=config["algo"]["iterations"],
                        checkpoint_every=config["training"]["checkpoint_every"],
                        max_seconds=config["training"]["max_seconds"],
                        collector={{name: config["collector"][name] for name in ("kind", "workers")}})
training.build_run = build_run
training.load_dataset = lambda config: None
training.run_dataset = lambda config, folder: None
training.build_evaluation = lambda run, dataset: None
from egopose.train import main
if __name__ == "__main__":
    main()
"""


def _toy_run(config: dict[str, Any], folder: Path, dataset: object) -> Run:
    settings = {"iterations": config["algo"]["iterations"], "max_seconds": config["training"]["max_seconds"]}
    settings["checkpoint_every"] = config["training"]["checkpoint_every"]
    with interrupts_held():
        return make_run(
            folder,
            seed=config["seed"],
            config=config,
            collector={name: config["collector"][name] for name in ("kind", "workers")},
            **settings,
        )


def called(cwd: Path, *words: str) -> tuple[int, str, str]:
    """The command of :data:`LAUNCHER` in this process, which spares the imports: exit code and what it printed."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.chdir(cwd)
        patch.setattr("sys.argv", ["egopose train", *words])
        patch.setattr(training, "build_run", _toy_run)
        for name in ("load_dataset", "run_dataset", "build_evaluation"):
            patch.setattr(training, name, lambda *_: None)
        try:
            main()
        except SystemExit as stopped:
            code = int(stopped.code or 0)
    return code, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def launcher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("launcher") / "launch.py"
    path.write_text(textwrap.dedent(LAUNCHER.format(tests=str(TESTS))))
    return path


def start(launcher: Path, cwd: Path, *words: str, **how: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(launcher), *words],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        **how,
    )


def command(launcher: Path, cwd: Path, *words: str) -> tuple[int, str, str]:
    process = start(launcher, cwd, *words)
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err
