"""Data sets that come as a table of clips: who, how read, which part, what is left out, what is refused."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.rigs import PLAIN, STANDING, write_rig

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data import gate
from egopose.data.preparation import fingerprint_of, prepare
from egopose.data.report import minutes_by_person, store_report
from egopose.data.source_reading import read_source
from egopose.data.splits import split_takes
from egopose.data.store import LeftOut, TakeStore
from egopose.data.table_sources import left_out_rows
from egopose.data.take_sources import find_sources
from egopose.motion.notes import notes_of

HEADER = "file,person,set,fps,metres_per_unit,up,frames,skip_first,split,already_in_project,needs_object,licence"
COLUMNS = HEADER.split(",")
SHORT = replace(PLAIN, seconds=1.5)
#: A file's row but for name and person: what is written there is right.
RIGHT = {
    "set": "a",
    "fps": "30",
    "metres_per_unit": "0.01",
    "up": "Y",
    "frames": "45",
    "split": "train",
    "licence": "CMU",
}


def write_table(folder: Path, rows: list[dict[str, str]]) -> None:
    with (folder / "clips.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def row(file: str, person: str, **other: str) -> dict[str, str]:
    return {**RIGHT, "file": file, "person": person, **other}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One person's motion on three rigs, and a file that ends in the middle."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "ann").mkdir()
    write_rig(SHORT, folder / "ann" / "walk.bvh")
    write_rig(replace(SHORT, squats=False), folder / "ben.bvh")
    write_rig(replace(SHORT, world=(90.0, 0.0, 0.0), rest_world=(90.0, 0.0, 0.0)), folder / "z_up.bvh")
    text = (folder / "ben.bvh").read_text()
    (folder / "cut.bvh").write_text(text[: len(text) // 2])
    return folder


@pytest.fixture
def folder(files: Path, tmp_path: Path) -> Path:
    shutil.copytree(files, tmp_path / "set")
    return tmp_path / "set"


def configuration(folder: Path, *overrides: str) -> dict[str, Any]:
    settings = ["data=cmu_people", f"data.folder={folder}", f"data.store={folder.parent / 'store'}", "sim=fast"]
    return compose_config("prepare", [*settings, "data.workers=1", *overrides])


ROWS = [
    row("ann/walk.bvh", "ann"),
    row("ben.bvh", "ben", split="test"),
    row("cut.bvh", "cat"),
    row("z_up.bvh", "dan", up="Z", set="b"),
    row("gone.bvh", "eve", already_in_project="yes", needs_object="yes"),
    row("gone_too.bvh", "eve", needs_object="yes", frames="90"),
    row("other.bvh", "eve", licence="CC BY-SA 3.0"),
]


@pytest.fixture(scope="module")
def made(files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], TakeStore]:
    folder = tmp_path_factory.mktemp("made") / "set"
    shutil.copytree(files, folder)
    write_table(folder, ROWS)
    config = configuration(folder, "data.split.shortest=10")
    return config, prepare(config, progress=False, flow=False)


# --- what is prepared ------------------------------------------------------------------------------------------------


def test_people_train_or_test_as_the_table_says(made: tuple[dict[str, Any], TakeStore]) -> None:
    config, store = made
    assert [(t.name, t.subject, t.group, t.part) for t in store.takes] == [
        ("walk", "ann", "a", "train"),
        ("ben", "ben", "a", "test"),
        ("z_up", "dan", "b", "train"),
    ]
    split = config["data"]["split"]
    people = {
        part: {store.takes[f.take].subject for f in split_takes(store.takes, split, part)} for part in ("train", "test")
    }
    assert people == {"train": {"ann", "dan"}, "test": {"ben"}}


def test_a_refused_clip_is_listed_and_the_others_are_kept(made: tuple[dict[str, Any], TakeStore]) -> None:
    _, store = made
    refused = [clip for clip in store.left_out if clip.refused]
    assert [(clip.name, clip.subject, clip.seconds) for clip in refused] == [("cut", "cat", 1.5)]
    assert "frame 20 of 45 has 38 numbers" in refused[0].cause
    assert f"refused: cut (cat), 0.03 min: {refused[0].cause}" in store_report(store)


def test_rows_are_left_out_with_their_reasons(made: tuple[dict[str, Any], TakeStore]) -> None:
    config, store = made
    known, needs = "the motion is in cmu6 already", "needs an object or an uneven floor"
    left_out = [LeftOut("gone", "eve", f"{known}; {needs}", 1.5), LeftOut("gone_too", "eve", needs, 3.0)]
    assert left_out_rows(config["data"]) == left_out
    assert [clip for clip in store.left_out if not clip.refused] == left_out
    assert f"left out: 1 clips, 0.05 min: {needs}" in store_report(store)


def test_the_report_has_minutes_by_person_and_the_gate(made: tuple[dict[str, Any], TakeStore]) -> None:
    config, store = made
    report, split = store_report(store, config["data"]["split"]), config["data"]["split"]
    rows = minutes_by_person(store, split)
    for take in store.takes:
        on_floor = sum(b - a for a, b in take.supported if b - a >= 10) / store.fps / 60
        wanted = {"takes": 1, "prepared": take.length / store.fps / 60, "train": 0.0, "test": 0.0, take.part: on_floor}
        assert rows[take.subject] == pytest.approx(wanted)
        assert take.gate is not None
        assert 0 <= (take.feasible or 0) <= 1
        assert (f"physics gate: {take.name} ({take.subject}) fails: {take.gate}" in report) == bool(take.gate)
    assert f"physics gate: {sum(not t.gate for t in store.takes)} of 3 takes pass" in report
    assert "3 people" in report


def test_a_store_is_opened_with_all_of_it(made: tuple[dict[str, Any], TakeStore]) -> None:
    _, store = made
    again = TakeStore.open(store.root)
    assert again.takes == store.takes
    assert again.left_out == store.left_out
    card = json.loads((store.root / "store.json").read_text())
    damaged = store.root.parent / "damaged"
    shutil.copytree(store.root, damaged)
    (damaged / "store.json").write_text(json.dumps(card | {"left_out": [{"name": "x"}]}))
    with pytest.raises(InputError, match="left_out"):
        TakeStore.open(damaged)


def test_two_workers_make_the_same_store_as_one(made: tuple[dict[str, Any], TakeStore], tmp_path: Path) -> None:
    config, store = made
    data = {**config["data"], "workers": 2, "store": str(tmp_path / "store")}
    other = prepare({**config, "data": data}, progress=False, flow=False)
    assert len(store.card["checksums"]) > len(store.takes)
    assert other.card == store.card


def test_the_gates_command_goes_on_past_a_refused_clip(
    made: tuple[dict[str, Any], TakeStore], capsys: pytest.CaptureFixture[str]
) -> None:
    config, store = made
    gate.main([f"data.folder={config['data']['folder']}", "data=cmu_people", "sim=fast"])
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines[:4]] == ["| walk", "| ben", "| cut", "| z_up"]
    assert "refused: line 149: frame 20 of 45" in lines[2]
    assert lines[-1].startswith(f"{sum(not take.gate for take in store.takes)} of 4 clips pass")


def test_a_set_may_stop_at_what_it_cannot_use(folder: Path) -> None:
    write_table(folder, ROWS)
    with pytest.raises(InputError, match=r"cut\.bvh: line"):
        prepare(configuration(folder, "data.on_refused=stop"), progress=False, flow=False)


def test_a_set_of_refused_clips_alone_is_refused(folder: Path) -> None:
    write_table(folder, [row("cut.bvh", "cat")])
    with pytest.raises(InputError, match="cut: all 1 clips are refused"):
        prepare(configuration(folder), progress=False, flow=False)


@pytest.mark.parametrize(("column", "value"), [("split", "test"), ("set", "c"), ("skip_first", "4"), ("up", "-Y")])
def test_what_the_table_says_is_in_the_fingerprint(folder: Path, column: str, value: str) -> None:
    rows = [row("ann/walk.bvh", "ann"), row("ben.bvh", "ben")]
    write_table(folder, rows)
    before = fingerprint_of(configuration(folder))
    write_table(folder, [rows[0] | {column: value}, rows[1]])
    assert fingerprint_of(configuration(folder)) != before


# --- reading ---------------------------------------------------------------------------------------------------------


def read_one(folder: Path, **said: str) -> tuple[Any, tuple[str, ...]]:
    write_table(folder, [row("ben.bvh", "ben", **said)])
    motion = read_source(find_sources(configuration(folder)["data"])[0])
    return motion, notes_of(motion)


def test_a_table_that_agrees_says_nothing(folder: Path) -> None:
    for said in ({}, {"metres_per_unit": "0.00999"}, {"fps": "", "metres_per_unit": "", "up": "", "frames": ""}):
        assert not any("table" in note for note in read_one(folder, **said)[1])


@pytest.mark.parametrize(
    ("said", "note"),
    [
        ({"metres_per_unit": "0.011"}, "the file has unit 0.01, the table unit 0.011: read as the table says"),
        ({"fps": "60"}, "the file has fps 30, the table fps 60: read as the table says"),
        ({"up": "Z"}, "the file has up y, the table up z: read as the table says"),
    ],
)
def test_where_reader_and_table_disagree_the_table_is_believed_and_a_note_tells(
    folder: Path, said: dict[str, str], note: str
) -> None:
    motion, notes = read_one(folder, **said)
    assert note in notes
    found = (motion.meta["unit_metres"], motion.fps, motion.meta["up"])
    wanted = (float(said.get("metres_per_unit", 0.01)), float(said.get("fps", 30)), said.get("up", "Y").lower())
    assert found == wanted


def test_a_wrong_count_of_frames_is_told(folder: Path) -> None:
    assert "the file has 45 frames, the table 50" in read_one(folder, frames="50")[1]


def test_frames_before_the_motion_are_cut(folder: Path) -> None:
    whole, motion = read_one(folder)[0], read_one(folder, skip_first="4")[0]
    assert (motion.qpos == whole.qpos[4:]).all()
    assert "4 frames before the motion were cut, as the table says" in notes_of(motion)
    with pytest.raises(InputError, match="skip: the set skips 45 frames, the file has 45"):
        read_one(folder, skip_first="45")


def test_a_unit_that_only_the_table_knows_is_tried(folder: Path) -> None:
    """Of a body 1.2 million units tall no known unit makes a person."""
    write_rig(replace(STANDING, seconds=1.5, height=7123.0), folder / "odd.bvh")
    write_table(folder, [row("odd.bvh", "ann", metres_per_unit="1.4e-6")])
    motion = read_source(find_sources(configuration(folder)["data"])[0])
    assert motion.meta["stature"] == pytest.approx(1.75, abs=0.1)
    assert any(note.startswith("read as the table says (fps 30, unit 1.4e-06, up y)") for note in notes_of(motion))


# --- tables that are wrong -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([row("ben.bvh", "ben", split="maybe")], "line 2, split: must be train or test, not 'maybe'"),
        ([row("ben.bvh", "ben", fps="fast")], "line 2, fps: must be a number of at least 1, not 'fast'"),
        ([row("ben.bvh", "ben", fps="nan")], "line 2, fps: must be a number"),
        ([row("ben.bvh", "ben", skip_first="1.5")], "skip_first: must be a whole number of at least 0, not '1.5'"),
        ([row("../ben.bvh", "ben")], r"line 2, file: '../ben.bvh' lies outside data.folder"),
        ([row("ben.bvh", "")], "line 2, person: is empty"),
        ([row("ben.bvh", "ben", licence="other")], "no row has"),
        ([row("no.bvh", "ben")], "no.bvh: data.folder: 1 of 1 files of the table are not there: unpack"),
        ([row("ben.bvh", "ben", needs_object="yes")], "data.leave_out: leaves no clip"),
        (
            [row("ben.bvh", "ben"), row("ann/walk.bvh", "ben", split="test")],
            "split of ben: must be the same in all rows: people train or test",
        ),
        ([row("ben.bvh", "ben"), row("ben.bvh", "ben")], "names stand twice"),
    ],
)
def test_a_wrong_row_is_refused_by_its_line(folder: Path, rows: list[dict[str, str]], said: str) -> None:
    write_table(folder, rows)
    with pytest.raises(InputError, match=said):
        find_sources(configuration(folder)["data"])


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["data.table=no.csv"], "no.csv: data.table: there is no such file"),
        (["data.columns.subject=who"], "data.columns: no column 'who'; there are file, person"),
        (["+data.columns.hair=file"], "data.columns: hair"),
        (["data.folder=null"], "say where the set lies"),
        (["data.on_refused=maybe"], "data.on_refused: must be stop or skip, not 'maybe'"),
        (["data.workers=0"], "data.workers: must be at least 1, not 0"),
    ],
)
def test_a_wrong_setting_is_refused(folder: Path, overrides: list[str], said: str) -> None:
    write_table(folder, ROWS)
    with pytest.raises(InputError, match=said):
        prepare(configuration(folder, *overrides), progress=False, flow=False)


def test_clips_of_one_name_are_told_apart_by_their_folders(folder: Path) -> None:
    shutil.copy(folder / "ben.bvh", folder / "walk.bvh")
    write_table(folder, [row("ann/walk.bvh", "ann"), row("walk.bvh", "ben"), row("ben.bvh", "ben")])
    assert [s.name for s in find_sources(configuration(folder)["data"])] == ["ann-walk", "walk", "ben"]
