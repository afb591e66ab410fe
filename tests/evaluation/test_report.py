"""Report pages: they parse, fetch nothing, and their figures are those of the files they are made of."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import cv2
import matplotlib
import numpy as np
import pytest
from helpers.env_stand_in import group
from hydra import compose, initialize_config_dir
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from egopose.core.config import compose_config
from egopose.core.config_files import config_dir
from egopose.core.errors import InputError
from egopose.evaluation.agents import FragmentResult, failsafe_figures
from egopose.evaluation.charts import Chart, Line, bar_chart, line_chart
from egopose.evaluation.estimation_page import ReportSettings, read_takes, worst_and_best, write_report
from egopose.evaluation.page import Number
from egopose.evaluation.protocols import METRICS, ContactSettings, score_take
from egopose.evaluation.report import compare_runs, write_results, write_take
from egopose.evaluation.reports import run_report
from egopose.evaluation.resets import take_triggers
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.inference.estimator import Estimate
from egopose.inference.failsafe import FailSafeSettings
from egopose.motion.motion import Motion
from egopose.report import main

SETTINGS = ReportSettings(moments=2, apart=0.3, size=96, takes=None)
FRAMES = 40
VOID = {"meta", "img", "br", "path", "rect", "i"}
SVG_ATTRIBUTES = {"viewBox", "role", "class", "d", "style", "x", "y", "transform"}


@dataclass
class Piece:
    take: int
    start: int
    stop: int


@dataclass
class Parsed(HTMLParser):
    """Balance of tags, cells with their full values, pictures, and every attribute that could fetch."""

    open_tags: list[str] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    tables: list[list[list[str]]] = field(default_factory=list)
    data: str = ""

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.links += [str(v) for k, v in attrs if k in ("src", "href", "xlink:href", "data", "action", "srcset")]
        self.links += re.findall(r"url\([^)]*\)", " ".join(str(v) for v in found.values()))
        if "data-value" in found:
            self.values.append(float(str(found["data-value"])))
        if tag == "img":
            self.pictures.append(str(found["src"]))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append(str(found.get("data-value", "")))
        if tag not in VOID or tag in ("path", "rect", "i"):
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.open_tags.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open_tags[-1:] == ["script"]:
            self.data += data
        elif self.open_tags[-1:] in (["td"], ["th"]) and not self.tables[-1][-1][-1]:
            self.tables[-1][-1][-1] = data


def parsed(path: Path) -> Parsed:
    text = path.read_text()
    assert text.startswith("<!DOCTYPE html>")
    assert "http:" not in text
    assert "https:" not in text
    found = Parsed()
    found.feed(text)
    found.close()
    assert not found.open_tags
    assert all(link.startswith("data:") for link in found.links)
    return found


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return build_humanoid(HumanoidConfig.from_mapping(group("humanoid", "default")), SimConfig())


@pytest.fixture(scope="module")
def evaluation(humanoid: HumanoidModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation of two takes and two runs, made up: `walk` worst at frame 30, best at frame 5."""
    folder = tmp_path_factory.mktemp("evaluation")
    runs = [[_result(humanoid, name, k, seed) for k, name in enumerate(("walk", "bow</script>"))] for seed in (0, 1)]
    about = {
        "command": "python -m egopose.evaluate 'checkpoint=[a,b]' report=true",
        "checkpoints": ["runs/a/checkpoints/1"],
        "split": "test",
        "rendered_video": True,
        "settings": {"interval": {"level": 0.95}},
        "survival": [{"policy": {"frames": 12.5, "fell": 0.25}}],
        "failsafe": [failsafe_figures(run, FailSafeSettings("value", 0.164, 0.3), 30) for run in runs],
    }
    write_results(folder, compare_runs(runs, 0.95, 50, 0), runs, about)
    for result in runs[0]:
        write_take(folder / "takes", result)
    return folder


