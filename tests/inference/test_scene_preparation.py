"""`egopose reconstruct prepare` on a walk of known way: what comes out, and that nothing is made twice or lost."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.filmed_walk import filmed_walk
from helpers.walking import walking

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.evaluation.scene_page import write_scene_page
from egopose.inference import scene_stages
from egopose.inference.scene_preparation import prepare_scene
from egopose.inference.scene_stages import Sources
from egopose.motion.io.native import read_native
from egopose.reconstruct import main
from egopose.scene.camera import CameraTrack
from egopose.scene.camera_file import save_camera
from egopose.scene.poses.track import PoseTrack, load_track
from egopose.scene.scene_file import Box, read_scene, write_scene

REPEATS = 3  # the walk is one stride of a second


def long_walk() -> PoseTrack:
    """The walk there and back and there again, so that its balance is even."""
    track, _ = filmed_walk(pitch=0.15)
    order = np.concatenate([np.arange(len(track))[:: 1 if k % 2 == 0 else -1] for k in range(REPEATS)])
    assert track.positions is not None
    return replace(
        track,
        pixels=track.pixels[order],
        positions=track.positions[order],
        confidence=track.confidence[order],
        filled=track.filled[order],
        swapped=track.swapped[order],
        weights=track.weights[order],
    )


def no_page(sources: Sources, folder: Path, settings: Mapping[str, Any], out: Path) -> None:
    (out / "page.html").write_text("page")


def settings(folder: Path, *more: str) -> dict[str, Any]:
    return compose_config("reconstruct", [f"out={folder / 'out'}", *more])


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("prepared")
    long_walk().save(folder / "walk.npz")
    prepare_scene(settings(folder, f"poses={folder / 'walk.npz'}"), no_page)
    return folder


@pytest.fixture
def folder(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "case")
    return tmp_path / "case"


def test_the_walk_comes_back(prepared: Path) -> None:
    out = prepared / "out"
    scene, body = read_scene(out / "scene.yaml"), read_native(out / "body.npz")
    assert scene.boxes == ()
    assert {contact.effector for contact in scene.contacts} == {"left_foot", "right_foot"}
    assert {contact.touches for contact in scene.contacts} == {"floor"}
    assert scene.camera.motion == "fixed"
    fit = json.loads((out / "fit.json").read_text())
    assert np.rad2deg(fit["pitch"]) == pytest.approx(np.rad2deg(0.15), abs=8.0)
    assert body.qpos[:, 2] == pytest.approx(np.tile(walking().qpos[:, 2].mean(), len(body)), abs=0.2)
    # Frames that were seen worse count less when the motion is followed.
    assert body.confidence == pytest.approx(scene_stages.trust_of(out))
    there = np.linalg.norm(body.qpos[len(walking()) - 1, :2])
    path = np.linalg.norm(walking().qpos[-1, :2] - walking().qpos[0, :2])
    assert there == pytest.approx(path, rel=0.3)


def test_the_page_shows_every_stage(prepared: Path, tmp_path: Path) -> None:
    sources = Sources(None, prepared / "walk.npz", 30.0)
    write_scene_page(sources, prepared / "out", {"moments": 3, "height": 60}, tmp_path)
    page = (tmp_path / "page.html").read_text()
    assert page.count("<section>") == 6
    assert page.count("<figure>") == 7
    with pytest.raises(InputError, match="moments"):
        write_scene_page(sources, prepared / "out", {"moments": 0, "height": 60}, tmp_path)


def test_a_second_call_makes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = settings(folder, f"poses={folder / 'walk.npz'}")
    before = {path: path.stat().st_mtime_ns for path in (folder / "out").rglob("*") if path.is_file()}
    for name in ("find_poses", "mend", "tell_contacts", "lift_joints", "pose_body", "place_root", "fill_scene"):
        monkeypatch.setattr(scene_stages, name, None)
    prepare_scene(values, no_page)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_fault_in_a_stage_loses_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = settings(folder, f"poses={folder / 'walk.npz'}", "contacts.threshold=0.6")
    kept = (folder / "out" / "body.npz").read_bytes()

    def full(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(scene_stages, "place_root", full)
        with pytest.raises(OSError, match="no space"):
            prepare_scene(values, no_page)
    assert (folder / "out" / "body.npz").read_bytes() == kept
    made = []
    monkeypatch.setattr(scene_stages, "find_poses", lambda *_: made.append("poses"))
    monkeypatch.setattr(scene_stages, "tell_contacts", lambda *_: made.append("contacts"))
    prepare_scene(values, no_page)
    assert made == []


def test_a_scene_that_was_changed_is_taken_and_kept(folder: Path) -> None:
    path = folder / "out" / "scene.yaml"
    scene = read_scene(path)
    box = Box("bench", (0.5, 0.5), (1.0, 0.0), 0.4, 0.0)
    changed = replace(scene, boxes=(box,), contacts=scene.contacts[:-1])
    write_scene(changed, path)
    values = settings(folder, f"poses={folder / 'walk.npz'}")
    before = (folder / "out" / "root.npz").read_bytes()
    prepare_scene(values, no_page)
    assert read_scene(path) == changed
    assert (folder / "out" / "root.npz").read_bytes() != before
    with pytest.raises(InputError, match="was changed by hand"):
        prepare_scene({**values, "scene": str(path)}, no_page)


def test_openposes_folder_is_read_without_a_film(tmp_path: Path) -> None:
    track = long_walk()
    keypoints = tmp_path / "keypoints"
    keypoints.mkdir()
    for t in range(len(track)):
        rows = np.column_stack([np.nan_to_num(track.pixels[t]), track.confidence[t]])
        card = {"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]}
        (keypoints / f"walk_{t:012d}_keypoints.json").write_text(json.dumps(card))
    size = "read.image_size=[1280,720]"
    out = prepare_scene(settings(tmp_path, f"poses={keypoints}", "read.fps=30", size), no_page)
    assert read_scene(out / "scene.yaml").contacts
    assert len(read_native(out / "body.npz")) == len(track)


@pytest.mark.parametrize(
    ("words", "field"),
    [
        ((), "video"),
        (("video=nowhere.mp4",), "video"),
        (("poses=nowhere",), "poses"),
    ],
)
def test_what_is_not_there_is_told(tmp_path: Path, words: tuple[str, ...], field: str) -> None:
    with pytest.raises(InputError) as caught:
        prepare_scene(settings(tmp_path, *words), no_page)
    assert caught.value.field == field


def test_a_motion_without_pixels_is_refused(tmp_path: Path) -> None:
    track = long_walk()
    replace(track, pixels=np.full_like(track.pixels, np.nan), axes="world").save(tmp_path / "walk.npz")
    with pytest.raises(InputError, match="no pixels"):
        prepare_scene(settings(tmp_path, f"poses={tmp_path / 'walk.npz'}"), no_page)


def test_a_scene_at_another_rate_is_refused(tmp_path: Path) -> None:
    long_walk().save(tmp_path / "walk.npz")
    (tmp_path / "scene.yaml").write_text("fps: 60\n")
    words = (f"poses={tmp_path / 'walk.npz'}", f"scene={tmp_path / 'scene.yaml'}")
    with pytest.raises(InputError, match="60; contacts are counted at 30"):
        prepare_scene(settings(tmp_path, *words), no_page)


def test_the_verb_says_what_it_needs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["egopose reconstruct"])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert "video=FILM, or poses=FOLDER" in capsys.readouterr().err


def moved_by(frames: int, pixels: float) -> CameraTrack:
    to_first = np.tile(np.eye(3), (frames, 1, 1))
    to_first[:, 0, 2] = pixels * np.arange(frames)
    return CameraTrack(to_first, np.zeros(frames, bool), np.ones(frames), "similarity")


def test_a_cameras_known_motion_is_undone(prepared: Path, tmp_path: Path) -> None:
    """Keypoints of a camera that turns, and its motion, give what a camera that stands gives."""
    track = long_walk()
    pixels = track.pixels.copy()
    pixels[..., 0] -= 2.0 * np.arange(len(track))[:, None]
    replace(track, pixels=pixels).save(tmp_path / "walk.npz")
    save_camera(moved_by(len(track), 2.0), tmp_path / "camera.npz")
    words = (f"poses={tmp_path / 'walk.npz'}", f"camera.track={tmp_path / 'camera.npz'}")
    out = prepare_scene(settings(tmp_path, *words), no_page)
    turned, still = (load_track(folder / "mended.npz") for folder in (out, prepared / "out"))
    np.testing.assert_allclose(turned.pixels, still.pixels, atol=1e-6)
    assert read_scene(out / "scene.yaml").camera.motion == "pan"
    before = (out / "camera.npz").read_bytes()
    save_camera(moved_by(len(track), 1.0), tmp_path / "camera.npz")
    prepare_scene(settings(tmp_path, *words), no_page)
    assert (out / "camera.npz").read_bytes() != before


def test_a_cameras_motion_of_other_frames_is_refused(tmp_path: Path) -> None:
    track = long_walk()
    track.save(tmp_path / "walk.npz")
    save_camera(moved_by(len(track) - 1, 2.0), tmp_path / "camera.npz")
    words = (f"poses={tmp_path / 'walk.npz'}", f"camera.track={tmp_path / 'camera.npz'}")
    with pytest.raises(InputError, match=f"there are poses of {len(track)}"):
        prepare_scene(settings(tmp_path, *words), no_page)
    with pytest.raises(InputError, match="no such file"):
        prepare_scene(settings(tmp_path, words[0], "camera.track=nowhere.npz"), no_page)
