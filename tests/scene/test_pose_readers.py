"""Poses of other programs: files written by hand in the programs' own words, and what is refused."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.walking import walking

from egopose.core.errors import InputError
from egopose.motion.io import write_motion
from egopose.motion.rotations import Array
from egopose.scene.poses.keypoints import BLAZEPOSE_33, BODY_25, COCO_18, HUMANOID_JOINTS, converted
from egopose.scene.poses.readers import read_poses
from egopose.scene.poses.track import PoseTrack, load_track


def person(x: float, y: float, size: float = 200.0, confidence: float = 0.9) -> list[float]:
    """BODY_25 rows of somebody who stands at (x, y), no two keypoints alike."""
    rng = np.random.default_rng(3)
    places = rng.uniform(-0.5, 0.5, size=(25, 2)) * size * np.array([0.4, 1.0]) + [x, y]
    return [float(v) for row in places for v in (*row, confidence)]


def write(folder: Path, frames: dict[int, list[list[float]]], name: str = "video") -> Path:
    """As OpenPose 1.7 writes them, with the empty lists that it adds for hands and face."""
    folder.mkdir(exist_ok=True)
    empty: dict[str, Any] = {"face_keypoints_2d": [], "hand_left_keypoints_2d": [], "pose_keypoints_3d": []}
    for t, people in frames.items():
        card = {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": p, **empty} for p in people]}
        (folder / f"{name}_{t:012d}_keypoints.json").write_text(json.dumps(card))
    return folder


def test_openpose_rows_lie_where_its_manual_puts_them(tmp_path: Path) -> None:
    """Numbers of the keypoints in OpenPose's documentation (doc/02_output.md, BODY_25)."""
    rows = np.zeros((25, 3))
    rows[:, 0], rows[:, 1], rows[:, 2] = np.arange(25) + 1.0, 100.0, 0.5
    track = read_poses(write(tmp_path / "json", {0: [rows.ravel().tolist()]}), fps=30.0)
    manual = {0: "nose", 1: "neck", 4: "right_wrist", 7: "left_wrist", 8: "mid_hip", 9: "right_hip", 11: "right_ankle"}
    manual |= {12: "left_hip", 14: "left_ankle", 15: "right_eye", 18: "left_ear", 19: "left_big_toe"}
    manual |= {20: "left_small_toe", 21: "left_heel", 22: "right_big_toe", 24: "right_heel"}
    for row, name in manual.items():
        assert track.pixels[0, BODY_25.index(name), 0] == row + 1.0
    assert np.isclose(track.confidence, 0.5).all()


def test_the_person_followed_stays_the_same(tmp_path: Path) -> None:
    """Two people swap their places in the list, one is missing for a while, a file too; a frame is empty."""
    frames: dict[int, list[list[float]]] = {}
    for t in range(40):
        mine, other = person(300 + 4 * t, 300), person(900 - 4 * t, 320, 150, 0.95)
        frames[t] = [mine, other] if t % 2 else [other, mine]
    frames[10] = frames[11] = [frames[10][1 if 10 % 2 else 0]]  # the other one alone
    frames[20] = []
    del frames[25]
    track = read_poses(write(tmp_path / "json", frames), fps=30.0, image_size=(1280, 720))
    assert len(track) == 40
    found = np.isfinite(track.pixels).all(axis=(1, 2))
    assert np.flatnonzero(~found).tolist() == [10, 11, 20, 25]
    for t in np.flatnonzero(found):
        want = np.array(person(300 + 4 * t, 300)).reshape(25, 3)[:, :2]
        np.testing.assert_allclose(track.pixels[t], want)
    assert any("2 people" in note for note in track.notes)


def test_who_is_pointed_at_is_followed(tmp_path: Path) -> None:
    frames = {t: [person(300, 300), person(900, 300, 150)] for t in range(5)}
    track = read_poses(write(tmp_path / "json", frames), fps=30.0, at=(880.0, 310.0))
    assert (track.pixels[..., 0] > 700).all()


def test_a_keypoint_of_zeros_is_unknown(tmp_path: Path) -> None:
    rows = person(300, 300)
    rows[12:15] = [0.0, 0.0, 0.0]
    track = read_poses(write(tmp_path / "json", {7: [rows]}), fps=30.0)
    assert np.isnan(track.pixels[0, 4]).all()
    assert track.confidence[0, 4] == 0
    assert np.isfinite(np.delete(track.pixels, 4, axis=1)).all()


