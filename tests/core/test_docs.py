"""The docs build without a warning, the notebook runs, and the pages are true and plain."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
import yaml
from nbclient import NotebookClient

from egopose.__main__ import VERBS
from egopose.core.completion import candidates

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs" / "notebooks" / "first_look.ipynb"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Most words of a sentence in README and docs.
LONGEST = 40
#: Words that the field has other names for: (pattern, the name).
PRIVATE_WORDS = (
    (r"limb finders?|finders? of limbs", "body-part estimator"),
    (r"lanes?", "env_groups"),
    (r"deferrals?", "lazy rewards"),
    (r"ghosts?", "overlay"),
    (r"kappa", "reset_threshold"),
    (r"rescue[sd]?", "recovery rounds"),
    (r"sinking", "height_drop"),
    (r"what is followed|what it follows|what they follow", "the reference, or the target motion"),
    (r"experience_figures|prefer_quick_products", "batch_metrics, enable_onednn_matmul"),
    (r"weights:\w+", "pretrained:NAME"),
    (r"egopose[. ](ship|limbs|kappa|sight)", "package, train --config-name body_parts, threshold_search"),
    (r"training aids?|evaluate_async|multi_async", "nothing: it was removed"),
    (r"ways to go on", "candidates"),
)
#: Where such a word is right: old names that are read, and the paper's own symbol beside its equation.
EXCEPTIONS = {
    "src/egopose/core/former_names.py": r".*",
    "src/egopose/core/verbs.py": r".*FORMER.*",
    "src/egopose/training/body_parts.py": r".*metadata_of.*",  # the task that saved estimators name
    "src/egopose/checkpoint/pretrained.py": r".*weights:.*",
    "src/egopose/inference/failsafe.py": r".*kappa.*",
    "docs/howto-evaluate.md": r".*kappa = 1 - gamma.*",
}


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


def sentences(text: str) -> list[str]:
    """The sentences of a Markdown page, without code blocks, tables, headings and addresses of links."""
    text = re.sub(r"```.*?```|<!--.*?-->", "\n\n", text, flags=re.DOTALL)
    lines = []
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith(("|", "#")):
            line = ""
        item = re.sub(r"^([-*]|\d+\.) ", "", line)
        lines += ["", item] if item != line else [line]
    paragraphs = re.split(r"\n\s*\n", "\n".join(lines))
    plain = [re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(paragraph.split())) for paragraph in paragraphs]
    return [sentence for paragraph in plain for sentence in re.split(r"(?<=[.!?])[*)`\"]*\s+", paragraph) if sentence]


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)
def test_sentences_are_short(path: Path) -> None:
    long = [(len(s.split()), s) for s in sentences(path.read_text()) if len(s.split()) > LONGEST]
    assert not long, f"over {LONGEST} words: {long}"


def test_a_long_sentence_is_found_and_what_is_no_prose_is_not() -> None:
    word = "word " * LONGEST
    page = f"# {word}more\n\n```\n{word}more\n```\n| {word}more |\n- {word.strip()}.\n- one more\n\n[a](x.md) {word}b."
    assert [len(s.split()) for s in sentences(page) if len(s.split()) > LONGEST] == [LONGEST + 2]


def private_words(text: str, allowed: str = r"(?!)") -> list[str]:
    """Lines that hold a private word, each with the name to use."""
    return [
        f"{number}: {found[0]!r} -> {name}"
        for number, line in enumerate(text.splitlines(), 1)
        for pattern, name in PRIVATE_WORDS
        if (found := re.search(rf"(?<![\w.])({pattern})(?!\w)", line, re.IGNORECASE)) and not re.match(allowed, line)
    ]


@pytest.mark.parametrize("folder", ["README.md", "docs", "conf", "src"])
def test_no_private_word_comes_back(folder: str) -> None:
    place, faults = ROOT / folder, []
    paths = [place] if place.is_file() else [p for p in sorted(place.rglob("*")) if p.suffix in (".md", ".py", ".yaml")]
    for path in paths:
        name = path.relative_to(ROOT).as_posix()
        faults += [f"{name}:{fault}" for fault in private_words(path.read_text(), EXCEPTIONS.get(name, r"(?!)"))]
    assert not faults, "\n".join(faults)


def test_a_private_word_is_found() -> None:
    assert private_words("a limb finder\nplain\ntwo Lanes") == [
        "1: 'limb finder' -> body-part estimator",
        "3: 'Lanes' -> env_groups",
    ]


def exists(dotted: str) -> bool:
    """Whether ``egopose.a.b.C`` can be imported, as module or attribute."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for name in parts[end:]:
            if not hasattr(found, name):
                return False
            found = getattr(found, name)
        return True
    return False


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)
def test_modules_and_files_in_the_docs_are_there(path: Path) -> None:
    text = path.read_text()
    imports = [
        f"{module}.{name.strip()}"
        for module, names in re.findall(r"^from (egopose[\w.]*) import (.*)$", text, re.MULTILINE)
        for name in names.split(",")
    ]
    named = set(imports) | set(re.findall(r"(?<![\w/])egopose(?:\.\w+)+", text))
    assert [name for name in sorted(named) if not exists(name)] == []
    files = set(re.findall(r"(?<![\w/.-])(?:tests|src|conf|scripts)/[\w/.-]*\w", text))
    assert [name for name in sorted(files) if not (ROOT / name).exists()] == []


