"""What is told of a reconstruction: failures by frame, figures beside the kinematic input's, and the page."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.jump import FAR, STEP, UPRIGHT, bare, jumping, scene_at, simulated, standing, write_folder
from hypothesis import given
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.evaluation import reconstruction_pictures
from egopose.evaluation.position_metrics import foot_slide
from egopose.evaluation.reconstruction_findings import Findings
from egopose.evaluation.reconstruction_pictures import film_panels, moment_grids, view_of
from egopose.evaluation.reports import run_report
from egopose.evaluation.scene_pictures import read_moments
from egopose.inference.reconstruction import FITTED, PAGE, read_reconstruction
from egopose.inference.scene_stages import Sources, load_projection
from egopose.report import main
from egopose.scene.projection import Projection
from egopose.scene.scene_file import Contact, Scene, write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("made") / "leap", jumping(), scene_at(0.3), film=True)


@pytest.fixture(scope="module")
def good(folder: Path) -> Findings:
    return Findings(read_reconstruction(folder, bare()))


def test_a_jump_that_does_what_it_should_fails_nowhere(good: Findings) -> None:
    assert good.failures() == []
    assert {(one.effector, one.surface) for one in good.contacts} == {("right_foot", "step"), ("left_foot", "step")}
    assert good.root_distance[-1] == pytest.approx(0.1)
    assert good.joint_distance == pytest.approx(0.0, abs=1e-9)
    # The clip is the motion slid along by 0.1 m in 2 s.
    assert good.kinematic.slide == pytest.approx(0.05, abs=0.02)
    assert good.simulated.slide < good.kinematic.slide
    assert good.simulated.deepest < 0.02
    assert good.kinematic.deepest == pytest.approx(good.simulated.deepest, abs=0.005)


def test_contacts_that_are_missing_or_not_wanted_are_told(tmp_path: Path) -> None:
    wrong = replace(scene_at(0.3), contacts=(Contact("right_foot", "floor", 5, 25), Contact("left_hand", "far", 3, 9)))
    findings = Findings(read_reconstruction(write_folder(tmp_path, jumping(), wrong), bare()))
    told = findings.failures()
    assert "Frames 5 to 25: the right foot should touch the floor and does not." in told
    assert "Frames 3 to 9: the left hand should touch far and does not." in told
    assert any(
        re.match(r"Frames 5 to 25: .*|Frames 0 to \d+: the right foot touches step; the scene does", s) for s in told
    )
    assert any("the left foot touches step; the scene does not say so" in sentence for sentence in told)


def test_a_fall_is_told_with_what_lies_on_the_ground(tmp_path: Path) -> None:
    scene = Scene(boxes=(STEP, FAR), contacts=(Contact("right_foot", "floor", 0, 55),))
    motion = simulated(scene, (-2.0, 0.0, UPRIGHT), [0.0] * 59, lean=0.5)
    folder = write_folder(tmp_path, motion, scene)
    findings = Findings(read_reconstruction(folder, bare()))
    told = " ".join(findings.failures())
    assert re.search(r"Frames \d+ to \d+: .*(Head|Leg|Spine|Hips|Arm).* on the floor: only feet and hands", told)


def test_a_body_that_goes_another_way_and_one_that_sinks_are_told(tmp_path: Path) -> None:
    from egopose.motion.io.native import read_native, write_native

    folder = write_folder(tmp_path, standing(40), Scene(boxes=(STEP, FAR)))
    body = read_native(folder / "body.npz")
    qpos = body.qpos.copy()
    qpos[20:30, 1] += 0.5
    qpos[5:10, 2] -= 0.05
    write_native(replace(body, qpos=qpos), folder / "body.npz")
    findings = Findings(read_reconstruction(folder, bare()))
    assert [s for s in findings.failures() if "root" in s] == [
        "Frames 20 to 29: the root is up to 0.51 m from the way read off the film."
    ]
    assert findings.kinematic.sunk == pytest.approx(5 / 40)
    assert findings.kinematic.deepest == pytest.approx(0.05, abs=0.01)
    assert findings.simulated.sunk == 0.0
    findings.__dict__["depth"] = np.where(np.arange(40) // 5 == 2, 0.03, 0.0)
    assert "Frames 10 to 14: the body reaches up to 30 mm into the ground." in findings.failures()


@given(speed=st.floats(0.0, 3.0), lift=st.floats(0.0, 1.0))
def test_a_rolling_foot_does_not_slide(speed: float, lift: float) -> None:
    soles = np.zeros((10, 2, 2, 3))
    soles[:, 0, :, 0] = (speed * np.arange(10) / 30)[:, None]
    soles[:, 1, 0, 0], soles[:, 1, 0, 2] = speed * np.arange(10) / 30, lift  # its heel alone moves
    touching = np.ones((10, 2), bool)
    assert foot_slide(soles, touching, 30.0) == pytest.approx(speed / 2)
    touching[:, 0] = False
    assert foot_slide(soles, touching, 30.0) == 0.0
    assert np.isnan(foot_slide(soles, np.zeros((10, 2), bool), 30.0))


@given(azimuth=st.floats(-170.0, 170.0), elevation=st.floats(-60.0, 60.0), scale=st.floats(10.0, 500.0))
def test_the_films_view_is_found_in_its_projection(azimuth: float, elevation: float, scale: float) -> None:
    a, e = np.deg2rad([azimuth, elevation])
    ahead = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    down = np.cross(ahead, right)
    found = view_of(Projection(scale * np.stack([right, down])[None], np.zeros((1, 2))))
    assert found == pytest.approx((azimuth, elevation), abs=1e-6)


def test_the_body_lies_over_the_film(folder: Path) -> None:
    found = read_reconstruction(folder, bare())
    moments = read_moments(Sources(folder / "film.mp4", None, 30.0), folder, 3)
    panels = film_panels(found, load_projection(folder / "projection.npz"), moments, 120)
    for panel in panels:
        assert panel.shape == (120, 120, 3)
        green = (panel[..., 1] > 150) & (panel[..., 0] < 140)
        red = (panel[..., 0] > 150) & (panel[..., 1] < 60)
        assert green.sum() > 40
        assert red.sum() > 1000
        rows, columns = np.nonzero(green)
        assert 50 < np.ptp(rows) < 100  # the body's height is two thirds of the cut
        assert abs(columns.mean() - 60) < 12


def test_renderings_stand_below_the_film(folder: Path) -> None:
    found = read_reconstruction(folder, bare())
    moments = read_moments(Sources(folder / "film.mp4", None, 30.0), folder, 5)
    try:
        grids = moment_grids(found, load_projection(folder / "projection.npz"), moments, 64)
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert [grid.shape for grid in grids] == [(256, 256, 3)] * 2
    assert (grids[1][:, 64:] == 250).all()  # the fifth moment stands alone
    for row in range(1, 4):
        assert grids[0][64 * row : 64 * (row + 1), :64].std() > 10


def test_the_page_is_whole_and_tells_the_truth(folder: Path, good: Findings, tmp_path: Path) -> None:
    moved = replace(scene_at(0.3), boxes=(replace(STEP, height=0.77), FAR))
    write_scene(moved, folder / FITTED)
    out = run_report(folder, [f"out={tmp_path / 'page.html'}", "reconstruction.moments=2", "reconstruction.size=64"])
    page = out.read_text(encoding="utf-8")
    assert page.count("<section>") == 7
    assert page.count("<svg") == 3
    assert "Nowhere that is looked for" in page
    assert "0.77" in page
    assert "<p>Motion: <code>plan.npz</code></p>" in page
    assert str(folder.parent) not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    data: dict[str, Any] = json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))  # type: ignore[union-attr]
    said = {row["what"]: row["value"] for row in data["numbers"]}
    assert said["flight 1: time"] == pytest.approx(good.found.numbers.flights[0].time)
    assert data["failures"] == []


def test_without_film_or_opengl_the_page_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise RuntimeError("no OpenGL on this machine")

    monkeypatch.setattr(reconstruction_pictures, "SceneRenderer", none)
    folder = write_folder(tmp_path / "leap", jumping(), scene_at(0.3))
    out = run_report(folder, ["reconstruction.moments=2", "reconstruction.size=64"])
    assert out == folder / PAGE
    assert "No renderings: no OpenGL on this machine" in out.read_text(encoding="utf-8")


def test_a_motion_elsewhere_among_a_clip_without_a_film(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "leap", jumping(), scene_at(0.3))
    (folder / "plan.npz").rename(tmp_path / "simulated.npz")
    (folder / "projection.npz").unlink()
    words = [f"simulated={tmp_path / 'simulated.npz'}", "reconstruction.moments=2", "reconstruction.size=32"]
    page = run_report(folder, words).read_text(encoding="utf-8")
    assert page.count("<figure>") <= 1
    assert "film, simulated" not in page
    with pytest.raises(InputError):
        run_report(folder, [f"simulated={tmp_path / 'nowhere.npz'}"])


def test_many_failures_are_counted(tmp_path: Path) -> None:
    contacts = tuple(Contact("left_hand", "far", first, first + 3) for first in range(0, 50, 10))
    folder = write_folder(tmp_path / "leap", jumping(), replace(scene_at(0.3), contacts=contacts))
    words = ["reconstruction.sentences=2", "reconstruction.moments=1", "reconstruction.size=32"]
    page = run_report(folder, words).read_text(encoding="utf-8")
    assert page.count("<li>") == 2
    assert re.search(r"And \d+ more", page)


def test_faults_are_told_by_the_verb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "leap", jumping(), scene_at(0.3))
    with pytest.raises(InputError, match=r"must be positive") as caught:
        run_report(folder, ["reconstruction.moments=0"])
    assert caught.value.field == "reconstruction.moments"
    (folder / "projection.npz").write_bytes(b"no")
    with pytest.raises(InputError):
        run_report(folder, [])
    other = jumping()
    replace(other, ctrl=other.ctrl * 0.9).save(folder / "plan.npz")
    monkeypatch.setattr("sys.argv", ["egopose report", str(folder)])
    with pytest.raises(SystemExit):
        main()
    assert "do not lead to frame" in capsys.readouterr().err
