"""Settings are explained where they stand, and the docs tell of every verb's, with the values that are there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
import yaml

from egopose.core.verbs import VERBS
from egopose.envs.mdp import scene_rewards
from egopose.envs.mdp.rewards import TERMS

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
DOCS = "\n".join(path.read_text() for path in sorted((ROOT / "docs").glob("*.md")))
#: Hydra's own, the same in every file.
HYDRAS = {"defaults", "hydra"}


def unexplained(text: str) -> list[str]:
    """Setting lines without a comment on them, above them, or on the line of a parent or of the file's head."""
    head = text.lstrip().startswith("#")
    explained: list[tuple[int, bool]] = []
    above, out = False, []
    for line in text.splitlines():
        bare = line.strip()
        if not bare or bare.startswith("#"):
            above = bare.startswith("#")
            continue
        depth = len(line) - len(line.lstrip())
        explained = [(d, e) for d, e in explained if d < depth]
        here = above or " #" in line or any(e for _, e in explained)
        above = False
        key = re.match(r"([\w/@.]+):", bare)
        if key is None or (depth == 0 and key[1] in HYDRAS) or any(not e and d == -1 for d, e in explained):
            continue
        if not bare.endswith(":") and not here and not head:
            out.append(bare)
        explained.append((depth, here))
    return out


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda p: p.relative_to(CONF).as_posix())
def test_every_setting_has_a_comment_or_a_parent_that_has(path: Path) -> None:
    assert unexplained(path.read_text()) == []


def test_a_setting_without_a_word_is_found() -> None:
    assert unexplained("a: 1  # s\nb: 2\nc:  # both\n  d: 3\ne:\n  f: 4\n  # of it\n  g: 5\n") == ["b: 2", "f: 4"]


@pytest.mark.parametrize("verb", sorted(path.stem for path in CONF.glob("*.yaml") if path.stem in VERBS))
def test_the_docs_tell_of_a_verbs_settings(verb: str) -> None:
    settings = set(yaml.safe_load((CONF / f"{verb}.yaml").read_text())) - HYDRAS
    missing = [name for name in sorted(settings) if not re.search(rf"(?<![\w.]){re.escape(name)}\b", DOCS)]
    assert missing == []


def test_the_docs_tell_of_every_choice_of_trainings_groups() -> None:
    table = (ROOT / "docs" / "howto-train.md").read_text()
    groups = dict(re.findall(r"^\| `(\w+)` \| ([^|]*) \|", table, re.MULTILINE))
    for group in ("task", "sim", "reward", "vision", "model", "algo", "collector", "logger", "regressor", "experiment"):
        there = {path.stem for path in (CONF / group).glob("*.yaml")}
        told = set(re.findall(r"`(\w+)`", groups[group]))
        assert told == there, group


def test_the_docs_tell_of_every_reward_term() -> None:
    page = (ROOT / "docs" / "howto-train.md").read_text()
    table = page.partition("| term | compares")[2].partition("\n\n")[0]
    assert scene_rewards.clip_pose is TERMS["clip_pose"].function
    own = {name for name, term in TERMS.items() if term.function.__module__.startswith("egopose.")}
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == own


def test_rates_in_the_docs_are_the_configurations() -> None:
    rates = [yaml.safe_load((CONF / "sim" / f"{name}.yaml").read_text()) for name in ("fast", "paper")]
    fast, paper = (round(rate["control_hz"] * rate["substeps"]) for rate in rates)
    assert f"| `sim` | `fast`, `paper` | {fast} or {paper} Hz physics |" in DOCS
    told = re.findall(r"(\d+) Hz[^.|\n]{0,20}\(`sim=(fast|paper)`|`sim=(fast|paper)`[^.|\n]{0,20}?(\d+) Hz", DOCS)
    assert told
    for before, first, second, after in told:
        assert int(before or after) == {"fast": fast, "paper": paper}[first or second]


def test_the_pages_of_the_api_are_of_modules_that_are_there() -> None:
    hooks = (ROOT / "docs" / "hooks.py").read_text()
    rooms = ast.literal_eval(re.search(r"^API = (\{.*?^\})", hooks, re.MULTILINE | re.DOTALL)[1])  # type: ignore[index]
    for room, modules in rooms.items():
        for module in modules.split():
            place = ROOT / "src" / "egopose" / room / module.replace(".", "/")
            assert place.with_suffix(".py").is_file() or place.is_dir(), f"{room}.{module}"
