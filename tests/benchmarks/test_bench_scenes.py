"""``egopose bench scenes``: its words, what is seen of a clip, and a clip from end to end."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.walking import walking
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose import bench
from egopose.benchmarks import scenes
from egopose.benchmarks.scene_clips import Chosen, clip_names, clips_folder, read_true_clip
from egopose.benchmarks.scene_sight import EXACT, GAP, HARD, SightNoise, guessed_scene, keypoints_of, seen
from egopose.benchmarks.scene_table import by_camera, tables
from egopose.benchmarks.words import as_settings
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.motion.motion import Motion
from egopose.scene.poses.keypoints import BODY_25
from egopose.scene.scene_file import Box, Scene, read_scene
from egopose.scene.virtual_camera import KINDS

CLIP = "walk_turn"


@pytest.mark.parametrize(
    ("words", "out"),
    [
        (["scenes", "--clips", "a", "b", "--json"], ["scenes", "clips=a,b", "--json"]),
        (["scenes", "--gap", "--folder", "out"], ["scenes", "gap=true", "folder=out"]),
        (["scenes", "--judge-only", "--rounds", "2"], ["scenes", "judge_only=true", "--rounds", "2"]),
        (["scenes", "--noise=none", "boxes=none"], ["scenes", "noise=none", "boxes=none"]),
        (["env", "--json", "scene.boxes=3"], ["env", "--json", "scene.boxes=3"]),
    ],
)
def test_settings_may_be_given_as_options(words: list[str], out: list[str]) -> None:
    assert as_settings(words) == out


@pytest.mark.parametrize(
    "word", ["clip=x", "cameras=drone", "noise=loud", "boxes=some", "gap=perhaps", "judge_only=true"]
)
def test_a_wrong_word_is_told(word: str) -> None:
    with pytest.raises(InputError) as caught:
        Chosen.of([word])
    assert caught.value.field == word.partition("=")[0]


def test_a_wrong_clip_and_folder_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        bench.main(["scenes", "--clips", "moonwalk"])
    assert stop.value.code == 2
    assert "moonwalk" in capsys.readouterr().err
    with pytest.raises(InputError, match="no such folder"):
        clips_folder("nowhere")


def walk() -> Motion:
    return Motion(walking().skeleton, np.concatenate([walking().qpos] * 4), 30.0)


@pytest.mark.parametrize("kind", KINDS)
def test_without_noise_every_keypoint_is_where_the_camera_puts_it(kind: str) -> None:
    """Undoing the camera and turning landmarks by the known turn gives the true shape again."""
    motion = walk()
    sight = seen(motion, kind, EXACT, np.random.default_rng(3))
    known = np.isfinite(sight.track.pixels).all(axis=-1)
    assert known.mean() > 0.9
    assert sight.track.positions is not None
    points = keypoints_of(motion)
    lengths = np.linalg.norm(points - points[:, [BODY_25.index("mid_hip")]], axis=2)
    np.testing.assert_allclose(np.linalg.norm(sight.track.positions, axis=2), lengths, atol=1e-9)
    assert sight.camera.to_first.shape == (len(motion), 3, 3)
    if kind == "fixed":
        np.testing.assert_array_equal(sight.camera.to_first, np.tile(np.eye(3), (len(motion), 1, 1)))


def test_the_turn_leads_from_the_first_pictures_axes_to_the_world() -> None:
    """A body to the right of another in the picture lies along the turned x."""
    motion = walk()
    sight = seen(motion, "fixed", EXACT, np.random.default_rng(5))
    c, s = np.cos(sight.turn), np.sin(sight.turn)
    aside = motion.qpos.copy()
    aside[:, :2] += 0.2 * np.array([c, s])
    moved = seen(Motion(motion.skeleton, aside, 30.0), "fixed", EXACT, np.random.default_rng(5))
    # The camera moves with the body, so look at the difference of keypoints along its own x.
    points = keypoints_of(motion)[0]
    right = (points[BODY_25.index("right_shoulder")] - points[BODY_25.index("left_shoulder")])[:2] @ [c, s]
    pixels = sight.track.pixels[0]
    across = pixels[BODY_25.index("right_shoulder"), 0] - pixels[BODY_25.index("left_shoulder"), 0]
    assert np.sign(right) == np.sign(across)
    np.testing.assert_allclose(moved.track.pixels, sight.track.pixels, atol=1e-6)


def test_errors_are_as_large_as_said() -> None:
    motion, off_2d, off_3d = walk(), [], []
    for seed in range(12):
        exact, noisy = (
            seen(motion, "fixed", noise, np.random.default_rng(seed)) for noise in (EXACT, SightNoise(dropped=0.0))
        )
        tall = np.ptp(exact.track.pixels[:, :, 1], axis=1)[:, None]
        off_2d.append(np.nanmean(np.linalg.norm(noisy.track.pixels - exact.track.pixels, axis=2) / tall))
        assert noisy.track.positions is not None
        assert exact.track.positions is not None
        off_3d.append(np.nanmean(np.linalg.norm(noisy.track.positions - exact.track.positions, axis=2)))
    assert 0.01 < np.mean(off_2d) < 0.03
    assert 0.08 < np.mean(off_3d) < 0.11


def test_hard_sights_and_gaps_lack_what_they_say() -> None:
    motion = walk()
    hard = seen(motion, "pan", replace(HARD, gap=GAP), np.random.default_rng(0)).track
    nobody = (hard.confidence == 0).all(axis=1)
    assert nobody.sum() == GAP
    assert np.isnan(hard.positions[nobody]).all()
    assert 0.15 < (hard.confidence[~nobody] == 0).mean() < 0.3
    alone = seen(motion, "pan", SightNoise(), np.random.default_rng(0)).track
    other = seen(motion, "pan", SightNoise(wrong=4), np.random.default_rng(0)).track
    both = np.isfinite(alone.pixels).all(axis=2) & np.isfinite(other.pixels).all(axis=2)
    apart = np.where(both, np.linalg.norm(alone.pixels - other.pixels, axis=2), 0.0).max(axis=1)
    assert set(np.flatnonzero(apart > 1.0)) <= set(range(len(motion) // 2, len(motion) // 2 + 4))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_a_guess_is_off_by_what_it_may_be(seed: int, turn: float) -> None:
    true = Scene(boxes=(Box("box", (0.5, 0.7), (1.5, -0.5), 0.3, 0.4),))
    start = np.array([0.5, 0.25])
    guess = guessed_scene(true, "pan", turn, start, np.random.default_rng(seed))
    box = guess.boxes[0]
    c, s = np.cos(turn), np.sin(turn)
    back = np.array([[c, -s], [s, c]]) @ box.place + start
    assert np.linalg.norm(back - [1.5, -0.5]) <= 0.15 * np.sqrt(2) + 2e-3
    assert abs(box.height - 0.3) <= 0.2 + 1e-3
    assert box.yaw + turn == pytest.approx(0.4, abs=1e-3)
    assert guess.camera.motion == "pan"


def test_every_clip_that_comes_along_comes_back_to_the_bit() -> None:
    humanoid = humanoid_of(compose_config("reconstruct"))
    names = clip_names(clips_folder(""), ())
    assert len(names) >= 6
    for name in names:
        clip = read_true_clip(clips_folder("") / name, humanoid)
        assert 60 <= len(clip.simulated) <= 130
        assert clip.feet.any(axis=0).all()
        head = clip.part(humanoid, 0, len(clip.simulated)).motion.forward_kinematics()[0][:, humanoid.head, 2]
        assert head[-1] > 0.9  # nobody lies
        touched = {contact.touches for contact in clip.scene.contacts}
        assert {box.name for box in clip.scene.boxes} <= touched


def test_a_clip_of_another_body_or_damaged_is_refused(tmp_path: Path) -> None:
    humanoid = humanoid_of(compose_config("reconstruct"))
    shutil.copytree(clips_folder("") / CLIP, tmp_path / CLIP)
    path = tmp_path / CLIP / "truth.npz"
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "ctrl": arrays["ctrl"] + 0.01})
    with pytest.raises(InputError, match="does not come back"):
        read_true_clip(path.parent, humanoid)
    np.savez(path, **{**arrays, "qpos": arrays["qpos"][:, :-1]})
    with pytest.raises(InputError, match="coordinates"):
        read_true_clip(path.parent, humanoid)


@pytest.fixture(scope="module")
def short_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first second of a clip."""
    folder = tmp_path_factory.mktemp("short") / CLIP
    folder.mkdir()
    arrays = dict(np.load(clips_folder("") / CLIP / "truth.npz"))
    cut = {name: arrays[name][: 40 - (name == "ctrl")] for name in ("qpos", "qvel", "ctrl")}
    np.savez(folder / "truth.npz", **{**arrays, **cut})
    scene = read_scene(clips_folder("") / CLIP / "scene.yaml")
    (folder / "scene.yaml").write_text(f"fps: {scene.fps}\n")
    return folder.parent


