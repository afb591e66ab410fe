"""The one command and its verbs."""

from __future__ import annotations

import importlib.util

import pytest

from egopose.__main__ import VERBS, main


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["egopose", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code or 0)


def test_help_lists_every_verb(monkeypatch, capsys) -> None:
    assert call(monkeypatch, "--help") == 0
    shown = capsys.readouterr().out
    assert all(verb in shown for verb in VERBS)
    assert call(monkeypatch) == 2


def test_an_unknown_verb_is_named(monkeypatch, capsys) -> None:
    assert call(monkeypatch, "fly") == 2
    assert "'fly'" in capsys.readouterr().err


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_its_main(verb: str) -> None:
    assert importlib.util.find_spec(f"egopose.{verb}") is not None
