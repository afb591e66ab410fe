"""Corrupted video: the camera turns as said, frames stay away as said, and clean stores stay what they were."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers.mocap import default_humanoid

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.result_files import write_json
from egopose.data.preparation import flow_name
from egopose.vision.corruption import Corruption
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.rendering import wearer_frames
from egopose.vision.takes import RenderConfig, RenderJob, job_fingerprint

NOISE = Path(__file__).resolve().parents[2] / "experiments" / "noise"
STILL = Corruption(jitter=0.0, drift=0.0, shake=0.0, shake_rate=4.0, dropped=0.0, seed=0)
FPS = 30.0


def degrees(corruption: Corruption, count: int = 3000, take: int = 1) -> np.ndarray:
    return np.rad2deg(corruption.angles(corruption.generator(take), count, FPS))


def test_jitter_is_new_every_frame_and_drift_a_random_walk() -> None:
    jitter = degrees(replace(STILL, jitter=2.0))
    np.testing.assert_allclose(jitter.std(axis=0), 2.0, rtol=0.1)
    assert abs(np.corrcoef(jitter[1:, 0], jitter[:-1, 0])[0, 1]) < 0.1
    walks = np.stack([degrees(replace(STILL, drift=3.0), count=271, take=take) for take in range(300)])
    assert (walks[:, 0] == 0).all()
    # 3 degrees a root of a second: after 1, 4 and 9 seconds.
    for second, wanted in ((1, 3.0), (4, 6.0), (9, 9.0)):
        np.testing.assert_allclose(walks[:, 30 * second].std(axis=0), wanted, rtol=0.15)


def test_shake_is_a_sine_of_its_rate() -> None:
    swing = degrees(replace(STILL, shake=1.5, shake_rate=3.0), count=300)
    assert np.abs(swing).max() == pytest.approx(1.5, rel=0.01)
    spectrum = np.abs(np.fft.rfft(swing[:, 0]))
    assert np.fft.rfftfreq(300, 1 / FPS)[spectrum.argmax()] == pytest.approx(3.0)
    assert len(set(np.round(swing[0], 3))) == 3


def test_a_dropped_frame_shows_the_last_that_came() -> None:
    corruption = replace(STILL, dropped=0.3)
    shown = corruption.shown(corruption.generator(1), 4000)
    assert shown[0] == 0
    assert (np.diff(shown) >= 0).all()
    came = shown == np.arange(4000)
    assert came.mean() == pytest.approx(0.7, abs=0.03)
    assert (shown[1:][~came[1:]] == shown[:-1][~came[1:]]).all()
    again = corruption.shown(corruption.generator(1), 4000)
    assert (again == shown).all()
    assert (corruption.shown(corruption.generator(2), 4000) != shown).any()


def test_settings_are_read_by_name() -> None:
    config = compose_config("prepare", ["corruption=all"])
    assert Corruption.from_config(config) == Corruption(1.0, 3.0, 1.5, 4.0, 0.1, 0)
    for clean in (compose_config("prepare"), compose_config("train"), compose_config("prepare", ["corruption=none"])):
        assert Corruption.from_config(clean) is None
    for name in ("train", "baseline"):
        assert Corruption.from_config(compose_config(name, ["corruption=jitter"])) == replace(STILL, jitter=1.0)
    with pytest.raises(InputError, match="dropped: must be a share under 1"):
        Corruption.from_config(compose_config("prepare", ["corruption=dropped", "corruption.dropped=1"]))
    with pytest.raises(InputError, match="jitter"):
        Corruption.from_config({"corruption": {**config["corruption"], "jitter": -1.0}})


def test_clean_videos_and_flow_keep_their_names(tmp_path: Path) -> None:
    clean, none, jitter = (
        compose_config("prepare", words) for words in ([], ["corruption=none"], ["corruption=jitter"])
    )
    assert flow_name(clean) == flow_name(none) != flow_name(jitter)
    # Of the light vision and the default data, before there were corruptions.
    assert flow_name(clean) == "medium-32-cc3d37a4"
    job = RenderJob("walk", "<mujoco/>", np.zeros((2, 7)), tmp_path / "walk.mp4", "train")
    usual = RenderConfig.from_mapping(clean["vision"])
    corrupted = RenderConfig.from_mapping(clean["vision"], Corruption.from_config(jitter))
    assert job_fingerprint(job, usual) != job_fingerprint(job, corrupted)


def test_what_is_seen_is_the_camera_turned() -> None:
    """A body that stands still: flow is the camera's turn alone, and nothing where a frame did not come."""
    humanoid = default_humanoid()
    config = RenderConfig.from_mapping(compose_config("prepare")["vision"])
    camera = replace(config.camera, shake=(0.0, 0.0), field_of_view=(90.0, 90.0), roll=(0.0, 0.0), yaw=(0.0, 0.0))
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (24, 1))
    qpos[:, 2] = 0.95
    size, corruption = 96, replace(STILL, jitter=1.0, dropped=0.2)
    try:
        frames = list(
            wearer_frames(
                humanoid.xml,
                qpos,
                room_seed=1,
                take_seed=1,
                room=config.room,
                camera=camera,
                size=size,
                fps=FPS,
                corruption=corruption,
            )
        )
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    flow = np.stack(list(flow_of_frames(iter(frames), FlowConfig("medium", size, 32, 1)))).astype(float)
    rng = corruption.generator(1)
    angles, shown = corruption.angles(rng, 24, FPS), corruption.shown(rng, 24)
    stood = np.flatnonzero(np.diff(shown) == 0) + 1
    assert len(stood) > 1
    assert np.abs(flow[stood]).max() == 0
    # 90 degrees wide: a pitch of one radian moves the middle by half a width, and a pitch down moves all up.
    middle = np.median(flow[1:, 1, 12:20, 12:20], axis=(1, 2))
    turns = np.diff(angles[shown], axis=0)
    by_pitch = np.linalg.lstsq(turns, middle, rcond=None)[0][1]
    assert by_pitch == pytest.approx(-0.5, abs=0.05)
    assert np.corrcoef(turns[:, 1], middle)[0, 1] < -0.97


