"""What tests, experiments and docs import of the package is there: most of them run seldom."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
USERS = sorted(
    path.relative_to(ROOT) for part in ("tests", "experiments", "docs") for path in (ROOT / part).rglob("*.py")
)


def imported(path: Path) -> list[tuple[str, str]]:
    """``(module, name)`` of everything that is imported from the package, wherever in the file."""
    nodes = ast.walk(ast.parse((ROOT / path).read_text()))
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("egopose")]
    return [(str(node.module), alias.name) for node in froms for alias in node.names]


@pytest.mark.parametrize("path", USERS, ids=str)
def test_names_are_there(path: Path) -> None:
    for module, name in imported(path):
        if not hasattr(importlib.import_module(module), name):
            importlib.import_module(f"{module}.{name}")
