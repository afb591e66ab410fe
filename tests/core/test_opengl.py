"""What draws nothing needs no OpenGL; what draws says in one line what to install."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="back ends are tried by the names of Linux' libraries")

DRAWS = """
import sys
from egopose.core.errors import InputError
from egopose.vision.gl import open_context
try:
    open_context(32, 32).free()
except InputError as error:
    print(f"error: {error}", file=sys.stderr)
    raise SystemExit(2)
"""
#: Everything that binds a back end at import, in the order of a start.
IMPORTS = "import egopose.humanoid.model, egopose.envs.dm_control_task, mujoco, dm_control.mujoco"


def hidden(folder: Path) -> Path:
    """A folder that stands before the system's: in it the libraries of OpenGL are files of text."""
    for name in ("OSMesa", "EGL", "GL"):
        for ending in ("", *(f".{number}" for number in range(10))):
            (folder / f"lib{name}.so{ending}").write_text("no library")
    return folder


def started(program: str, folder: Path | None, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "EGOPOSE_GL")}
    if folder is not None:
        kept["LD_LIBRARY_PATH"] = str(hidden(folder))
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env={**kept, **environment}, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("backend", ["osmesa", "egl", "glfw", "", "OSMesa "])
def test_imports_need_no_opengl(backend: str, tmp_path: Path) -> None:
    done = started(IMPORTS, tmp_path, MUJOCO_GL=backend, PYTHONWARNINGS="error::UserWarning")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("backend", "told"), [("osmesa", "apt-get install libosmesa6"), ("egl", "apt-get install libegl1")]
)
def test_what_draws_says_in_one_line_what_to_install(backend: str, told: str, tmp_path: Path) -> None:
    done = started(DRAWS, tmp_path, MUJOCO_GL=backend)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: MUJOCO_GL: {backend}: fails")
    assert told in line


def test_a_verb_that_draws_nothing_runs_without_the_library_it_was_told_of(tmp_path: Path) -> None:
    clip = next(Path(str(files("egopose") / "assets" / "clips")).glob("*.motion.npz"))
    words = ["egopose", "export", str(clip), f"to={tmp_path / 'clip.bvh'}"]
    program = f"import sys; from egopose.__main__ import main; sys.argv = {words!r}; main()"
    done = started(program, tmp_path, MUJOCO_GL="osmesa")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "clip.bvh").read_text().startswith("HIERARCHY")


def test_a_start_without_a_display_is_silent() -> None:
    done = started(IMPORTS, None, PYTHONWARNINGS="always")
    assert "glfw" not in done.stderr.lower()
    assert "DISPLAY" not in done.stderr


def test_a_back_end_that_is_there_is_left_to_mujoco_and_dm_control() -> None:
    program = f"{IMPORTS}; import os; print(os.environ.get('MUJOCO_GL'))"
    done = started(program, None, MUJOCO_GL="off")
    assert (done.returncode, done.stdout) == (0, "off\n"), done.stderr


def test_a_child_draws_by_what_its_parent_was_asked_for(tmp_path: Path) -> None:
    program = f"import egopose, subprocess, sys; subprocess.run([sys.executable, '-c', {DRAWS!r}])"
    done = started(program, tmp_path, MUJOCO_GL="osmesa")
    assert "error: MUJOCO_GL: osmesa: fails" in done.stderr