@pytest.mark.parametrize(
    ("spoil", "field"),
    [
        (lambda card: card.pop("people"), "people"),
        (lambda card: card["people"][0]["pose_keypoints_2d"].pop(), "people[0].pose_keypoints_2d"),
        (lambda card: card["people"][0]["pose_keypoints_2d"].__setitem__(0, "12"), "people[0].pose_keypoints_2d"),
        (lambda card: card["people"][0]["pose_keypoints_2d"].__setitem__(0, float("nan")), "pose_keypoints_2d"),
        (lambda card: card["people"][0]["pose_keypoints_2d"].__setitem__(2, 7.0), "people[0].pose_keypoints_2d"),
        (lambda card: card.__setitem__("people", card["people"] * 300), "people"),
    ],
)
def test_a_spoilt_file_is_named_with_its_field(tmp_path: Path, spoil: Any, field: str) -> None:
    folder = write(tmp_path / "json", {t: [person(300, 300)] for t in range(3)})
    file = folder / f"video_{1:012d}_keypoints.json"
    card = json.loads(file.read_text())
    spoil(card)
    file.write_text(json.dumps(card))
    with pytest.raises(InputError) as error:
        read_poses(folder, fps=30.0)
    assert error.value.source == str(file)
    assert field in error.value.field


def test_folders_that_are_no_video(tmp_path: Path) -> None:
    folder = write(tmp_path / "json", {0: [person(300, 300)]})
    with pytest.raises(InputError, match="fps=RATE"):
        read_poses(folder)
    with pytest.raises(InputError, match="option colour"):
        read_poses(folder, fps=30.0, colour="red")
    write(folder, {0: [person(300, 300)]}, name="another")
    with pytest.raises(InputError, match="twice"):
        read_poses(folder, fps=30.0)
    with pytest.raises(InputError, match="no frame of 3 has anyone"):
        read_poses(write(tmp_path / "nobody", {0: [], 2: []}), fps=30.0)
    shares = np.array(person(0.5, 0.5, 0.5)).tolist()
    with pytest.raises(InputError, match="keypoint_scale 0"):
        read_poses(write(tmp_path / "shares", {0: [shares]}), fps=30.0)
    far = write(tmp_path / "far", {0: [person(300, 300)], 999_999_999: [person(300, 300)]})
    with pytest.raises(InputError, match="frames"):
        read_poses(far, fps=30.0)


class Bomb:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return exec, ("raise SystemExit('a pickle was opened')",)


@pytest.mark.parametrize(
    ("name", "way"), [("vibe_output.pkl", "from joblib import load"), ("hmr4d_results.pt", "from torch import load")]
)
def test_a_pickle_is_refused_with_the_way_to_convert_it(tmp_path: Path, name: str, way: str) -> None:
    (tmp_path / name).write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match=way) as error:
        read_poses(tmp_path / name, fps=30.0)
    assert name in str(error.value)


def test_a_pickle_within_an_npz_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", joints3d=np.array([Bomb()], dtype=object))
    with pytest.raises(InputError, match="pickled"):
        read_poses(tmp_path / "a.npz", fps=30.0)


def test_vibe_joints_are_hip_centred_and_missing_frames_stay_missing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(4, 49, 3)).astype(np.float32)
    np.savez(tmp_path / "person1.npz", joints3d=joints, pose=np.zeros((4, 72)), frame_ids=np.array([5, 6, 9, 10]))
    track = read_poses(tmp_path / "person1.npz", fps=25.0)
    assert (len(track), track.fps, track.axes) == (6, 25.0, "camera")
    assert track.positions is not None
    # SPIN's list of joints: 8 is OP MidHip, 10 is OP RKnee.
    np.testing.assert_allclose(track.positions[4, BODY_25.index("right_knee")], joints[2, 10] - joints[2, 8])
    assert np.flatnonzero(np.isnan(track.positions).all(axis=(1, 2))).tolist() == [2, 3]


def rest_pose(names: tuple[str, str, str | None]) -> dict[str, Array]:
    """SMPL's rest pose of ten frames under a program's names: y up, arms sideways, moving ahead."""
    turns, body, place = names
    trans = np.zeros((10, 3))
    trans[:, 2] = 0.02 * np.arange(10)
    out = {turns: np.zeros((10, 72 if place is None else 3)), body: trans if place is None else np.zeros((10, 63))}
    return out if place is None else out | {place: trans}


