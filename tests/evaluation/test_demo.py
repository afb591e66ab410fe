"""The demos: their command lines, the order of the stages, and the page with its figures and pictures."""

from __future__ import annotations

import base64
import io
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.env_stand_in import group
from PIL import Image

from egopose.checkpoint.pretrained import pretrained_names
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.verbs import VERBS
from egopose.data.preparation import store_folder
from egopose.data.take_sources import find_sources
from egopose.demo import main
from egopose.evaluation import demo
from egopose.evaluation.demo_page import WORDS, DemoPageSettings, write_demo_page
from egopose.evaluation.page import Film
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.motion.io import write_motion
from egopose.motion.motion import Motion
from egopose.vision.video import write_video

SETTINGS = DemoPageSettings(stills=3, size=32, fps=15.0)
COLOURS = ((200, 40, 40), (40, 200, 40), (40, 40, 200))  # of the panels of the made-up videos


def video(path: Path, panels: int, frames: int) -> None:
    """Each panel of one colour, which grows darker."""
    fade = np.linspace(1.0, 0.5, frames)
    rows = [np.concatenate([np.full((64, 64, 3), c) for c in COLOURS[:panels]], axis=1)]
    write_video(path, [(rows[0] * f).astype(np.uint8) for f in fade], 30.0)


def milliseconds(film: Any) -> int:
    """How long a WebP lasts; like frames in a row may be one."""
    lasts = 0
    for k in range(film.n_frames):
        film.seek(k)
        film.load()
        lasts += film.info["duration"]
    return lasts


@pytest.fixture
def evaluations(tmp_path: Path) -> dict[str, Path]:
    """A folder of estimates and one of forecasts, made up."""
    one, other = tmp_path / "ours_est", tmp_path / "ours_fore"
    values = {key: 10.0 + k for k, key in enumerate(WORDS)}
    figures = {
        name: {key: {"value": scale * v, "low": None, "high": None} for key, v in values.items()}
        for name, scale in (("ours", 1.0), ("PoseReg", 2.0))
    }
    ratios = {"ours": {key: {"value": 0.5, "low": None, "high": None} for key in WORDS}}
    estimates = {
        "figures": figures,
        "ratios": ratios,
        "reference": dict.fromkeys(WORDS, 1.25),
        "resets": {"ours": 3.0, "PoseReg": 0.0},
        "rendered_video": True,
    }
    video(one / "takes/walk/side_by_side.mp4", 3, 40)
    (one / "results.json").write_text(json.dumps(estimates))

    humanoid = build_humanoid(HumanoidConfig.from_mapping(group("humanoid", "default")), SimConfig())
    truth = np.tile(humanoid.skeleton.rest_qpos(), (20, 1))
    bent = truth.copy()
    bent[:, 7:] += 0.3
    for number in (0, 30):
        folder = other / f"windows/walk_{number}"
        video(folder / "futures.mp4", 2, 20)
        for name, qpos in (("reference", truth), ("forecast", bent), ("other_standing_still", truth)):
            write_motion(Motion(humanoid.skeleton, qpos, 30.0, name), folder / f"{name}.npz")
    forecasts = {"figures": {"ours": {}, "standing still": {}}, "horizons_s": [1 / 3, 2 / 3], "rendered_video": True}
    (other / "results.json").write_text(json.dumps(forecasts))
    return {"est<b>": one, "fore": other}


