"""Every setting that is a path is looked at before a verb begins, and a fault is one line."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from egopose.core.config import register_resolvers
from egopose.core.config_files import config_dir, setting_names
from egopose.core.errors import InputError
from egopose.core.path_settings import OWN, SHARED, Kind, check_paths, check_run_directory, checked_path

_NAMES = [path.stem for path in sorted(config_dir().glob("*.yaml")) if path.stem not in ("export", "report")]
#: Last words of settings that are paths.
_PATHS = re.compile(
    r"(^|\.)(video|motion|folder|data_folder|store|checkpoint|run|out|output|resume|track|network|clip|start_from|scene|poses|"
    r"policy|telemetry|weights|estimator|asf|source)$"
)
#: Settings of such a name that are none.
_OTHERS = {"data.source", "model.context.source", "training.cameras.track", "training.network"}


@pytest.mark.parametrize("name", _NAMES)
def test_every_setting_with_the_name_of_a_path_is_looked_at(name: str) -> None:
    known = {re.escape(one).replace(r"\*", "[^.]+") for one in {**SHARED, **OWN.get(name, {})}}
    found = {setting for setting in setting_names(name) if _PATHS.search(setting)} - _OTHERS
    left = {one for one in found if not any(re.fullmatch(pattern, one) for pattern in known)}
    assert left == set()


@pytest.mark.parametrize("name", OWN)
def test_no_path_is_named_that_is_no_setting(name: str) -> None:
    register_resolvers()
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        config = compose(name)
    for setting in OWN[name]:
        inner = OmegaConf.to_container(config)
        for key in setting.partition(".*")[0].split("."):
            assert key in inner, setting
            inner = inner[key]


_FILE, _FOLDER = "a_file.mp4", "a_folder"
_BAD = {
    Kind.FILE: ["", " ", "missing", _FOLDER, 5, True, ["a"], {"a": 1}, "x" * 5000, "~nobody_of_that_name/x"],
    Kind.FOLDER: ["", "missing", _FILE, 5, ["a"]],
    Kind.EXISTING: ["", "missing", 5, ["a"]],
    Kind.RUN: ["", "missing", _FILE, 5, ["a"]],
    Kind.NEW_FILE: ["", _FOLDER, f"{_FILE}/below.npz", 5, ["a"]],
    Kind.NEW_FOLDER: ["", _FILE, f"{_FILE}/below", 5, ["a"]],
    Kind.SOURCE: ["", True, 0.5, ["a"]],
    Kind.PATTERN: ["", 5],
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / _FILE).write_bytes(b"")
    (tmp_path / _FOLDER).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("kind", "value"), [(kind, value) for kind, values in _BAD.items() for value in values])
def test_a_wrong_path_is_told_with_setting_and_cause(kind: Kind, value: object) -> None:
    with pytest.raises(InputError) as told:
        checked_path(value, kind, "some.setting")
    assert told.value.field == "some.setting"
    assert len(str(told.value).splitlines()) == 1
    assert len(str(told.value)) < 250


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (Kind.FILE, _FILE),
        (Kind.FILE, f"./{_FILE}"),
        (Kind.FOLDER, _FOLDER),
        (Kind.EXISTING, _FILE),
        (Kind.EXISTING, _FOLDER),
        (Kind.RUN, _FOLDER),
        (Kind.RUN, "pretrained:anything"),
        (Kind.NEW_FILE, "new.npz"),
        (Kind.NEW_FILE, _FILE),
        (Kind.NEW_FOLDER, "deep/new"),
        (Kind.NEW_FOLDER, _FOLDER),
        (Kind.SOURCE, 0),
        (Kind.SOURCE, "rtsp://camera"),
        (Kind.PATTERN, "clips/*.bvh"),
    ],
)
def test_a_right_path_stays_as_it_is(kind: Kind, value: object) -> None:
    assert checked_path(value, kind, "some.setting") == value


def test_the_home_directory_is_put_in(folder: Path) -> None:
    config = OmegaConf.create({"video": f"~/{_FILE}", "out": None, "checkpoint": ["~", "pretrained:x"]})
    check_paths("evaluate", config)
    assert config.checkpoint == [str(folder), "pretrained:x"]
    check_paths("estimate", OmegaConf.create({"video": f"~/{_FILE}", "out": "???"}))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("name", "values", "setting"),
    [
        ("estimate", {"video": ""}, "video"),
        ("estimate", {"worn": {"telemetry": _FOLDER}}, "worn.telemetry"),
        ("reconstruct", {"camera": {"track": "missing"}}, "camera.track"),
        ("evaluate", {"checkpoint": [_FOLDER, ""]}, "checkpoint[1]"),
        ("evaluate", {"forecast": {"baselines": {"erd": _FILE}}}, "forecast.baselines.erd"),
        ("package", {"figures": {"ours": ""}}, "figures.ours"),
        ("prepare", {"data": {"folder": ""}}, "data.folder"),
        ("train", {"task": {"also": {"cmu6": {"folder": _FILE}}}}, "task.also.cmu6.folder"),
        ("lifter", {"sources": {"cmu6": 7}}, "sources.cmu6"),
    ],
)
def test_every_path_of_a_configuration_is_looked_at(name: str, values: dict[str, object], setting: str) -> None:
    with pytest.raises(InputError) as told:
        check_paths(name, OmegaConf.create(values))
    assert told.value.field == setting


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("word", ["resume=", "resume=missing", f"resume={_FOLDER}", "output=", f"output={_FILE}"])
def test_a_run_directory_is_looked_at_before_hydra_makes_it(word: str) -> None:
    with pytest.raises(InputError):
        check_run_directory(["algo=fast", word])
    check_run_directory(["resume=null", f"output={_FOLDER}", "output=new", "resum", "resume"])


@pytest.mark.parametrize(
    ("verb", "words", "said"),
    [
        ("estimate", ["video=", "checkpoint=x"], "video: is empty; give a file"),
        ("reconstruct", ["video=film.mp4", "out=5"], "film.mp4: video: no such file"),
        ("prepare", ["data=cmu6", "data.folder="], "data.folder: is empty; give a folder"),
        ("train", ["resume="], "resume: is empty; give a folder"),
        ("train", ["training.start_from=nowhere"], "nowhere: training.start_from: no such folder"),
        ("baseline", ["resume="], "resume: is empty; give a folder"),
        ("report", [""], "folder: is empty; give a folder"),
        ("export", ["", "to=a.bvh"], "source: is empty; give a file or a folder"),
        ("export", [_FILE, "to="], "to: is empty; give a file to be written"),
        ("view", [""], "source: is empty; give a file or a folder"),
        ("view", [_FILE, "--video", _FOLDER], f"{_FOLDER}: video: is a folder; give a file"),
    ],
)
def test_the_verbs_tell_it_in_one_line(
    verb: str, words: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setattr("sys.argv", [f"egopose {verb}", *words])
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(f"egopose.{verb}").main()
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert line.endswith(said)
    # Nothing was made but Hydra's own run directory.
    assert {path.name for path in folder.iterdir()} <= {_FILE, _FOLDER, "runs"}