@pytest.fixture(scope="module")
def table() -> ModuleType:
    return _script("table")


def _script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"noise_{name}", NOISE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def raw(method: str, corruption: str, error: float, seed: int = 0) -> dict[str, Any]:
    figures = {name: [error, 2 * error] for name in ("E_pose", "E_vel", "A_accl", "mpjpe_root_aligned")}
    names = {"method": method, "fold": "subject2", "trained": "clean", "seed": seed, "corruption": corruption}
    settings = compose_config("prepare", [f"corruption={corruption}"])["corruption"]
    return {
        **names,
        "settings": settings,
        "takes": ["a", "b"],
        "figures": figures,
        "resets": [1, 0],
        "frames": [30, 30],
    }


def test_the_table_sets_corrupted_beside_clean(table: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    made = [
        raw("ours", "none", 1.0),
        raw("ours", "jitter", 1.2),
        raw("ours", "none", 3.0, seed=1),
        raw("posereg", "none", 2.0),
    ]
    for k, one in enumerate(made):
        write_json(tmp_path / "raw" / f"{k}.json", one)
    text = table.write_table(tmp_path).read_text()
    # Means over both seeds; the ratio of the seed that has both.
    assert "| ours | clean | 3.000 | 1.800 (x 1.20 [1.20, 1.20]) |" in text
    assert "| PoseReg | clean | 3.000 | - |" in text
    assert "| ours | clean | 30.0 | 30.0 |" in text
    assert "jitter 1 degrees" in text
    write_json(tmp_path / "raw" / "9.json", {**raw("posereg", "jitter", 1.0), "takes": ["a", "c"]})
    with pytest.raises(InputError, match="takes: differ"):
        table.write_table(tmp_path)


def test_only_what_estimates_is_judged() -> None:
    noise = _script("noise")
    assert noise.method_of(compose_config("train")) == "ours"
    assert noise.method_of(compose_config("train", ["experiment=vgail"])) == "vgail"
    assert noise.method_of(compose_config("baseline", ["baseline=path_pose"])) == "pathpose"
    for name, words in (("baseline", ["baseline=erd"]), ("train", ["experiment=forecasting"])):
        with pytest.raises(InputError, match=r"estimates nothing|forecasts"):
            noise.method_of(compose_config(name, words))


@pytest.mark.parametrize(
    ("words", "called"),
    [([], "posereg"), (["regressor=cross_fitted"], "posereg"), (["regressor=blended"], "blended")],
)
def test_only_the_network_on_flow_alone_is_called_posereg(words: list[str], called: str, table: ModuleType) -> None:
    assert _script("noise").regressor_of(compose_config("train", words)) == called
    assert called in table.METHODS
