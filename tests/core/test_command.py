"""The one command and its verbs."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys

import pytest

from egopose.__main__ import VERBS, main
from egopose.core.config import compose_config
from egopose.core.errors import InputError


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["egopose", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code or 0)


def test_the_version_is_told(monkeypatch, capsys) -> None:
    assert call(monkeypatch, "--version") == 0
    assert re.fullmatch(r"egopose \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_help_lists_every_verb(monkeypatch, capsys) -> None:
    assert call(monkeypatch, "--help") == 0
    shown = capsys.readouterr().out
    assert all(verb in shown for verb in VERBS)
    assert call(monkeypatch) == 2


def test_an_unknown_verb_is_named(monkeypatch, capsys) -> None:
    assert call(monkeypatch, "fly") == 2
    assert "'fly'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("training.max_second=3", "training.max_second: is not a setting; did you mean training.max_seconds?"),
        ("walks.count=3", "walks.count: is not a setting; the file lists them"),
        ("sim=fats", "sim: there is no 'fats'; there are fast, paper"),
        ("walk.bvh", "walk.bvh: cannot be read: settings are given as key=value"),
    ],
)
def test_a_slip_in_a_setting_is_told_with_what_there_is(override: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        compose_config("train", [override])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["train", "training.max_second=3"], "did you mean training.max_seconds?"),
        (["package", "name=mine"], "run: is missing; give run=..."),
    ],
)
def test_the_command_tells_it_in_one_line(words: list[str], said: str) -> None:
    done = subprocess.run([sys.executable, "-m", "egopose", *words], capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert line.endswith(said)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_its_main(verb: str) -> None:
    module = "core.completion" if verb == "completion" else verb
    assert importlib.util.find_spec(f"egopose.{module}") is not None
