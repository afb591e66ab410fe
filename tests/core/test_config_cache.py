"""A configuration that is composed twice is read once, and what one caller does to it no other sees."""

from __future__ import annotations

import pytest

from egopose.core import config
from egopose.core.config import compose_config
from egopose.core.errors import InputError


def test_what_a_caller_changes_stays_its_own() -> None:
    first = compose_config("train", ["seed=3"])
    first["algo"]["gamma"] = -1.0
    first["seed"] = 4
    again = compose_config("train", ["seed=3"])
    assert (again["seed"], again["algo"]["gamma"]) == (3, 0.99)
    assert compose_config("train")["seed"] == 0


def test_the_environment_is_read_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["source=0", "checkpoint=none"]
    for token in ("a" * 16, "b" * 16):
        monkeypatch.setenv("EGOPOSE_STREAM_TOKEN", token)
        assert compose_config("stream", words)["server"]["token"] == token


def test_hydra_composes_the_same_words_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    compose = config.compose
    monkeypatch.setattr(config, "compose", lambda name, words: asked.append(name) or compose(name, words))
    for _ in range(3):
        compose_config("report", ["sweep.last=71"])
        with pytest.raises(InputError, match=r"sweep\.lost"):
            compose_config("report", ["sweep.lost=71"])
    # A fault is told each time.
    assert len(asked) == 4
