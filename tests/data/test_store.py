"""The take store: made whole, resumed where it stopped, refused where it is damaged; splits and sources."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import sys
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.mocap import SHORT_CLIPS, short_clips
from hypothesis import given
from hypothesis import strategies as st

from egopose.benchmarks.process_memory import mapped_mb
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data import motion_stage, preparation
from egopose.data.preparation import fingerprint_of, flow_name, global_spans, humanoid_of, prepare, store_folder
from egopose.data.prepare_motion import reference_motion
from egopose.data.reference import supported
from egopose.data.report import store_report
from egopose.data.splits import split_takes
from egopose.data.store import Fragment, TakeInfo, TakeStore
from egopose.data.take_sources import find_sources
from egopose.motion.contacts import runs_of
from egopose.motion.motion import finite_difference
from egopose.vision.video import VideoWriter

CLIPS = Path(str(files("egopose") / "assets" / "clips"))


def configuration(folder: Path, *overrides: str) -> dict[str, Any]:
    """Two short embedded clips as a folder of one's own, the quick simulation, a small flow."""
    return compose_config(
        "prepare",
        [
            *short_clips(folder),
            *overrides,
        ],
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of motions only, made once."""
    folder = tmp_path_factory.mktemp("made")
    prepare(configuration(folder), progress=False, flow=False)
    return folder


@pytest.fixture
def store(made: Path, tmp_path: Path) -> TakeStore:
    """A copy that a test may damage."""
    shutil.copytree(made / "store", tmp_path / "store")
    return TakeStore.open(tmp_path / "store")


# --- what is in it ---------------------------------------------------------------------------------------------------


def test_a_store_holds_the_clips_and_mujocos_kinematics_of_them(store: TakeStore, made: Path) -> None:
    assert [t.name for t in store.takes] == list(SHORT_CLIPS)
    assert [t.subject for t in store.takes] == ["turn", "walk"]
    assert store.fps == 30.0
    reference = store.reference
    assert reference.batch_size == torch.Size([store.frames_total])
    assert {k: (tuple(v.shape[1:]), v.dtype) for k, v in reference.items()} == {
        "qpos": ((59,), torch.float64),
        "qvel": ((58,), torch.float64),
        "xpos": ((21, 3), torch.float64),
        "xquat": ((21, 4), torch.float64),
        "com": ((3,), torch.float64),
        "com_vel": ((3,), torch.float64),
    }
    for i, take in enumerate(store.takes):
        frames = store.frames(i)
        assert frames.stop - frames.start == take.length
        clip = store.clip(i)
        assert np.array_equal(clip.qpos, reference["qpos"][frames].numpy())
        assert np.allclose(finite_difference(clip.qpos, 30.0), reference["qvel"][frames].numpy())
        positions, _ = clip.forward_kinematics()
        assert np.abs(positions - reference["xpos"][frames].numpy()).max() < 1e-9
        assert take.lowest_head_height == pytest.approx(positions[:, 6, 2].min())
        assert take.rendered
        assert take.retargeting_mm < 5.0
        com, velocity = reference["com"][frames], reference["com_vel"][frames]
        assert torch.allclose(velocity[:-1], (com[1:] - com[:-1]) * 30.0)
    assert store.takes[1].offset == store.takes[0].length
    report = store_report(store)
    assert all(name in report for name in SHORT_CLIPS)
    assert "2 takes" in report
    assert not list((made / "store").parent.glob("*.part"))


def test_opening_it_again_makes_nothing_anew(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "_make_motions", lambda *_: pytest.fail("made again"))
    assert prepare(configuration(made), progress=False, flow=False).root == (made / "store").resolve()


@pytest.mark.parametrize("change", ["data.preparation.cutoff_hz=6.0", "humanoid.total_mass=80"])
def test_a_store_of_other_settings_is_refused(made: Path, change: str) -> None:
    with pytest.raises(InputError, match="fingerprint: the store was made of other data or settings"):
        prepare(configuration(made, change), progress=False, flow=False)


def test_physics_rate_vision_and_split_do_not_change_the_reference(made: Path) -> None:
    """What the reference does not depend on does not ask for a new store."""
    plain = fingerprint_of(configuration(made))
    for same in ("sim=paper", "vision.workers=7", "data.split.train_share=0.5"):
        assert fingerprint_of(configuration(made, same)) == plain
    assert fingerprint_of(configuration(made, "data.subject='deepmimic_([a-z])'")) != plain


def test_without_a_folder_the_store_lies_in_the_cache_under_a_name_of_its_own(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGOPOSE_CACHE", str(tmp_path))
    folders = {store_folder(configuration(made, "data.store=null", c)) for c in ("sim=fast", "humanoid.total_mass=60")}
    assert len(folders) == 2
    assert all(f.parent == tmp_path / "stores" and f.name.startswith("cmu6-") for f in folders)


# --- tables ----------------------------------------------------------------------------------------------------------


def test_a_table_is_written_whole_and_replaced_whole(store: TakeStore) -> None:
    frames = store.frames_total
    assert not store.has_table("light")
    store.write_table("light", {"visual_features": torch.arange(frames * 4.0).reshape(frames, 4)}, {"epoch": 1})
    assert store.has_table("light")
    assert store.table_card("light") == {"epoch": 1}
    assert store.table("light")["visual_features"][5].tolist() == [20.0, 21.0, 22.0, 23.0]
    store.write_table("light", {"visual_context": torch.zeros(frames, 2)}, {"epoch": 2})
    assert set(store.table("light").keys()) == {"visual_context"}
    assert store.table_card("light") == {"epoch": 2}
    with pytest.raises(ValueError, match=f"3 frames, the store {frames}"):
        store.write_table("light", {"visual_context": torch.zeros(3, 2)}, {})
    assert store.table_card("light") == {"epoch": 2}


def test_a_failed_table_leaves_the_old_one(store: TakeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted while the new one is being written."""
    frames = store.frames_total
    store.write_table("light", {"x": torch.ones(frames)}, {"epoch": 1})

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("egopose.data.store.json.dumps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        store.write_table("light", {"x": torch.zeros(frames)}, {"epoch": 2})
    monkeypatch.undo()
    assert store.table_card("light") == {"epoch": 1}
    assert store.table("light")["x"].sum() == frames


# --- flow, resumed ---------------------------------------------------------------------------------------------------


@pytest.fixture
def own(tmp_path: Path) -> dict[str, Any]:
    """A configuration of two takes with videos of one's own: 48 x 48 noise that slides, 30 fps."""
    rows = []
    for number, name in enumerate(SHORT_CLIPS):
        video = tmp_path / f"{name}.mp4"
        texture = np.random.default_rng(number).integers(0, 255, (96, 96, 3), dtype=np.uint8)
        texture = np.repeat(np.repeat(texture[::8, ::8], 8, axis=0), 8, axis=1)
        with VideoWriter(video, 30.0) as writer:
            for t in range(60):
                writer.write(np.ascontiguousarray(texture[t % 32 : t % 32 + 48, :48]))
        rows.append(f"{{motion: {CLIPS / name}.motion.npz, video: {video}, sync_offset: 0.1, subject: s{number}}}")
    return compose_config(
        "prepare",
        ["data=own", f"data.takes=[{', '.join(rows)}]", f"data.store={tmp_path / 'store'}", "sim=fast"],
    )


def test_own_videos_are_taken_as_they_are_and_resumed_take_by_take(
    own: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Path] = []
    real = preparation.extract_flow

    def stops_at_the_second(path: Path, *arguments: object) -> np.ndarray:
        calls.append(path)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(path, *arguments)

    monkeypatch.setattr(preparation, "extract_flow", stops_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        prepare(own, progress=False)
    name = flow_name(own)
    store = TakeStore.open(own["data"]["store"])
    assert [t.sync_offset for t in store.takes] == [0.1, 0.1]
    assert not any(t.rendered for t in store.takes)
    assert store.flow_done(name) == {0}
    with pytest.raises(InputError, match=r"done\.json: lacks 1 takes \(deepmimic_walk"):
        store.flow(name)
    first = store.open_flow(name, 1)[store.frames(0)].clone()
    store = prepare(own, progress=False)
    assert [p.name for p in calls] == [
        f"{n}.mp4" for n in (*SHORT_CLIPS, SHORT_CLIPS[1])
    ]  # the first take was not done again
    flow = store.flow(name)
    size = own["vision"]["flow"]["stored_size"]
    assert flow.shape == (store.frames_total, 2, size, size)
    assert torch.equal(flow[store.frames(0)], first)
    assert flow[store.frames(0)][1:].abs().sum() > 0
    assert flow[store.frames(1)][1:].abs().sum() > 0
    assert "mp4" in store_report(store)


def test_a_store_cut_off_while_its_motions_were_made_is_made_again(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = configuration(tmp_path)
    real, count = reference_motion, 0

    def stops_at_the_second(*arguments: object) -> object:
        nonlocal count
        count += 1
        if count == 2:
            raise KeyboardInterrupt
        return real(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(motion_stage, "reference_motion", stops_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        prepare(config, progress=False, flow=False)
    assert not (tmp_path / "store").exists()
    (tmp_path / "store.part").mkdir()  # what a power cut leaves
    store = prepare(config, progress=False, flow=False)
    assert torch.equal(store.reference["qpos"], TakeStore.open(made / "store").reference["qpos"])


# --- damage ----------------------------------------------------------------------------------------------------------


def test_what_is_no_store_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"store\.json: is missing.*egopose\.prepare"):
        TakeStore.open(tmp_path)


def card(store: TakeStore) -> tuple[Path, dict[str, Any]]:
    path = store.root / "store.json"
    return path, json.loads(path.read_text())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda c: c | {"schema": 99}, "schema: is 99, this version reads 1"),
        (lambda c: {k: v for k, v in c.items() if k != "fps"}, "fps"),
        (lambda c: c | {"fps": "fast"}, "fast"),
        (lambda c: c | {"takes": [t | {"colour": 1} for t in c["takes"]]}, "colour"),
        (lambda c: c | {"takes": [{k: v for k, v in c["takes"][0].items() if k != "length"}]}, "length"),
        (lambda c: c | {"takes": 7}, "takes"),
        (lambda c: c["takes"], "takes"),
    ],
)
def test_a_damaged_card_is_named(store: TakeStore, damage: Any, message: str) -> None:
    path, content = card(store)
    path.write_text(json.dumps(damage(content)))
    with pytest.raises(InputError, match=message) as error:
        TakeStore.open(store.root)
    assert error.value.source == str(path)


def test_a_cut_off_card_is_named(store: TakeStore) -> None:
    path, _ = card(store)
    path.write_text(path.read_text()[:100])
    with pytest.raises(InputError, match=r"store\.json: takes: is damaged"):
        TakeStore.open(store.root)


def test_a_reference_of_another_length_is_refused(store: TakeStore) -> None:
    path, content = card(store)
    content["takes"][1]["length"] -= 1
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="reference: has"):
        _ = TakeStore.open(store.root).reference


@pytest.mark.parametrize("damage", ["gone", "no_meta", "cut", "no_key"])
def test_a_damaged_reference_is_named(store: TakeStore, damage: str) -> None:
    folder = store.root / "reference"
    if damage == "gone":
        shutil.rmtree(folder)
    elif damage == "no_meta":
        (folder / "meta.json").write_text("{")
    elif damage == "cut":
        (folder / "qpos.memmap").write_bytes((folder / "qpos.memmap").read_bytes()[:1000])
    else:
        (folder / "qpos.memmap").unlink()
    with pytest.raises(InputError, match="reference"):
        _ = store.reference["qpos"]


def test_a_damaged_flow_list_is_named(store: TakeStore) -> None:
    store.open_flow("light", 4)
    store.mark_flow("light", 0)
    (store.root / "flow/light/done.json").write_text("[0, ")
    with pytest.raises(InputError, match=r"done\.json"):
        store.flow("light")


def test_a_missing_table_is_named(store: TakeStore) -> None:
    with pytest.raises(InputError, match="tables/light: is missing"):
        store.table("light")
    with pytest.raises(InputError, match="tables/light"):
        store.table_card("light")


# --- what is read stays as it was made --------------------------------------------------------------------------------


def with_table(store: TakeStore) -> TakeStore:
    store.write_table("light", {"x": torch.arange(store.frames_total * 2.0).reshape(-1, 2)}, {"epoch": 1})
    return store


def test_a_change_in_place_stays_in_memory(store: TakeStore) -> None:
    with_table(store)
    before = {file: file.read_bytes() for file in store.root.rglob("*.memmap")}
    assert len(before) == 7
    reference, table = store.reference, store.table("light")
    kept = store.reference["qpos"].clone()
    reference["qpos"] += 1.0
    reference["qvel"][3:5] = 0.0
    table["x"].zero_()
    assert torch.equal(reference["qpos"], kept + 1.0)
    assert {file: file.read_bytes() for file in before} == before
    assert torch.equal(TakeStore.open(store.root).reference["qpos"], kept)
    assert TakeStore.open(store.root).table("light")["x"][1].tolist() == [2.0, 3.0]


def test_flow_is_filled_on_the_disk_and_read_like_all_else(store: TakeStore) -> None:
    table = store.open_flow("light", 4)
    table[store.frames(1)] = 2.0
    for take in (0, 1):
        store.mark_flow("light", take)
    read = TakeStore.open(store.root).flow("light")
    assert (read[store.frames(0)] == 0).all()
    assert (read[store.frames(1)] == 2).all()
    read.zero_()
    assert (TakeStore.open(store.root).flow("light")[store.frames(1)] == 2).all()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_another_process_maps_the_file_and_gets_no_copy(store: TakeStore) -> None:
    """What a worker is sent is the file's name, of a part of a tensor too; its pages are shared."""
    file = store.root / "reference" / "xpos.memmap"
    tensor = store.reference["xpos"]
    for sent in (tensor, tensor[3:5], tensor[:, 2], *tensor.chunk(2), store.reference[4:9]["xpos"]):
        message = bytes(ForkingPickler.dumps(sent))
        assert len(message) < 1000
        received = pickle.loads(message)
        assert torch.equal(received, sent)
        resident, altered = mapped_mb(os.getpid(), file)
        assert resident > 0
        assert altered == 0
        received += 1.0
        assert torch.equal(store.reference["xpos"], tensor)


@pytest.mark.parametrize("part", ["reference/qpos.memmap", "clips/{take}.motion.npz", "tables/light/x.memmap"])
def test_an_altered_file_is_refused(store: TakeStore, part: str) -> None:
    with_table(store)
    name = part.format(take=store.takes[0].name)

    def read() -> None:
        again = TakeStore.open(store.root)
        again.reference, again.clip(0), again.table("light")

    read()
    data = bytearray((store.root / name).read_bytes())
    data[len(data) // 2] ^= 1
    (store.root / name).write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"was altered since it was made: delete .*, and it is made anew") as caught:
        read()
    assert caught.value.field == name


def test_a_store_from_before_there_were_checksums_opens(store: TakeStore) -> None:
    path, content = card(with_table(store))
    assert len(content.pop("checksums")) == 9
    path.write_text(json.dumps(content))
    (store.root / "tables/light/checksums.json").unlink()
    again = TakeStore.open(store.root)
    assert torch.equal(again.reference["qpos"], store.reference["qpos"])
    assert len(again.clip(0)) == store.takes[0].length
    assert again.table("light")["x"].shape == (store.frames_total, 2)


@pytest.mark.parametrize("checksums", [[1], {"reference/qpos.memmap": 3}, {"../else": "0" * 64}])
def test_damaged_checksums_are_named(store: TakeStore, checksums: Any) -> None:
    path, content = card(store)
    path.write_text(json.dumps({**content, "checksums": checksums}))
    with pytest.raises(InputError, match=r"store\.json: checksums: is damaged"):
        TakeStore.open(store.root)


# --- splits ----------------------------------------------------------------------------------------------------------

TAKE = TakeInfo("a", "1", 0, 100, 1.4, "a.bvh", "videos/a.mp4", 0.0, True, ((0, 100),), 1.0)
TIME = {"kind": "time", "train_share": 0.8, "shortest": 10, "subjects": None}


def test_by_time_the_first_part_trains_and_the_rest_tests() -> None:
    assert split_takes([TAKE], TIME, "train") == [Fragment(0, 0, 80)]
    assert split_takes([TAKE], TIME, "test") == [Fragment(0, 80, 100)]


def test_a_take_too_short_to_test_on_trains_whole() -> None:
    takes = [TAKE, replace(TAKE, name="b", length=40, supported=((0, 40),))]
    assert split_takes(takes, TIME, "train") == [Fragment(0, 0, 80), Fragment(1, 0, 40)]
    assert split_takes(takes, TIME, "test") == [Fragment(0, 80, 100)]


def test_by_subject() -> None:
    takes = [TAKE, replace(TAKE, name="b", subject="2"), replace(TAKE, name="c", subject="3")]
    settings = {"kind": "subject", "test_subjects": [2], "shortest": 10, "subjects": None}
    assert [f.take for f in split_takes(takes, settings, "train")] == [0, 2]
    assert [f.take for f in split_takes(takes, settings, "test")] == [1]
    assert [f.take for f in split_takes(takes, settings | {"subjects": ["2", "3"]}, "train")] == [2]


def test_frames_without_a_floor_are_cut_out() -> None:
    take = replace(TAKE, supported=((5, 30), (33, 40), (50, 95)))
    assert split_takes([take], TIME, "train") == [Fragment(0, 5, 30), Fragment(0, 50, 80)]
    assert split_takes([take], TIME, "test") == [Fragment(0, 80, 95)]
    assert split_takes([take], TIME, "train", supported_only=False) == [Fragment(0, 0, 80)]


@given(st.lists(st.booleans(), min_size=1, max_size=200), st.integers(1, 20), st.floats(0.05, 0.95), st.booleans())
def test_no_frame_trains_and_tests(mask: list[bool], shortest: int, share: float, only: bool) -> None:
    take = replace(TAKE, length=len(mask), supported=runs_of(np.array(mask)))
    settings = {"kind": "time", "train_share": share, "shortest": shortest, "subjects": None}
    seen: list[int] = []
    for part in ("train", "test"):
        try:
            fragments = split_takes([take], settings, part, only)
        except InputError:
            continue
        for f in fragments:
            assert f.stop - f.start >= shortest
            assert not only or all(mask[f.start : f.stop])
            seen += range(f.start, f.stop)
    assert len(seen) == len(set(seen))
    assert set(seen) <= set(range(len(mask)))


@given(st.lists(st.booleans(), max_size=60))
def test_runs_of_a_mask(mask: list[bool]) -> None:
    rebuilt = np.zeros(len(mask), dtype=bool)
    runs = runs_of(np.array(mask, dtype=bool))
    for start, stop in runs:
        assert start < stop
        rebuilt[start:stop] = True
    assert rebuilt.tolist() == mask
    assert all(a[1] < b[0] for a, b in pairwise(runs))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"subjects": ["7"]}, "subjects: no such subjects: 7"),
        ({"kind": "subject", "test_subjects": [9]}, "test_subjects: no such subjects: 9"),
        ({"kind": "subject"}, "test_subjects"),
        ({"kind": "weekday"}, "kind: must be time, subject or table, not 'weekday'"),
        ({"shortest": 5000}, "train: leaves no fragment of 5000 frames"),
        ({"train_share": 1.4}, "train_share"),
        ({"train_share": None}, "train_share"),
    ],
)
def test_a_wrong_split_is_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        split_takes([TAKE], TIME | change, "train")