def _result(humanoid: HumanoidModel, name: str, take: int, seed: int) -> FragmentResult:
    rng, contact = np.random.default_rng(seed), ContactSettings(0.03, 0.5)
    truth = np.tile(humanoid.skeleton.rest_qpos(), (FRAMES, 1))
    truth[:, 2] = 0.95
    truth[:, 7:] = humanoid.rest_action
    estimate, regressed = truth.copy(), truth.copy()
    # Away from the truth with time's distance from frame 5, most at frame 30.
    away = 0.3 + 0.01 * np.abs(np.arange(FRAMES) - 5)
    away[30] = 1.0 + 0.3 * take
    estimate[:, 7:] += away[:, None] * rng.uniform(0.5, 1.0, humanoid.skeleton.n_dofs)
    regressed[:, 7:] += 0.4
    made = [Motion(humanoid.skeleton, q, 30.0, name) for q in (truth, estimate, regressed)]
    resets = np.arange(FRAMES) == 12
    values = np.linspace(0.5, 1.5, FRAMES)
    found = Estimate(0, estimate, values, values, np.roll(resets, -1), resets, resets, 0)
    scores = [score_take(name, q, truth, humanoid, contact, n) for q, n in ((estimate, 1), (regressed, 0), (truth, 0))]
    judged = take_triggers(found, {11: 7}, 30)
    return FragmentResult(Piece(take, 0, FRAMES), made[0], found, made[1], made[2], *scores, judged)


def test_the_page_says_what_the_results_say(evaluation: Path, humanoid: HumanoidModel, tmp_path: Path) -> None:
    out = write_report(evaluation, humanoid, SETTINGS, tmp_path / "report.html")
    found, results = parsed(out), json.loads((evaluation / "results.json").read_text())
    assert json.loads(found.data) == results
    head, *rows = found.tables[0]
    assert head == ["metric", "ours", "PoseReg", "ours / PoseReg", "reference"]
    assert len(rows) == len(METRICS) + 1
    places = (("figures", "ours"), ("figures", "PoseReg"), ("ratios", "ours"))
    for metric, row in zip(METRICS, rows, strict=False):
        for cell, (part, name) in zip(row[1:4], places, strict=True):
            expected = results[part][name].get(metric.key)
            assert (float(cell) == expected["value"]) if expected else cell == "-", (metric.key, name)
        assert float(row[4]) == results["reference"][metric.key] if row[4] != "-" else True
    assert [float(c) for c in rows[-1][1:3]] == [1.0 * results["resets"]["ours"], 0.0]
    # The fail-safe's triggers: a row a run, then one a trigger of the first run.
    assert [row[2:4] for row in found.tables[2][1:]] == [["2", "2"]] * 2
    assert [row[3] for row in found.tables[3][1:]] == ["7"] * 2
    text = out.read_text()
    assert "python -m egopose.evaluate &#39;checkpoint=[a,b]&#39; report=true" in text
    assert "rendered from real motion capture" in text
    assert "Content-Security-Policy" in text
    # One table of joints: its mean over joints and takes is the figure of the first run.
    joints = np.array([[float(c) for c in row[1:]] for row in found.tables[5][1:]])
    key = "mpjpe_root_aligned"
    for column, name in enumerate(("ours", "PoseReg")):
        assert joints[:, column].mean() == pytest.approx(np.mean(results["per_take"][name][key][0]), rel=1e-9)


def test_moments_are_pictured(evaluation: Path, humanoid: HumanoidModel, tmp_path: Path) -> None:
    takes = read_takes(evaluation)
    worst, best = worst_and_best(takes, 2, 0.3)
    assert set(worst) == {(0, 30), (1, 30)}
    assert 5 in {t for _, t in best}
    for chosen in (worst, best):
        assert all(k != m or abs(t - u) >= 9 for i, (k, t) in enumerate(chosen) for m, u in chosen[:i])
    found = parsed(write_report(evaluation, humanoid, SETTINGS, tmp_path / "r.html"))
    if not found.pictures and "OpenGL" in (tmp_path / "r.html").read_text():
        pytest.skip("no OpenGL here")
    assert len(found.pictures) == 4
    for source in found.pictures:
        png = base64.b64decode(source.removeprefix("data:image/png;base64,"))
        frame = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert frame.shape == (96, 192, 3)
        assert np.ptp(frame) > 100
    assert found.pictures[0] != found.pictures[1]


