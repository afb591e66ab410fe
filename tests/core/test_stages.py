"""Stages whose results stay: what is done is not made again, and a fault loses nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from egopose.core.stages import StageFolder, fingerprint


def write(text: str, name: str = "a.txt"):  # type: ignore[no-untyped-def]
    return lambda part: (part / name).write_text(text)


def test_what_is_done_is_known_and_what_changes_is_not(tmp_path: Path) -> None:
    store = StageFolder(tmp_path / "out")
    assert not store.done("first", {"x": 1})
    store.make("first", {"x": 1}, write("one"))
    assert store.done("first", {"x": 1})
    assert StageFolder(tmp_path / "out").done("first", {"x": 1})
    assert not store.done("first", {"x": 2})
    (store.folder / "a.txt").write_text("changed by hand")
    assert store.altered("first")
    assert not store.done("first", {"x": 1})
    (store.folder / "a.txt").unlink()
    assert not store.done("first", {"x": 1})


def test_a_fault_leaves_the_stage_as_it_was(tmp_path: Path) -> None:
    store = StageFolder(tmp_path)
    store.make("first", {"x": 1}, write("one"))

    def fails(part: Path) -> None:
        (part / "a.txt").write_text("half")
        raise RuntimeError("the disk is full")

    with pytest.raises(RuntimeError, match="disk"):
        store.make("first", {"x": 2}, fails)
    assert (tmp_path / "a.txt").read_text() == "one"
    assert store.done("first", {"x": 1})
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".part")] == []


@pytest.mark.parametrize(
    "card", ["", "{", "[]", '{"inputs": 3, "files": {}}', '{"inputs": "a", "files": {"../x": "b"}}']
)
def test_a_damaged_card_is_no_card(tmp_path: Path, card: str) -> None:
    store = StageFolder(tmp_path)
    store.make("first", {}, write("one"))
    (tmp_path / "stages" / "first.json").write_text(card)
    assert not store.done("first", {})
    assert not store.altered("first")


def test_a_fingerprint_is_of_the_values() -> None:
    assert fingerprint({"a": 1, "b": [2, None]}) == fingerprint({"b": [2, None], "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 1.5})