def test_a_module_that_is_not_there_is_found() -> None:
    assert exists("egopose.motion.motion.Motion")
    assert not exists("egopose.motion.motion.Film")
    assert not exists("egopose.nowhere")


def settings_of(verb: str) -> set[str]:
    """Dotted settings of a verb's file and of all groups, with the mappings above them."""
    paths = [(ROOT / "conf" / f"{verb}.yaml", "")]
    paths += [(path, path.parent.name) for path in (ROOT / "conf").glob("*/*.yaml")]
    out = {path.parent.name for path, _ in paths[1:]}
    for path, group in paths:
        text = path.read_text()
        heads = [""] if "@package _global_" in text or not group else [f"{group}."]
        heads += [f"data.{group}."] if group in ("camera", "reader") else []  # conf/data mounts these
        todo = [(head, yaml.safe_load(text) or {}) for head in heads]
        while todo:
            head, values = todo.pop()
            out |= {f"{head}{key}" for key in values}
            todo += [(f"{head}{key}.", value) for key, value in values.items() if isinstance(value, dict)]
    return out


def unknown_settings(text: str) -> list[str]:
    """``VERB key`` of the settings in a page's commands that the verb does not have."""
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL)).replace("\\\n", " ")
    out = []
    for verb, rest in re.findall(r"^ *(?:\w+=\S+ )*(?:egopose |python -m egopose\.)(\w+)(.*)$", blocks, re.MULTILINE):
        named = re.search(r"--config-name (\w+)", rest)
        name = named[1] if named else verb
        if not (ROOT / "conf" / f"{name}.yaml").is_file():
            continue
        words = re.sub(r"'[^']*'|\"[^\"]*\"", lambda m: m[0].strip("'\"").replace(" ", ""), rest.partition(" #")[0])
        keys = [
            key for key in re.findall(r"(?<=\s)([a-z_][\w.]*)=", words) if not key.startswith(("hydra.", "options."))
        ]
        # `to` of export stands in no file.
        out += [f"{verb} {key}" for key in keys if key not in settings_of(name) | {"to"}]
    return out


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)
def test_settings_in_the_commands_of_the_docs_are_there(path: Path) -> None:
    assert unknown_settings(path.read_text()) == []


def test_a_setting_that_is_not_there_is_found() -> None:
    page = "```bash\negopose train collector.worlds=3 seed=1  # x=1\nA=b egopose evaluate planner.knot=2 out=x\n```"
    assert unknown_settings(page) == ["train collector.worlds", "evaluate planner.knot"]


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)
def test_commands_in_the_docs_name_verbs_that_are_there(path: Path) -> None:
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text(), re.DOTALL)
    used = {verb for block in blocks for verb in re.findall(r"^ *egopose ([a-z]+)", block, re.MULTILINE)}
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
        ("egopose demo tr", {"train=", "training."}),
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
