"""Whether a motion follows its film: each part falls alone when only it is wrong, and the sentence names the worst."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.inference.film_agreement import film_agreement, signal_agreement, steps_of
from egopose.inference.film_states import FilmReading
from egopose.vision.head_signal import HeadSignal, signal_of_motion
from egopose.vision.mounts import camera_poses, mount_of

FPS, COUNT = 30.0, 240
ALL = {"turning", "speed", "bob", "worn", "seen", "rigid", "measured"}


def walker() -> HeadSignal:
    """One who walks at 0.8 heights/s, turns to and fro, and bobs and rolls with two steps a second."""
    times = np.arange(COUNT) / FPS
    turning, velocity = np.zeros((COUNT, 3)), np.zeros((COUNT, 3))
    turning[:, 2] = 0.8 * np.sin(2 * np.pi * 0.2 * times)
    turning[:, 0] = 0.2 * np.sin(2 * np.pi * 2.0 * times)
    velocity[:, 0], velocity[:, 2] = 0.8, 0.15 * np.sin(2 * np.pi * 2.0 * times)
    return HeadSignal(turning, velocity, np.zeros((COUNT, 2)), np.ones((COUNT, 3)))


def test_equal_signals_agree() -> None:
    found = signal_agreement(walker(), walker(), FPS)
    assert found.mean > 0.98
    assert found.verdict == "yes"
    assert found.sentence == f"follows the film: yes ({found.mean:.2f})"
    assert set(found.parts) == ALL
    assert set(found.columns()) == {"follows_film", *(f"film_{name}" for name in ALL)}
    assert all(column.shape == (COUNT,) for column in found.columns().values())


def changed(name: str) -> tuple[HeadSignal, HeadSignal]:
    """A body and a film that differ in one thing."""
    body = film = walker()
    if name == "turning":
        body = replace(body, turning=-body.turning)
    elif name == "speed":
        body = replace(body, velocity=body.velocity * [-0.5, 1.0, 1.0])
    elif name == "bob":
        film = replace(film, velocity=film.velocity * [1.0, 1.0, 0.0])
    elif name == "worn":
        film = replace(film, turning=film.turning * [0.02, 1.0, 1.0])
    else:
        quality = np.ones((COUNT, 3))
        quality[:, {"measured": 0, "seen": 1, "rigid": 2}[name]] = 0.05
        film = replace(film, quality=quality)
    return body, film


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("turning", "turns otherwise"),
        ("speed", "moves otherwise"),
        ("bob", "does not bob"),
        ("worn", "too steady to be worn"),
        ("measured", "as the gyroscope does"),
        ("seen", "no ground is seen"),
        ("rigid", "things that stand still"),
    ],
)
def test_what_differs_lowers_its_own_part_and_is_said(name: str, said: str) -> None:
    found = signal_agreement(*changed(name), FPS)
    means = {part: float(values.mean()) for part, values in found.parts.items()}
    assert means.pop(name) < 0.35
    assert min(means.values()) > 0.98
    assert found.verdict != "yes"
    assert said in found.sentence
    assert f"({found.mean:.2f})" in found.sentence


def test_only_the_wrong_half_of_a_film_is_blamed() -> None:
    body = walker()
    turning = body.turning.copy()
    turning[COUNT // 2 :] *= -1
    found = signal_agreement(replace(body, turning=turning), walker(), FPS)
    assert found.score[: COUNT // 2 - 60].min() > 0.9
    assert found.score[-60:].mean() < 0.7


def test_standing_people_who_sway_apart_agree() -> None:
    rng = np.random.default_rng(0)

    def standing() -> HeadSignal:
        still = HeadSignal(np.zeros((90, 3)), np.zeros((90, 3)), np.zeros((90, 2)), np.ones((90, 3)))
        return replace(still, turning=0.03 * rng.normal(size=(90, 3)), velocity=0.02 * rng.normal(size=(90, 3)))

    assert signal_agreement(standing(), standing(), FPS).verdict == "yes"


def test_the_band_of_steps() -> None:
    times = np.arange(150) / FPS
    step, slow = np.sin(2 * np.pi * 2.0 * times), np.sin(2 * np.pi * 0.2 * times)
    np.testing.assert_allclose(steps_of(step + slow + 3.0, FPS)[30:-30], step[30:-30], atol=0.12)
    np.testing.assert_array_equal(steps_of(step[:20], FPS), 0.0)


def test_a_motion_follows_the_film_of_its_own_camera_and_not_that_of_a_stander() -> None:
    humanoid, qpos = default_humanoid(), walking().qpos
    pose = camera_poses(humanoid.mj_model, qpos, mount_of("head", 0.0, 0.4, 0.0))
    reading = FilmReading(signal_of_motion(*pose, FPS), torch.zeros(len(qpos), 1), 1.6, ())
    assert film_agreement(humanoid, qpos, reading, "head").mean > 0.9
    stander = np.repeat(qpos[:1], len(qpos), axis=0)
    against = film_agreement(humanoid, stander, reading, "head")
    assert against.parts["speed"].mean() < 0.3
    assert against.verdict == "no"