def test_spans_among_the_stores_frames(store: TakeStore) -> None:
    offset = store.takes[1].offset
    assert global_spans(store, [Fragment(0, 2, 5), Fragment(1, 0, 7)]) == [(2, 5), (offset, offset + 7)]


def test_hanging_in_the_air_is_not_supported_and_falling_is() -> None:
    """Of a body held 2 m up no frame is possible on a bare floor; of one in free fall every frame is."""
    from tensordict import TensorDict

    humanoid = humanoid_of(compose_config("prepare"))
    none = np.zeros((60, 4), dtype=bool)

    def states(height: np.ndarray) -> TensorDict:
        com = torch.zeros(60, 3, dtype=torch.float64)
        com[:, 2] = torch.from_numpy(height)
        return TensorDict({"com": com, "xpos": com[:, None].expand(60, 21, 3)}, batch_size=[60])

    time = np.arange(60) / 30.0
    assert not supported(humanoid, states(np.full(60, 2.0)), none, 30.0).any()
    assert supported(humanoid, states(30.0 - 0.5 * 9.81 * time**2), none, 30.0)[5:-5].all()
    assert supported(humanoid, states(np.full(60, 2.0)), ~none, 30.0).all()
    assert supported(humanoid, states(np.full(60, 0.1)), none, 30.0).all()