def test_the_page_holds_figures_and_pictures_and_fetches_nothing(evaluations: dict[str, Path], tmp_path: Path) -> None:
    text = write_demo_page(evaluations, SETTINGS, tmp_path / "demo.html").read_text()
    assert "http:" not in text
    assert "https:" not in text
    links = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert all(link.startswith("data:image/") or (tmp_path / link).parent.is_dir() for link in links)
    assert "<b>" not in text
    assert "rendered from real motion capture" in text
    assert "make train-demo" in text
    # Its cells hold the figures in full: three of each metric, then how often the body fell.
    cells = [float(v) for v in re.findall(r'data-value="([^"]*)"', text)]
    expected = [v for k in range(len(WORDS)) for v in (10.0 + k, 20.0 + 2 * k, 1.25)]
    assert cells[: len(expected) + 2] == [*expected, 3.0, 0.0]
    ours, still, *more = cells[len(expected) + 2 :]
    assert ours > 10.0  # mm, of joints bent by 0.3 rad
    assert still == 0.0
    assert more == [pytest.approx(ours), 0.0]
    assert "0.50 times as far off" in text

    pngs, webps = (re.findall(rf"data:image/{kind};base64,([^\"]*)", text) for kind in ("png", "webp"))
    films = [Image.open(io.BytesIO(base64.b64decode(w))) for w in webps]
    assert [(milliseconds(film), film.size) for film in films] == [(20 * 67, (96, 32)), (10 * 67, (64, 32))]
    strips = [cv2.imdecode(np.frombuffer(base64.b64decode(p), np.uint8), cv2.IMREAD_COLOR) for p in pngs]
    assert [strip.shape for strip in strips] == [(96, 96, 3), (32, 96, 3)]
    # The panels below each other, a column a moment: RGB's first is BGR's last, and the last moment is the darkest.
    for row, channel in enumerate((2, 1, 0)):
        middles = strips[0][16 + 32 * row, 16::32, :].astype(int)
        assert (middles.argmax(axis=1) == channel).all()
        assert (np.diff(middles[:, channel]) < -20).all()


def test_what_the_page_lacks_is_named(evaluations: dict[str, Path], tmp_path: Path) -> None:
    folder = evaluations["est<b>"]
    (folder / "takes/walk/side_by_side.mp4").unlink()
    with pytest.raises(InputError, match=r"video\.takes=1"):
        write_demo_page(evaluations, SETTINGS, tmp_path / "demo.html")
    (folder / "results.json").write_text("{}")
    video(folder / "takes/walk/side_by_side.mp4", 3, 5)
    with pytest.raises(InputError, match="damaged"):
        write_demo_page(evaluations, SETTINGS, tmp_path / "demo.html")
    with pytest.raises(InputError, match=r"demo\.page\.stills"):
        DemoPageSettings(stills=0, size=32, fps=15.0)


def test_a_film_lasts_as_long_as_its_frames_say_and_begins_anew() -> None:
    frames = [np.full((8, 8, 3), 10 * k, np.uint8) for k in range(6)]
    film = Image.open(io.BytesIO(base64.b64decode(Film(frames, 12.5, "a film").webp)))
    assert film.n_frames == 6
    assert film.info["loop"] == 0
    assert milliseconds(film) == 480


