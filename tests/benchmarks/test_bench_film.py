"""The bench of estimates from film: its motions, its measures, its words, and one small camera from end to end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from egopose import bench
from egopose.benchmarks.film_cameras import (
    Chosen,
    Shot,
    motion_of,
    read_exactly,
    shots,
    take,
    without_telemetry,
)
from egopose.benchmarks.film_clips import CLIPS, SECONDS, bench_clip, bent, looped, on_the_spot, turns
from egopose.benchmarks.film_confidence import Judged, areas, features
from egopose.benchmarks.film_measures import area_interval, measures, share_in_order, step_frequency_of_legs
from egopose.benchmarks.film_table import by_camera, tables
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.take_sources import find_sources
from egopose.evaluation.path_metrics import path_of
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.vision.head_signal import HeadSignal
from egopose.vision.telemetry import read_telemetry
from egopose.vision.video import read_frames

FPS = 30.0


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return default_humanoid()


@pytest.fixture(scope="module")
def walk(humanoid: HumanoidModel) -> Array:
    return bench_clip("walk", humanoid)


def speeds(qpos: Array) -> Array:
    return np.linalg.norm(np.diff(qpos[:, :2], axis=0), axis=1) * FPS


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_bend_turns_the_heading_by_its_integral_and_keeps_the_speed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    qpos = np.zeros((60, 10))
    qpos[:, :3] = np.cumsum(rng.normal(0, 0.05, (60, 3)), axis=0)
    qpos[:, 3:7] = rot.from_rotvec(np.cumsum(rng.normal(0, 0.02, (60, 3)), axis=0) * [1, 1, 3])
    rate = rng.normal(0, 1.0, 60)
    out = bent(qpos, rate)
    wanted = np.concatenate([[0.0], np.cumsum(rate[:-1]) / FPS])
    turned = rot.multiply(out[:, 3:7], rot.conjugate(qpos[:, 3:7]))
    assert rot.to_rotvec(turned) == pytest.approx(
        rot.to_rotvec(rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), wanted)), abs=1e-9
    )
    assert speeds(out) == pytest.approx(speeds(qpos))
    # Steps keep their direction seen from the body.
    steps = np.diff(np.pad(qpos[:, :2], ((0, 0), (0, 1))), axis=0)
    new = np.diff(np.pad(out[:, :2], ((0, 0), (0, 1))), axis=0)
    own, other = (rot.rotate(rot.conjugate(q[:-1, 3:7]), way) for q, way in ((qpos, steps), (out, new)))
    assert own == pytest.approx(other, abs=1e-9)
    assert np.array_equal(out[:, 7:], qpos[:, 7:])


def test_turns_add_up_to_their_degrees() -> None:
    times = np.arange(301) / FPS
    rate = turns(times, ((3.0, 90.0), (7.0, -45.0)))
    assert np.rad2deg(rate[:150].sum() / FPS) == pytest.approx(90.0, abs=0.1)
    assert np.rad2deg(rate.sum() / FPS) == pytest.approx(45.0, abs=0.1)


@pytest.mark.parametrize("name", ["brisk", "slow"])
def test_a_loop_goes_on_without_a_jump_and_straight_on(name: str, humanoid: HumanoidModel) -> None:
    qpos = bench_clip(name, humanoid)
    joints = np.abs(np.diff(qpos[:, 7:], axis=0)).max(axis=1)
    assert joints.max() < 0.3  # rad in 1/30 s: a brisk leg's
    assert np.abs(np.diff(qpos[:, :3], n=2, axis=0)).max() < 0.03
    # No frame differs from its neighbours more than others of the same cycle: seams do not stand out.
    jumps = np.abs(np.diff(qpos[:, 7:], n=2, axis=0)).sum(axis=1)
    assert jumps.max() < 3.0 * np.quantile(jumps, 0.95)
    path, heading = path_of(qpos)
    way = path[-1] - path[0]
    assert np.linalg.norm(way) > 0.9 * speeds(qpos).sum() / FPS
    assert abs(heading[-1] - heading[0]) < 0.4


def test_clips_do_what_their_names_say(humanoid: HumanoidModel) -> None:
    clips = {name: bench_clip(name, humanoid) for name in CLIPS}
    for name, qpos in clips.items():
        assert len(qpos) == round(SECONDS[name] * FPS) + 1
        assert np.linalg.norm(qpos[:, 3:7], axis=1) == pytest.approx(1.0, abs=1e-5)
    _, heading = path_of(clips["walk"])
    assert np.rad2deg(heading[len(heading) // 2] - heading[0]) == pytest.approx(90.0, abs=15.0)
    assert np.rad2deg(heading[-1] - heading[0]) == pytest.approx(0.0, abs=15.0)
    path, heading = path_of(clips["turning"])
    assert np.linalg.norm(path - path[0], axis=1).max() < 0.4
    assert np.ptp(np.rad2deg(heading)) > 75.0
    assert speeds(clips["standing"]).max() < 0.06
    assert speeds(clips["standing"]).mean() > 0.001
    mean = {name: speeds(clips[name]).mean() for name in ("walk", "brisk", "slow")}
    assert mean["slow"] < 1.1 < 1.3 < mean["walk"] < mean["brisk"]


def test_no_clip_of_the_bench_is_data_to_train_on() -> None:
    sources = find_sources(compose_config("train")["data"])
    assert sources
    assert not [source for source in sources if "bench" in source.motion.parts]


def test_what_stands_where_it_was_has_no_way(walk: Array) -> None:
    still = on_the_spot(walk)
    assert still[-1, :2] == pytest.approx(still[0, :2])
    assert np.array_equal(still[:, 2:], walk[:, 2:])


@pytest.mark.parametrize("name", ["walk", "brisk", "slow"])
def test_the_truth_itself_is_perfect_wherever_it_starts(name: str, humanoid: HumanoidModel) -> None:
    truth = bench_clip(name, humanoid)
    moved = bent(truth, np.zeros(len(truth)))
    turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(2.0))
    moved[:, :3] = rot.rotate(turn, truth[:, :3]) + np.array([3.0, -4.0, 0.0])
    moved[:, 3:7] = rot.multiply(turn, truth[:, 3:7])
    for estimate in (truth, moved):
        told = measures(humanoid, estimate, truth)
        assert told["speed"] == pytest.approx(1.0)
        assert told["yaw_r"] == pytest.approx(1.0)
        assert told["yaw_r_raw"] == pytest.approx(1.0)
        for name_of_error in ("net_path_percent", "heading_degrees", "step_error", "e_pose", "turn_per_minute"):
            assert told[name_of_error] == pytest.approx(0.0, abs=1e-5)


def test_what_is_wrong_with_an_estimate_is_told_by_its_own_measure(humanoid: HumanoidModel, walk: Array) -> None:
    seconds = (len(walk) - 1) / FPS
    wide = walk.copy()
    wide[:, :2] *= 1.2
    assert measures(humanoid, wide, walk)["speed"] == pytest.approx(1.2)
    drifting = bent(walk, np.full(len(walk), np.deg2rad(3.0)))
    told = measures(humanoid, drifting, walk)
    assert told["turn_per_minute"] == pytest.approx(180.0, rel=0.01)
    assert told["speed"] == pytest.approx(1.0)
    # A drift grows with time; the first second is laid on the truth's.
    assert told["heading_degrees"] == pytest.approx(3.0 * (seconds - 1.0) / 2, abs=1.0)
    slow = looped(walk[::1], seconds).copy()
    slow[:, 7:] = walk[np.arange(len(walk)) // 2, 7:]
    frequency = step_frequency_of_legs(humanoid, walk)
    assert 1.5 < frequency < 2.2
    assert measures(humanoid, slow, walk)["step_error"] == pytest.approx(frequency / 2, abs=0.1)
    assert np.isnan(measures(humanoid, np.repeat(walk[:1], len(walk), axis=0), walk)["step_error"])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_the_area_is_that_of_mann_and_whitney(seed: int) -> None:
    rng = np.random.default_rng(seed)
    good, bad = rng.integers(0, 6, rng.integers(1, 20)) + 1.0, rng.integers(0, 6, rng.integers(1, 20)) * 1.0
    wanted = mannwhitneyu(good, bad).statistic / (len(good) * len(bad))
    assert share_in_order(good, bad) == pytest.approx(wanted)
    area, low, high = area_interval([np.array([g]) for g in good], [np.array([b]) for b in bad], draws=50)
    assert area == pytest.approx(wanted)
    assert 0.0 <= low <= high <= 1.0


def test_areas_have_a_row_for_each_kind_of_bad_film() -> None:
    def one(kind: str, score: float) -> Judged:
        return Judged({"kind": kind, "imu": False, "score": score}, np.full(5, score))

    films = [one("good", 0.8), one("good", 0.6), one("drone", 0.1), one("tripod", 0.7)]
    rows = {row["kind"]: row for row in areas(films)}
    assert {kind: row["films"] for kind, row in rows.items()} == {"drone": 1.0, "tripod": 0.5, "all": 0.75}
    assert rows["drone"]["films_low"] == rows["drone"]["films_high"] == 1.0


def test_features_know_noise_and_a_climb() -> None:
    def signal(velocity: Array) -> HeadSignal:
        flat = np.zeros((len(velocity), 3))
        return HeadSignal(flat, velocity, flat[:, :2], np.ones_like(flat))

    times, rng = np.arange(300) / FPS, np.random.default_rng(0)
    ahead = np.tile([0.8, 0.0, 0.0], (300, 1))
    bobbing = ahead + np.outer(0.1 * np.sin(2 * np.pi * 1.8 * times), [0, 0, 1])
    smooth, noisy, rising = (
        features(signal(one), FPS)
        for one in (bobbing, ahead + rng.normal(0, 1.0, (300, 3)), ahead + np.array([0, 0, 0.4]))
    )
    assert smooth["feature_rough"] < 0.02 < 0.4 < noisy["feature_rough"]
    assert rising["feature_rise"] == pytest.approx(0.5, rel=0.05)
    assert smooth["feature_bob"] == pytest.approx(0.1 / 2**0.5 / 0.8, rel=0.1)
    assert smooth["feature_peak"] > 0.9 > noisy["feature_peak"]


def test_a_bare_film_has_the_pictures_and_no_telemetry(humanoid: HumanoidModel, walk: Array, tmp_path: Path) -> None:
    film = take(humanoid, walk[:8], Shot(20.0, 90.0, True, "open_ground", 0, 64), tmp_path)
    bare = without_telemetry(film)
    assert read_telemetry(film) is not None
    assert read_telemetry(bare) is None
    pictures = [[frame for _, frame in read_frames(path)] for path in (film, bare)]
    assert len(pictures[0]) == len(pictures[1]) > 4
    assert all(np.array_equal(*both) for both in zip(*pictures, strict=True))


def test_words_choose_cells() -> None:
    chosen = Chosen.of(["pitch=0,20", "width=90", "imu=no", "place=street"])
    every = shots(chosen, range(2))
    assert len(every) == 2 * 1 * 2 * 1 * 2
    assert {(shot.pitch, shot.width, shot.seed) for shot in every} == {
        (p, 90.0, s) for p in (0.0, 20.0) for s in (0, 1)
    }
    assert len(shots(Chosen.of([]), range(2))) == 3 * 3 * 2 * 3 * 2
    camera = Shot(0.0, 120.0, False, "street", 0, 320).camera(imu=False)
    assert (camera.kind, camera.field_of_view) == ("fisheye", 120.0)


@pytest.mark.parametrize(
    "word",
    ["pich=0", "pitch=low", "place=moon", "clip=run", "imu=maybe", "pixels=9", "part=all", "seconds=0", "body=x"],
)
def test_a_wrong_word_is_one_line(word: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(InputError, match=word.partition("=")[0]):
        Chosen.of([word])
    with pytest.raises(SystemExit) as stop:
        bench.main(["film", "--json", word])
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_small_camera_from_end_to_end(capsys: pytest.CaptureFixture) -> None:
    cell = ["pitch=20", "width=90", "stabilised=no", "place=street", "pixels=160", "seconds=3"]
    bench.main(["film", "--json", "--rounds", "1", "part=cameras", *cell])
    told = capsys.readouterr().out
    result = json.loads(told)
    assert [(row["imu"], row["seed"], row["clip"]) for row in result["cameras"]] == [
        (True, 0, "walk"),
        (False, 0, "walk"),
    ]
    for row in result["cameras"]:
        assert 0.5 < row["speed"] < 1.6
        assert row["heading_degrees"] < 30.0
        assert 0.0 <= row["score"] <= 1.0
    assert [row["films"] for row in result["by_camera"]] == [1, 1]
    assert result["by_camera"] == by_camera(result["cameras"])
    lines = tables(result).splitlines()
    assert lines[0] == "## Cameras"
    assert lines[4].startswith("| 20 | 90 | no | yes | 1 |")


def test_a_camera_known_exactly_gives_the_walk(humanoid: HumanoidModel, walk: Array) -> None:
    told = measures(humanoid, motion_of(humanoid, read_exactly(humanoid, walk, 20.0)), walk)
    assert told["speed"] == pytest.approx(1.0, abs=0.1)
    assert told["yaw_r"] > 0.9
    assert told["step_error"] < 0.1
    assert told["heading_degrees"] < 10.0