# --- sources ---------------------------------------------------------------------------------------------------------


def test_embedded_clips_are_there_with_their_subjects() -> None:
    sources = find_sources(compose_config("prepare")["data"])
    assert {s.subject for s in sources} == {"cmu01", "cmu07", "deepmimic"}
    assert len(sources) == 18
    assert len(find_sources(compose_config("prepare", ["+data.exclude=[cmu01_01]"])["data"])) == 17


def test_the_benchmarks_subjects(shared: Path) -> None:
    config = compose_config("prepare", ["data=cmu6", f"data.folder={shared / 'data/cmu_bvh60'}"])
    sources = find_sources(config["data"])
    assert len(sources) == 54
    assert sorted({s.subject for s in sources}) == ["1", "2", "5", "6", "7"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a_1.bvh").write_text("")
    (tmp_path / "b_1.bvh").write_text("")
    return tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"folder": None}, "data: folder: say where the set lies"),
        ({"folder": "/no/such/place"}, "data.folder: is not a folder"),
        ({"pattern": "*.amc"}, r"data\.pattern: '\*\.amc' matches no file"),
        ({"subject": "(x)"}, r"a_1\.bvh: data\.subject: '\(x\)' does not match"),
        ({"subject": "a|b"}, r"data\.subject"),
        ({"subject": "(a"}, r"data\.subject"),
        ({"source": "internet"}, "source: must be embedded, folder, table or takes, not 'internet'"),
    ],
)
def test_a_wrong_folder_setting_is_named(folder: Path, change: dict[str, Any], message: str) -> None:
    settings = {"source": "folder", "folder": str(folder), "pattern": "*.bvh", "subject": "([a-z])_"} | change
    with pytest.raises(InputError, match=message):
        find_sources(settings)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"motion": "gone.bvh"}, r"gone\.bvh: data\.takes\[0\]\.motion: there is no such file"),
        ({"motion": "a_1.bvh", "video": "gone.mp4"}, r"gone\.mp4: data\.takes\[0\]\.video: there is no such file"),
        ({"video": None}, r"data\.takes\[0\]\.motion: is missing"),
        ({"motion": "a_1.bvh", "sync": 1}, r"data\.takes\[0\]: has no setting 'sync'"),
        ({"motion": "a_1.bvh", "sync_offset": "soon"}, r"data\.takes\[0\]\.sync_offset"),
        ("a_1.bvh", r"data\.takes\[0\]"),
    ],
)
def test_a_wrong_take_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch, row: Any, message: str) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=message):
        find_sources({"source": "takes", "takes": [row], "reader": {}})


def test_two_takes_of_one_name_are_refused(folder: Path) -> None:
    row = {"motion": str(folder / "a_1.bvh")}
    with pytest.raises(InputError, match="names stand twice: a_1"):
        find_sources({"source": "takes", "takes": [row, row], "reader": {}})
    with pytest.raises(InputError, match="the list is empty"):
        find_sources({"source": "takes", "takes": [], "reader": {}})


@pytest.mark.parametrize("name", ["../outside", "a/b", "", ".."])
def test_a_take_cannot_be_named_out_of_the_store(folder: Path, name: str) -> None:
    row = {"motion": str(folder / "a_1.bvh"), "name": name}
    if not name:  # falls back on the file's
        assert find_sources({"source": "takes", "takes": [row], "reader": {}})[0].name == "a_1"
        return
    with pytest.raises(InputError, match=r"data\.takes\[0\]\.name"):
        find_sources({"source": "takes", "takes": [row], "reader": {}})