@pytest.fixture
def staged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What the demo would do, in its order; the weights are an estimator, a forecaster and one of neither task."""
    done: list[str] = []
    tasks = {"a_forecaster": "forecasting", "an_estimator": "estimation", "states_of_films": "film_regressor"}
    for name, task in tasks.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "weights.json").write_text(json.dumps({"task": task}))
    shipped = compose_config("train")

    def config_of(path: str, _: str) -> dict[str, Any]:
        return {**shipped, "task": {"name": tasks[path.removeprefix("pretrained:")]}}

    def scored(kind: str) -> Any:
        def run(settings: dict[str, Any], agents: Any, names: Any, videos: Any, out: Path) -> str:
            done.append(f"{kind} {settings['video']['takes']} {out.name}")
            return "figures"

        return run

    def load(path: str, overrides: dict[str, Any]) -> Any:
        done.append(f"load {path} on {overrides['data']['name']}")
        return SimpleNamespace(config={})

    def write_page(written: dict[str, Path], settings: DemoPageSettings, out: Path) -> Path:
        done.append(f"page {' '.join(written)}")
        return out

    monkeypatch.setattr(demo, "pretrained_names", lambda: sorted(tasks))
    monkeypatch.setattr(demo, "pretrained_run", lambda name: tmp_path / name)
    monkeypatch.setattr(demo, "find_checkpoint", lambda path: path)
    monkeypatch.setattr(demo, "read_json", config_of)
    monkeypatch.setattr(demo, "prepare", lambda config: done.append(f"prepare {config['data']['name']}"))
    monkeypatch.setattr(demo, "load_agent", load)
    monkeypatch.setattr(demo, "take_videos", lambda config: ([], []))
    monkeypatch.setattr(demo, "write_demo_page", write_page)
    for protocol in ("estimates", "forecasts"):
        monkeypatch.setitem(demo.PROTOCOLS, protocol, scored(protocol))
    return done


def test_nothing_is_trained_and_weights_of_other_tasks_are_passed_over(
    staged: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "run_training", lambda *_: pytest.fail("the demo trains"))
    monkeypatch.setattr("sys.argv", ["egopose demo", f"output={tmp_path / 'out'}"])
    main()
    assert staged == [
        "prepare demo",
        "load pretrained:a_forecaster on demo",
        "forecasts 1 a_forecaster",
        "prepare demo",
        "load pretrained:an_estimator on demo",
        "estimates 1 an_estimator",
        "page a_forecaster an_estimator",
    ]
    train, page = capsys.readouterr().out.splitlines()[-2:]
    assert "make train-demo" in train
    (folder,) = (tmp_path / "out").iterdir()
    assert page.endswith(str(folder / "demo.html"))
    told = json.loads((folder / "demo.json").read_text())
    assert list(told["shipped"]) == ["a_forecaster", "an_estimator"]
    assert len(told["seconds"]) == 5


def test_weights_that_cannot_be_shown_are_left_out_and_none_is_an_error(
    staged: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> str:
        raise InputError("data", "length", "too short")

    monkeypatch.setitem(demo.PROTOCOLS, "forecasts", refuse)
    demo.run_demo([f"output={tmp_path / 'out'}"])
    assert staged[-1] == "page an_estimator"
    out = capsys.readouterr().out
    assert out.index("a_forecaster on frames") < out.index("left out: data: length: too short")
    monkeypatch.setitem(demo.PROTOCOLS, "estimates", refuse)
    with pytest.raises(InputError, match="no pretrained weights"):
        demo.run_demo([f"output={tmp_path / 'none'}"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["budget=short"], "add train=true"),
        (["train=yes"], "must be true or false"),
        (["train=true", "budget=long"], "must be one of full, short"),
        (["sead=1"], "is not a setting"),
    ],
)
def test_a_wrong_word_ends_in_one_line(
    words: list[str], told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["egopose demo", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert told in error
    assert len(error.splitlines()) == 1


def test_train_is_taken_by_the_verb_and_the_rest_goes_to_training(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(demo, "run_training_demo", lambda *words: given.extend(words))
    monkeypatch.setattr("sys.argv", ["egopose demo", "train=true", "seed=3", "budget=short", "training.max_seconds=9"])
    main()
    assert given == ["short", ["seed=3", "training.max_seconds=9"]]


def test_the_help_names_both_demos(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["egopose demo", "--help"])
    main()
    assert "train=true [budget=short]" in capsys.readouterr().out
    assert "train=true" in VERBS["demo"]


def test_the_clip_is_a_whole_one_of_its_person() -> None:
    data = compose_config("train", ["experiment=demo"])["data"]
    assert {source.name: source.subject for source in find_sources(data)} == {
        "cmu10_04": "cmu10",
        "cmu35_walking_6": "cmu35",
    }
    assert data["split"]["test_subjects"] == ["cmu10"]
    assert store_folder(compose_config("train", ["experiment=demo"])) != store_folder(compose_config("train"))


def test_the_weights_in_the_package_can_be_shown() -> None:
    assert {"people_estimation", "cmu6_forecasting"} & {name for name in pretrained_names() if demo.is_scored(name)}


@pytest.mark.slow
def test_a_whole_demo(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "egopose.demo", f"output={tmp_path}", f"data.store={tmp_path / 'store'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    page = Path(done.stdout.splitlines()[-1].partition(": ")[2])
    assert page.read_text().count("data:image/webp;base64,") == sum(map(demo.is_scored, pretrained_names()))