def test_a_clip_from_end_to_end(short_source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    words = ["scenes", "--json", "--cameras", "fixed", "--noise", "none", f"source={short_source}", f"folder={out}"]
    bench.main(words)
    first = json.loads(capsys.readouterr().out)
    rows = {row["motion"]: row for row in first["rows"]}
    assert list(rows) == ["still", "anchored", "kinematic"]
    row = rows["kinematic"]
    # What stands still is furthest off.
    assert rows["still"]["root_percent"] > 2 * max(rows[name]["root_percent"] for name in ("anchored", "kinematic"))
    assert row["mpjpe_mm"] < 80
    assert row["contact_accuracy"] > 0.7
    folder = out / f"{CLIP}.fixed.none.0"
    assert (folder / "page.html").is_file()
    # The truth, turned into the scene's world, stands in for a reconstruction with physics: only its world differs.
    shutil.copy(short_source / CLIP / "truth.npz", folder / "plan.npz")
    (folder / "seen" / "turn.json").write_text(json.dumps({"turn": 0.0}))
    bench.main([*words, "--judge-only"])
    judged = json.loads(capsys.readouterr().out)
    by_motion = {row["motion"]: row for row in judged["rows"]}
    assert by_motion["simulated"]["root_furthest_m"] == pytest.approx(0.0, abs=1e-9)
    assert by_motion["simulated"]["contact_accuracy"] == 1.0
    assert by_motion["kinematic"]["mpjpe_mm"] > row["mpjpe_mm"]
    assert {mean["motion"] for mean in judged["by_camera"]} == {"still", "anchored", "kinematic", "simulated"}
    assert "| simulated | fixed | none |" in tables(judged)


def test_what_cannot_be_prepared_is_a_row_that_says_why(short_source: Path, tmp_path: Path) -> None:
    result = scenes.run([f"source={short_source}", f"folder={tmp_path}", "judge_only=true", "cameras=pan"], 1)
    assert "body.npz" in result["rows"][0]["failed"]
    assert by_camera([]) == result["by_camera"]
    assert "## Failed" in tables(result)