def test_what_is_missing_is_named(evaluation: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="results"):
        write_report(tmp_path, None, SETTINGS, tmp_path / "r.html")
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(InputError, match="no result of"):
        write_report(tmp_path, None, SETTINGS, tmp_path / "r.html")
    copy = tmp_path / "copy"
    shutil.copytree(evaluation, copy)
    assert "No pictures" in write_report(copy, None, SETTINGS, tmp_path / "r.html").read_text()
    (copy / "takes/walk/pose_regression.npz").unlink()
    with pytest.raises(InputError, match="evaluate anew"):
        write_report(copy, None, SETTINGS, tmp_path / "r.html")
    results = json.loads((copy / "results.json").read_text())
    (copy / "results.json").write_text(json.dumps({**results, "figures": {"ours": {}}, "ratios": {"theirs": 1}}))
    shutil.copy(evaluation / "takes/walk/pose_regression.npz", copy / "takes/walk")
    with pytest.raises(InputError, match="damaged"):
        write_report(copy, None, SETTINGS, tmp_path / "r.html")


def test_a_sweep(tmp_path: Path, evaluation: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    for job in range(3):
        folder = tmp_path / "sweep" / str(job)
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(f"seed: {job}\nalgo:\n  lr: 1.0e-4\n  name: '<b>'\n")
        rows = "".join(f"{100 * k},{0.1 * k + job},\n" for k in range(1, 31))
        (folder / "curves.csv").write_text("steps,reward,evaluation/score\n" + rows)
    (tmp_path / "sweep/0/finished.json").write_text("{}")
    (tmp_path / "sweep/1/evaluation/test").mkdir(parents=True)
    shutil.copy(evaluation / "results.json", tmp_path / "sweep/1/evaluation/test")
    overrides = {"hydra": ["hydra.mode=MULTIRUN", "hydra.sweep.dir=runs/s"], "task": ["seed=0,1,2"]}
    (tmp_path / "sweep/multirun.yaml").write_text(json.dumps({"hydra": {"overrides": overrides}}))
    monkeypatch.setattr("sys.argv", ["egopose report", str(tmp_path / "sweep"), "sweep.last=5"])
    main()
    out = Path(capsys.readouterr().out.strip())
    assert out == tmp_path / "sweep/report.html"
    found = parsed(out)
    assert found.tables[0][0] == ["job", "seed", "steps", "reward", "finished"]
    np.testing.assert_allclose([float(row[3]) for row in found.tables[0][1:]], 2.8 + np.arange(3))
    assert [row[4] for row in found.tables[0][1:]] == ["yes", "no", "no"]
    held = json.loads(found.data)
    assert held["2"]["settings"] == {"seed": 2}
    assert (held["2"]["steps"], held["2"]["reward"]) == (3000.0, pytest.approx(4.8))
    figure = json.loads((evaluation / "results.json").read_text())["figures"]["ours"]["E_pose"]["value"]
    assert float(found.tables[1][1][2]) == figure
    assert "--multirun hydra.sweep.dir=runs/s seed=0,1,2" in out.read_text()
    assert out.read_text().count("<svg") == 1


def test_neither_an_evaluation_nor_a_sweep(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="neither"):
        run_report(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        run_report(tmp_path / "gone")
    (tmp_path / "0").mkdir()
    (tmp_path / "0/config.yaml").write_text("a: 1\n")
    (tmp_path / "0/curves.csv").write_text("steps,reward\n1,x\n")
    with pytest.raises(InputError, match="damaged"):
        run_report(tmp_path)


def test_a_configuration_can_be_read_within_hydras_main() -> None:
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        assert compose_config("report")["out"] is None
        assert compose("export").part == "estimate"  # Hydra's own instance is as it was


def paths(chart: Chart, kind: str) -> list[str]:
    """What the chart's lines, bands, bars or marks are drawn along."""
    return re.findall(rf'<g class="{kind}">(?:<title>[^<]*</title>)?<path d="([^"]*)"', chart.svg)


def points(path: str) -> np.ndarray:
    """``[N, 2]`` of a path; y points down."""
    return np.array([pair.split()[-2:] for pair in re.findall(r"[ML] \S+ \S+", path)], dtype=float)


def test_a_line_is_drawn_to_scale_and_broken_where_there_is_no_figure() -> None:
    chart = line_chart([Line("a & b", [0, 1, 2, 3, 4], [1.0, np.nan, 2.0, 3.0, 7.0])], "s", "mm", [1.5])
    (line,) = paths(chart, "line")
    assert line.count("M") == 2
    drawn = points(line)[-3:]
    np.testing.assert_allclose(np.diff(drawn[:, 1])[1], 4 * np.diff(drawn[:, 1])[0], atol=0.3)
    np.testing.assert_allclose(np.diff(drawn[:, 0])[1], np.diff(drawn[:, 0])[0], atol=0.2)
    assert "<title>a &amp; b</title>" in chart.svg
    assert len(paths(chart, "mark")) == 1
    assert chart.colours == {"a & b": "#0072b2"}
    banded = line_chart([Line("a", [0, 1, 2], [1.0, 2.0, 3.0], [[0, 1, np.nan], [2, 3, 4]])], "s", "mm")
    assert len(paths(banded, "band")) == 1
    assert points(paths(banded, "band")[0])[:, 0].max() < points(paths(banded, "line")[0])[:, 0].max()
    assert not line_chart([Line("a", [0.0], [np.nan])], "s", "mm").svg
    assert not line_chart([], "s", "mm").svg


def test_bars_are_as_high_as_their_figures() -> None:
    chart = bar_chart(["x", "y", "z"], {"ours": [1.0, 2.0, np.nan]}, "mm")
    heights = [float(np.ptp(points(path)[:, 1])) for path in paths(chart, "bar")]
    assert len(heights) == 2  # none where there is no figure
    assert heights[1] == pytest.approx(2 * heights[0], abs=0.2)
    assert "<title>y, ours: 2</title>" in chart.svg


@given(st.lists(st.text(), min_size=1, max_size=3, unique=True), st.text())
@settings(max_examples=12, deadline=None, phases=(Phase.generate,))
def test_no_name_gets_into_a_charts_markup(names: list[str], axis: str) -> None:
    """It is one element with text as it was given, but for control characters, which no XML holds."""
    lines = [Line(name, [0.0, 1.0], [k, 1.0], [[0.0, 1.0], [2.0, 3.0]]) for k, name in enumerate(names)]
    for chart in (line_chart(lines, axis, axis), bar_chart(names, {axis: np.ones(len(names))}, axis)):
        root = ElementTree.fromstring(chart.svg)
        assert {part.tag for part in root.iter()} <= {"svg", "g", "path", "text", "title", "tspan"}
        assert {key for part in root.iter() for key in part.attrib} <= SVG_ATTRIBUTES
        said = {part.text or "" for part in root.iter("title")}
        if 'class="line"' in chart.svg:
            assert said == {"".join(c if c.isprintable() else "\ufffd" for c in name) for name in names}


def test_a_charts_ink_is_the_pages_and_two_in_a_page_do_not_meet() -> None:
    chart = line_chart([Line("a", [0, 1], [1.0, 2.0])], "s", "mm")
    assert "stroke: currentColor" in chart.svg
    assert "#000" not in chart.svg
    assert not re.search(r"\bid=|url\(|<style|href", chart.svg)
    matplotlib.rcParams["text.color"] = "red"
    try:
        assert line_chart([Line("a", [0, 1], [1.0, 2.0])], "s", "mm") == chart
    finally:
        matplotlib.rcdefaults()


def test_a_figure_that_is_not_there_is_a_dash() -> None:
    assert Number(float("nan")).known is False
    assert Number(None).known is False
    assert Number(0.0).known is True


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium on this machine")
def test_a_browser_shows_it(evaluation: Path, humanoid: HumanoidModel, tmp_path: Path) -> None:
    out = write_report(evaluation, humanoid, SETTINGS, tmp_path / "report.html")
    shot = tmp_path / "shot.png"
    words = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1000,2600"]
    found = subprocess.run(
        [*words, f"--screenshot={shot}", out.as_uri()], capture_output=True, text=True, timeout=90, check=True
    )
    assert "Refused" not in found.stderr
    frame = cv2.imread(str(shot))
    assert frame.shape[:2] == (2600, 1000)
    assert frame[:, 500:].std() > 5
