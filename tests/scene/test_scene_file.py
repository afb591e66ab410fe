"""Scene files: what is written is read, and what cannot be is refused by the name of its field."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.scene.scene_file import (
    CAMERA_MOTIONS,
    EFFECTORS,
    FLOOR,
    FREE,
    USUAL_RANGE,
    Box,
    CameraNotes,
    Contact,
    Scene,
    read_scene,
    read_told_scene,
    write_scene,
)

NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,12}", fullmatch=True).filter(lambda name: name != FLOOR)
LENGTHS = st.floats(-50, 50)
FREEDOM = st.dictionaries(st.sampled_from(FREE), st.tuples(st.floats(-1, 0), st.floats(0, 1)))


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    names = draw(st.lists(NAMES, unique=True, max_size=4))
    sides = st.floats(0.01, 9)
    boxes = tuple(
        Box(
            name,
            draw(st.tuples(sides, sides)),
            draw(st.none() | st.tuples(LENGTHS, LENGTHS)),
            draw(st.none() | st.floats(0, 3)),
            draw(st.none() | st.floats(-4, 4)),
            draw(FREEDOM),
        )
        for name in names
    )
    rows = draw(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)), max_size=5))
    contacts = tuple(
        Contact(draw(st.sampled_from(EFFECTORS)), draw(st.sampled_from([FLOOR, *names])), first, first + more)
        for first, more in rows
    )
    angles = st.none() | st.floats(-3, 3)
    camera = CameraNotes(
        draw(st.none() | st.sampled_from(CAMERA_MOTIONS)),
        draw(st.none() | st.floats(0.1, 3)),
        draw(angles),
        draw(angles),
    )
    notes = tuple(draw(st.lists(st.text(max_size=30), max_size=3)))
    return Scene(draw(st.floats(1, 240)), draw(st.floats(0, 1e4)), camera, boxes, contacts, notes)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(scene=scenes())
def test_what_is_written_is_read(tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "scene.yaml"
    write_scene(scene, path)
    assert read_scene(path) == scene
    first = path.read_bytes()
    write_scene(read_scene(path), path)
    assert path.read_bytes() == first


def test_a_user_says_little(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("boxes: [{name: bench, size: [0.4, 1.2]}]\ncamera: {motion: pan}\n")
    scene = read_scene(path)
    assert scene == Scene(camera=CameraNotes("pan"), boxes=(Box("bench", (0.4, 1.2)),))
    assert scene.boxes[0].free == {"along": USUAL_RANGE, "height": USUAL_RANGE}
    assert not scene.boxes[0].known


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("boxes: [{name: a, size: [1, 1]}, {name: b, size: [1, -1]}]", "boxes[1].size"),
        ("boxes: [{name: a, size: [1, 1]}, {name: b, size: [1]}]", "boxes[1].size"),
        ("boxes: [{name: a, size: [1, 1], colour: red}]", "boxes[0].colour"),
        ("boxes: [{size: [1, 1]}]", "boxes[0].name"),
        ("boxes: [{name: floor, size: [1, 1]}]", "boxes[0].name"),
        ("boxes: [{name: a, size: [1, 1], height: 3.5}]", "boxes[0].height"),
        ("boxes: [{name: a, size: [1, 1], height: .nan}]", "boxes[0].height"),
        ("boxes: [{name: a, size: [1, 1], place: [.inf, 0]}]", "boxes[0].place"),
        ("boxes: [{name: a, size: [1, 1], free: {width: [-1, 1]}}]", "boxes[0].free.width"),
        ("boxes: [{name: a, size: [1, 1], free: {along: [0.1, 1]}}]", "boxes[0].free.along"),
        ("boxes: [{name: a, size: [1, 1]}, {name: a, size: [1, 1]}]", "boxes[1].name"),
        ("boxes: [3]", "boxes[0]"),
        ("boxes: 3", "boxes"),
        ("contacts: [{effector: left_foot, touches: bench, first: 0, last: 3}]", "contacts[0].touches"),
        ("contacts: [{effector: tail, touches: floor, first: 0, last: 3}]", "contacts[0].effector"),
        ("contacts: [{effector: left_foot, touches: floor, first: 4, last: 3}]", "contacts[0].last"),
        ("contacts: [{effector: left_foot, touches: floor, first: 0.5, last: 3}]", "contacts[0].first"),
        ("camera: {motion: flies}", "camera.motion"),
        ("camera: {field_of_view: 60}", "camera.field_of_view"),
        ("fps: 0", "fps"),
        ("begin: -1", "begin"),
        ("walls: []", "walls"),
        ("- 3", "scene"),
        ("boxes: [", "scene"),
    ],
)
def test_a_fault_is_told_by_its_field(tmp_path: Path, text: str, place: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_scene(path)
    assert (caught.value.source, caught.value.field) == (str(path), place)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is missing"):
        read_scene(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(("text", "told"), [("boxes: []", True), ("fps: 30", False), ("boxes:", False)])
def test_no_boxes_is_told_apart_from_nothing_said_of_boxes(text: str, told: bool, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    scene, tells = read_told_scene(tmp_path / "scene.yaml")
    assert (scene.boxes, tells) == ((), told)