@pytest.mark.parametrize(
    "names", [("pose_world", "trans_world", None), ("global_orient", "body_pose", "transl")], ids=["WHAM", "GVHMR"]
)
def test_smpl_parameters_stand_upright_with_the_left_at_the_left(tmp_path: Path, names: Any) -> None:
    np.savez(tmp_path / "person.npz", **rest_pose(names))
    track = read_poses(tmp_path / "person.npz", fps=30.0)
    assert track.positions is not None
    assert track.axes == "world"

    def at(name: str) -> Array:
        assert track.positions is not None
        return track.positions[:, BODY_25.index(name)]

    up = at("neck") - at("mid_hip")
    assert (up[:, 2] > 0.4).all()
    ahead = at("left_big_toe") - at("left_ankle")
    left = at("left_hip") - at("right_hip")
    assert (np.cross(ahead, left)[:, 2] > 0).all()
    walked = at("mid_hip")[-1] - at("mid_hip")[0]
    assert np.isclose(np.linalg.norm(walked), 0.18)
    assert walked @ ahead[0] > 0


@pytest.mark.parametrize("ending", [".bvh", ".trc", ".c3d"])
def test_a_motion_file_gives_its_joints(tmp_path: Path, ending: str) -> None:
    motion = walking().slice(0, 20)
    path = tmp_path / f"walk{ending}"
    write_motion(motion, path)
    track = read_poses(path)
    positions = motion.forward_kinematics()[0]
    assert track.positions is not None
    for keypoint, joint in HUMANOID_JOINTS.items():
        there = track.positions[:, BODY_25.index(keypoint)]
        away = np.linalg.norm(there - positions[:, motion.skeleton.index(joint)], axis=1)
        # A body fitted to points has bones of constant length; places are told to a millimetre by BVH.
        assert away.max() < (2e-3 if ending == ".bvh" else 2e-2), keypoint


def test_a_layout_turns_into_another_by_name() -> None:
    rng = np.random.default_rng(1)
    pixels, confidence = rng.uniform(0, 500, (3, 33, 2)), rng.uniform(0.1, 1, (3, 33))
    out, sure = converted(pixels, confidence, BLAZEPOSE_33, BODY_25)
    # MediaPipe's numbers: 11, 12 shoulders; 23, 24 hips; 25 left knee; 32 right foot index.
    np.testing.assert_allclose(out[:, 13], pixels[:, 25])
    np.testing.assert_allclose(out[:, 1], (pixels[:, 11] + pixels[:, 12]) / 2)
    np.testing.assert_allclose(sure[:, 8], np.minimum(confidence[:, 23], confidence[:, 24]))
    np.testing.assert_allclose(out[:, 22], pixels[:, 32])
    assert np.isnan(out[:, BODY_25.index("left_small_toe")]).all()


@pytest.mark.parametrize("schema", [BODY_25, COCO_18, BLAZEPOSE_33])
def test_the_mirror_of_a_mirror_is_the_layout(schema: Any) -> None:
    assert (schema.mirror[schema.mirror] == np.arange(len(schema))).all()
    assert (schema.mirror != np.arange(len(schema))).sum() == sum("_" in n and n != "mid_hip" for n in schema.names)


def test_a_saved_track_comes_back_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    track = PoseTrack(
        BODY_25,
        rng.normal(size=(4, 25, 2)),
        rng.uniform(size=(4, 25)),
        29.97,
        (640, 480),
        rng.normal(size=(4, 25, 3)),
        axes="world",
        filled=rng.random((4, 25)) > 0.5,
        swapped=np.array([True, False, False, True]),
        weights=rng.uniform(size=4),
        person="2",
        notes=("one thing", "another"),
    )
    track.save(tmp_path / "a.npz")
    again = read_poses(tmp_path / "a.npz")
    for name in ("pixels", "confidence", "positions", "filled", "swapped", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(track, name))
    for name in ("schema", "fps", "image_size", "axes", "person", "notes"):
        assert getattr(again, name) == getattr(track, name)
    np.savez(tmp_path / "b.npz", pose_layout=np.frombuffer(b"BODY_25", np.uint8), pixels=np.zeros((2, 24, 2)))
    with pytest.raises(InputError, match="confidence"):
        load_track(tmp_path / "b.npz")
