"""The docs build without a warning, the notebook runs, and the pages say of the command what is so."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from egopose.__main__ import VERBS
from egopose.core.completion import candidates

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs" / "notebooks" / "first_look.ipynb"


def test_the_site_is_built_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {path.relative_to(tmp_path / "site").as_posix(): path.read_text() for path in tmp_path.rglob("*.html")}
    assert {"index.html", "own-data.html", "commands.html", "api/motion.html", "notebooks/first_look.html"} <= set(
        pages
    )
    for name, text in pages.items():
        fetched = re.findall(r'<(?:script|img|link rel="stylesheet")[^>]*(?:src|href)="?(https?://[^" >]+)', text)
        assert not fetched, (name, fetched)
    # From a docstring: arguments with shapes and units.
    assert "egopose.motion.motion.Motion" in pages["api/motion.html"]
    assert all(f"<code>{verb}</code>" in pages["commands.html"] for verb in VERBS)


def test_the_notebook_runs() -> None:
    notebook = nbformat.read(NOTEBOOK, 4)
    shown = [c for c in notebook.cells if any("image/png" in o.get("data", {}) for o in c.get("outputs", []))]
    assert len(shown) == 1, "the notebook is kept with its outputs: they stand on its page"
    NotebookClient(notebook, timeout=1800, startup_timeout=600, kernel_name="python3").execute()
    printed = "".join(o.get("text", "") for c in notebook.cells for o in c.get("outputs", []))
    assert "passed" in printed


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("*.md")), ids=lambda p: p.name)
def test_commands_in_the_docs_name_verbs_that_are_there(path: Path) -> None:
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text(), re.DOTALL)
    used = {verb for block in blocks for verb in re.findall(r"^egopose ([a-z]+)", block, re.MULTILINE)}
    assert used <= set(VERBS)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("egopose tr", {"train"}),
        ("egopose train sim=", {"sim=fast", "sim=paper"}),
        ("egopose train training.max", {"training.max_seconds="}),
        ("egopose sync vi", {"video=", "vision=", "vision."}),
        ("egopose sync video=", set()),
        ("egopose sync data.camera.field", {"data.camera.field_of_view="}),
        ("egopose train vision.camera.sh", {"vision.camera.shake=", "vision.camera.shake_time="}),
        ("egopose completion b", {"bash"}),
        ("egopose view --of", {"--offset"}),
        ("egopose view walk.b", set()),
        ("egopose bench so", set()),
        ("egopose bench st", {"stream"}),
        ("egopose bench stream --js", {"--json"}),
        ("egopose demo bu", {"budget="}),
        ("egopose export t", {"to=", "take="}),
        ("egopose nothing x", set()),
    ],
)
def test_the_shell_completes(line: str, expected: set[str]) -> None:
    assert set(candidates(line, list(VERBS))) == expected


def test_bash_takes_the_script(tmp_path: Path) -> None:
    script = (
        f'PATH="{Path(sys.executable).parent}:$PATH"; eval "$(egopose completion bash)"; '
        'COMP_LINE="egopose train sim="; COMP_POINT=${#COMP_LINE}; compopt() { :; }; _egopose; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["fast", "paper"]
