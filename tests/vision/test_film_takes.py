"""Takes filmed by many cameras in many places (``vision=film``): what is drawn, recorded, refused and left alone."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name
from egopose.vision.corruption import Corruption
from egopose.vision.film_takes import FilmRanges, draw_take, film_frames
from egopose.vision.takes import RenderConfig, RenderJob, is_rendered, job_fingerprint, render_take
from egopose.vision.video import read_frames


def vision(**film: Any) -> dict[str, Any]:
    values = compose_config("prepare", ["vision=film"])["vision"]
    return {**values, "video": {"fps": 30, "size": 64}, "film": {**values["film"], **film}}


def job(folder: Path, name: str = "a") -> RenderJob:
    return RenderJob(name, default_humanoid().xml, walking().qpos[:4], folder / f"{name}.mp4", "train")


def test_takes_draw_every_camera_and_place_within_the_ranges() -> None:
    config = RenderConfig.from_mapping(vision())
    assert config.film is not None
    takes = [draw_take(seed, config.film, config.camera) for seed in range(400)]
    for field, known in (("place", config.film.places), ("mount", config.film.mounts), ("lens", config.film.lenses)):
        drawn = [getattr(take, field) for take in takes]
        shares = np.array([drawn.count(key) for key in known]) / len(takes)
        expected = np.array(list(known.values())) / sum(known.values())
        np.testing.assert_allclose(shares, expected, atol=0.08)
    assert {take.aspect for take in takes} == {"1:1", "4:3", "16:9"}
    for take in takes:
        widest = 110.0 if take.lens == "pinhole" else 125.0
        assert 60.0 <= take.across_width <= widest
        assert 0.0 <= np.rad2deg(take.worn.pitch_down) <= 45.0
    assert np.mean([take.people for take in takes]) == pytest.approx(0.3, abs=0.07)
    assert draw_take(7, config.film, config.camera) == takes[7]


def test_the_stored_square_is_the_middle_of_the_cameras_picture() -> None:
    """Half the height of the whole picture, by each lens's own law."""
    config = RenderConfig.from_mapping(vision(aspects={"16:9": 1.0}))
    assert config.film is not None
    for seed in range(20):
        take = draw_take(seed, config.film, config.camera)
        half, square = np.deg2rad([0.5 * take.across_width, 0.5 * take.worn.field_of_view])
        law = np.tan if take.lens == "pinhole" else np.asarray
        assert law(square) / law(half) == pytest.approx(9 / 16)


def test_a_take_is_rendered_and_its_camera_recorded(tmp_path: Path) -> None:
    config = RenderConfig.from_mapping(vision(places={"room": 1.0}, mounts={"held": 1.0}, lenses={"fisheye": 1.0}))
    one = job(tmp_path)
    assert render_take(one, config) == 4
    assert is_rendered(one, config)
    assert not is_rendered(one, replace(config, film=replace(config.film, people=1.0)))
    record = json.loads(one.path.with_suffix(".json").read_text())
    assert (record["camera"]["mount"], record["camera"]["lens"], record["place"]["kind"]) == ("held", "fisheye", "room")
    assert 0.0 <= record["camera"]["pitch_down"] <= 45.0
    assert 30.0 <= record["camera"]["field_of_view"] <= 125.0
    frames = [frame for _, frame in read_frames(one.path)]
    assert len(frames) == 4
    assert frames[0].shape == (64, 64, 3)
    again = RenderJob(one.name, one.model_xml, one.qpos, tmp_path / "again.mp4", "train")
    render_take(again, config)
    np.testing.assert_array_equal(frames, [frame for _, frame in read_frames(again.path)])


def test_other_takes_keep_their_fingerprints_and_the_films_have_their_own(tmp_path: Path) -> None:
    """Of the settings as they were before there were films, taken then."""
    light = compose_config("prepare")
    plain = RenderConfig.from_mapping(light["vision"])
    known = {key for key, value in asdict(plain).items() if value is not None}
    assert known == {"size", "fps", "room", "camera"}
    assert flow_name(light) == "medium-32-cc3d37a4"
    assert job_fingerprint(job(tmp_path), plain) != job_fingerprint(job(tmp_path), RenderConfig.from_mapping(vision()))
    film = compose_config("prepare", ["vision=film"])
    more = compose_config("prepare", ["vision=film", "vision.film.people=0.9"])
    assert len({flow_name(light), flow_name(film), flow_name(more)}) == 3


def test_dropped_frames_of_a_film_repeat_the_one_before() -> None:
    config = RenderConfig.from_mapping(vision(places={"room": 1.0}))
    assert config.film is not None
    take = draw_take(1, config.film, config.camera)
    dropped = Corruption(jitter=0.0, drift=0.0, shake=0.0, shake_rate=1.0, dropped=0.9, seed=0)
    xml, qpos = default_humanoid().xml, walking().qpos[:6]
    clean, torn = (list(film_frames(xml, qpos, take, 1, config.room, 32, 30.0, wrong)) for wrong in (None, dropped))
    shown = dropped.shown(dropped.generator(take.seed), 6)
    assert (shown < np.arange(6)).any()
    # What else is drawn for the corruption comes before, and is nothing here.
    assert {frame.tobytes() for frame in torn} <= {frame.tobytes() for frame in clean}
    assert len({frame.tobytes() for frame in torn}) < len({frame.tobytes() for frame in clean})


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"places": {"moon": 1.0}}, "film.places"),
        ({"mounts": {}}, "film.mounts"),
        ({"lenses": {"pinhole": 0.0}}, "film.lenses"),
        ({"aspects": {"4:3": -1.0}}, "film.aspects"),
        ({"people": 1.5}, "film.people"),
        ({"pinhole_widest": 300.0}, "film.pinhole_widest"),
        ({"dogs": 1.0}, "dogs"),
    ],
)
def test_ranges_that_cannot_be_are_refused(changed: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        FilmRanges.from_mapping(vision(**changed)["film"])


def test_a_motion_without_frames_is_refused() -> None:
    config = RenderConfig.from_mapping(vision())
    assert config.film is not None
    take = draw_take(0, config.film, config.camera)
    with pytest.raises(InputError, match="without frames"):
        next(film_frames(default_humanoid().xml, np.zeros((0, 65)), take, 0, config.room, 64, 30.0))
