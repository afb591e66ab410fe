"""The structure that docs/architecture.md draws, read off the imports: no circle, none going up, thin verbs."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import egopose
from egopose.core.verbs import VERBS

PACKAGE = Path(egopose.__file__).parent
#: From the ground up: a room imports itself and those before it.
ROOMS = (
    "core",
    "motion",
    "humanoid",
    "vision",
    "data",
    "models",
    "envs",
    "scene",
    "tasks",
    "collection",
    "checkpoint",
    "training",
    "pipeline",
    "inference",
    "evaluation",
    "viewer",
    "benchmarks",
)
#: Those at the top may not lean on each other.
APART = {("benchmarks", "viewer")}


def modules() -> dict[str, Path]:
    """Dotted name below ``egopose`` -> file."""
    return {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path != PACKAGE / "__init__.py"
    }


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that a file imports, wherever in it that stands."""
    out = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "egopose":
            module = node.module.removeprefix("egopose").removeprefix(".")
            for alias in node.names:
                below = f"{module}.{alias.name}" if module else alias.name
                out.add(below if below in known else module)
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith("egopose.")]
            out |= {name.removeprefix("egopose.") for name in names}
    return out - {""}


def room_of(module: str) -> str:
    return module.partition(".")[0]


def test_no_import_goes_up() -> None:
    known = modules()
    up = []
    for module, path in known.items():
        room = room_of(module)
        rank = ROOMS.index(room) if room in ROOMS else len(ROOMS)
        for other in imported(path, known):
            above = ROOMS.index(room_of(other)) if room_of(other) in ROOMS else len(ROOMS)
            if above > rank or (room, room_of(other)) in APART:
                up.append(f"{module} -> {other}")
    assert not up, "\n".join(up)


def test_the_page_lists_the_rooms_in_order() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "architecture.md").read_text(encoding="utf8")
    rows = re.findall(r"^\| (`[^|]*`) \|", page.partition("| room |")[2].partition("\n\n")[0], re.MULTILINE)
    told = [room for row in rows for room in re.findall(r"`(\w+)`", row)]
    assert told == list(ROOMS)
    assert len(page.splitlines()) <= 80


def test_no_import_circle() -> None:
    known = modules()
    edges = {module: imported(path, known) & set(known) for module, path in known.items()}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join([*trail[trail.index(module) :], module])
        if module not in done:
            for other in sorted(edges[module]):
                visit(other, (*trail, module))
            done.add(module)

    for module in known:
        visit(module, ())


def test_a_verb_reads_arguments_makes_a_call_and_prints() -> None:
    """At the top level lie the verbs and nothing else, 80 lines at most each."""
    verbs = {path.stem: len(path.read_text(encoding="utf8").splitlines()) for path in PACKAGE.glob("*.py")}
    assert set(verbs) - {"__init__", "__main__"} == set(VERBS) - {"completion"}
    assert {verb: lines for verb, lines in verbs.items() if lines > 80} == {}


def test_imports_inside_functions_are_of_optional_packages() -> None:
    """Imports stand at the head of a file; only a verb may wait with its library."""
    inside = []
    for module, path in modules().items():
        for function in ast.walk(ast.parse(path.read_text(encoding="utf8"))):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for node in ast.walk(function):
                if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "egopose":
                    inside.append(f"{module}:{node.lineno} {node.module}")
    # A verb waits with its library; the viewer tells of a missing viser before it imports what needs it.
    allowed = {line for line in inside if "." not in line.partition(":")[0] or line.startswith("viewer.session:")}
    assert not set(inside) - allowed, "\n".join(sorted(set(inside) - allowed))
