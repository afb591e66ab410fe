"""The study's driver skips what is done and survives interruption; its tables' figures are those of the raw files."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from egopose.core.config import compose_config
from egopose.core.errors import InputError

STUDY = Path(__file__).resolve().parents[2] / "experiments" / "study"


@pytest.fixture(autouse=True)
def study_on_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(STUDY))
    yield
    for name in ("study", "tables"):
        sys.modules.pop(name, None)


def small() -> dict[str, Any]:
    return {
        "budget": 100,
        "data": ["data=default"],
        "seed": ["seed={seed}"],
        "folds": {
            "single": {"a": {"overrides": []}},
            "wild": {"a": {"of": "single", "evaluate": ["vision=wild"], "store": "w"}},
        },
        "methods": {
            "ours": {"verb": "train", "overrides": ["x=1"]},
            "off": {"verb": "train", "of": "ours", "settings": ["failsafe.mode=off"]},
            "posereg": {"verb": "regressor"},
        },
        "tables": [
            {"table": "t", "protocols": ["single", "wild"], "methods": ["posereg", "ours", "off"], "seeds": [0, 1]}
        ],
    }


def write_raw(job: Any, results: Path, **values: Any) -> None:
    path = job.raw(results)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"fingerprint": job.fingerprint, **values}))


@pytest.mark.parametrize(("name", "least"), [("study.yaml", 50), ("large.yaml", 5), ("people.yaml", 10)])
def test_every_job_of_the_study_files_composes(name: str, least: int) -> None:
    from study import list_jobs

    study = yaml.safe_load((STUDY / name).read_text())
    jobs = list_jobs(study)
    assert len(jobs) >= least
    rows = [row for row in study["tables"] if "budget" in row]
    own = {(row["table"], method): row["budget"] for row in rows for method in row["methods"]}
    seen: set[str] = set()
    for job in jobs:
        if {job.method, job.fold, job.protocol} <= seen:
            continue
        seen |= {job.method, job.fold, job.protocol}
        words = [*job.overrides, *job.evaluate, "data.folder=nowhere"]
        config = compose_config("baseline" if job.verb == "baseline" else "train", words)
        if job.verb != "regressor":
            assert config["training"]["total_steps"] == own.get((job.table, job.method), study["budget"])
    for settings in {j.settings for j in jobs}:
        compose_config("evaluate", ["checkpoint=none", *settings])


def test_jobs_share_runs_and_are_told_apart_by_settings_and_budget() -> None:
    from study import list_jobs

    jobs = {job.name: job for job in list_jobs(small())}
    assert len(jobs) == 12
    ours, off, wild = (jobs[f"{m}-a-seed1"] for m in ("ours-single", "off-single", "ours-wild"))
    assert ours.run == off.run == wild.run == "ours-single-a-seed1"
    assert ours.overrides == ("data=default", "x=1", "training.total_steps=100", "seed=1")
    assert wild.evaluate == ("vision=wild",)
    assert wild.evaluate_store == "w"
    assert len({ours.fingerprint, off.fingerprint, wild.fingerprint}) == 3
    larger = {job.name: job for job in list_jobs({**small(), "budget": 200})}
    assert larger["ours-single-a-seed1"].fingerprint != ours.fingerprint
    assert larger["posereg-single-a-seed1"].fingerprint == jobs["posereg-single-a-seed1"].fingerprint
    with pytest.raises(InputError, match="methods"):
        list_jobs({**small(), "tables": [{"table": "t", "protocols": ["single"], "methods": ["?"], "seeds": [0]}]})
    with pytest.raises(InputError, match="twice"):
        list_jobs({**small(), "tables": small()["tables"] * 2})


def test_a_row_has_a_budget_of_its_own_and_may_judge_survival() -> None:
    from study import list_jobs

    before = {job.name: job.fingerprint for job in list_jobs(small())}
    study = small()
    study["folds"]["easier"] = {"a": {"overrides": []}}
    row = {"table": "u", "protocols": ["easier"], "methods": ["ours"], "seeds": [0], "budget": 40, "survival": True}
    study["tables"].append(row)
    jobs = {job.name: job for job in list_jobs(study)}
    own = jobs.pop("ours-easier-a-seed0")
    assert {name: job.fingerprint for name, job in jobs.items()} == before
    assert own.overrides == ("data=default", "x=1", "training.total_steps=40", "seed=0")
    assert own.run == "ours-easier-a-seed0"
    assert own.survival
    row["survival"] = False
    assert list_jobs(study)[-1].fingerprint != own.fingerprint


def test_done_jobs_are_skipped_and_an_interrupted_study_goes_on(tmp_path: Path) -> None:
    from study import INTERRUPTED, list_jobs, run_study

    jobs, launched = list_jobs(small()), []
    write_raw(jobs[0], tmp_path)
    jobs[1].raw(tmp_path).write_text('{"fingerprint": "of other settings"}')
    jobs[2].raw(tmp_path).write_text('{"finge')  # cut off

    def launch(job: Any, seconds: float | None) -> int:
        launched.append(job.name)
        if len(launched) == 3:
            return INTERRUPTED
        if job is jobs[2]:
            return 1
        write_raw(job, tmp_path)
        return 0

    with pytest.raises(SystemExit) as stopped:
        run_study(jobs, tmp_path, launch)
    assert stopped.value.code == 130
    assert launched == [jobs[1].name, jobs[2].name, jobs[3].name]
    # One failed, one was interrupted: both are taken up again, and the failure does not stop the rest.
    assert run_study(jobs, tmp_path, launch) == [jobs[2].name]
    assert launched[3:] == [job.name for job in jobs[2:]]
    assert run_study(jobs, tmp_path, launch) == [jobs[2].name]
    with pytest.raises(SystemExit):
        run_study(jobs, tmp_path, launch, seconds=0.0)


def raw(folder: Path, method: str, fold: str, seed: int, figures: dict[str, Any], **more: Any) -> None:
    takes = [f"{fold}{k}" for k in range(len(next(iter(figures.values()))))]
    forecasts = "horizons" in more
    table, protocol = ("table3_horizons", "forecast_single") if forecasts else ("table1_estimation", "single")
    path = folder / table / "raw" / f"{method}-{fold}-{seed}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    result = {
        **{"method": method, "protocol": protocol, "fold": fold, "seed": seed, "takes": takes, "figures": figures},
        **{"overrides": ["training.total_steps=100"], "resets": [0] * len(takes), "frames": [900] * len(takes)},
    }
    path.write_text(json.dumps({**result, **more}))


def test_ratios_are_those_worked_out_by_hand(tmp_path: Path) -> None:
    from tables import write_tables

    for seed, scale in ((0, 1.0), (1, 3.0)):
        raw(tmp_path, "ours", "a", seed, {"E_pose": [1.0 * scale, 2.0 * scale], "E_vel": [1, 1], "A_accl": [1, None]})
        raw(tmp_path, "ours", "b", seed, {"E_pose": [3.0 * scale], "E_vel": [1], "A_accl": [3]})
    raw(tmp_path, "posereg", "a", 0, {"E_pose": [2.0, 4.0], "E_vel": [2, 2], "A_accl": [2, 100]})
    raw(tmp_path, "posereg", "b", 0, {"E_pose": [12.0], "E_vel": [2], "A_accl": [4]})
    raw(tmp_path, "vgail", "a", 0, {"E_pose": [4.0, 8.0], "E_vel": [1, 1], "A_accl": [1, 1]})
    horizons = [1 / 3, 2 / 3, 1.0, 2.0, 3.0]
    table = {key: [[1.0, 1.0, 2.0, 3.0, 4.0]] for key in ("E_pose", "E_vel", "A_accl")}
    raw(tmp_path, "ours_forecast", "a", 0, table, horizons=horizons)
    table = {key: [[1.0, 1.0, 4.0, 3.0, 5.0]] for key in ("E_pose", "E_vel", "A_accl")}
    raw(tmp_path, "erd", "a", 0, table, horizons=horizons)

    found = write_tables(tmp_path)
    assert json.loads((tmp_path / "ratios.json").read_text()) == found
    # Over seeds and takes: ours (1 + 2 + 3 + 3 + 6 + 9) / 6 = 4, PoseReg (2 + 4 + 12) / 3 = 6.
    posereg = found["single/e_pose/posereg"]
    assert (posereg["ours"], posereg["baseline"]) == (4.0, 6.0)
    assert posereg["ratio"] == pytest.approx(4 / 6)
    assert posereg["paper"] == pytest.approx(0.768)
    assert (posereg["seeds"], posereg["takes"], posereg["folds"]) == (2, 3, ["a", "b"])
    assert posereg["low"] < posereg["ratio"] < posereg["high"]
    # VGAIL was measured in one fold only: (1 + 2 + 3 + 6) / 4 against (4 + 8) / 2.
    assert found["single/e_pose/vgail"]["ratio"] == pytest.approx(3 / 6)
    # A take without a figure counts for neither.
    assert found["single/a_accl/posereg"]["ratio"] == pytest.approx(2 / 3)
    assert found["single/e_vel/posereg"]["low"] == found["single/e_vel/posereg"]["high"] == pytest.approx(0.5)
    assert found["forecast/e_pose_1s/erd"]["ratio"] == pytest.approx(0.5)
    assert found["forecast/e_pose_3s/erd"]["ratio"] == pytest.approx(0.8)
    assert found["forecast/e_vel/erd"]["ratio"] == pytest.approx(0.8)
    assert not any(name.startswith(("cross", "wild", "forecast_cross")) or "aclstm" in name for name in found)
    shown = (tmp_path / "table1_estimation" / "README.md").read_text()
    assert "| PoseReg | 6.000 [" in shown
    assert "0.667 [" in shown


def test_data_that_the_paper_has_not_is_compared_without_its_ratios(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    import tables

    for method, error in (("ours", 1.0), ("posereg", 4.0)):
        raw(tmp_path, method, "a", 0, {key: [error] for key in ("E_pose", "E_vel", "A_accl")}, protocol="large")
    monkeypatch.setattr(sys, "argv", ["tables.py", "--results", str(tmp_path)])
    tables.main()
    assert "large/e_pose/posereg             0.250 [0.250, 0.250]\n" in capsys.readouterr().out
    found = json.loads((tmp_path / "ratios.json").read_text())["large/e_pose/posereg"]
    assert (found["ratio"], found["paper"]) == (0.25, None)
    shown = (tmp_path / "table1_estimation" / "README.md").read_text()
    assert "| large/e_pose/posereg | 0.250 [0.250, 0.250] |  |" in shown


def test_results_of_other_takes_or_smaller_budgets_are_not_compared(tmp_path: Path, capsys) -> None:
    from tables import write_tables

    one = {"E_pose": [1.0], "E_vel": [1], "A_accl": [1]}
    raw(tmp_path, "ours", "a", 0, one)
    raw(tmp_path, "vgail", "a", 0, {key: [1.0, 2.0] for key in one})
    with pytest.raises(InputError, match="other takes"):
        write_tables(tmp_path)
    raw(tmp_path, "vgail", "a", 0, one, overrides=["training.total_steps=9"])
    raw(tmp_path, "posereg", "a", 0, one, overrides=[])
    assert {name.rsplit("/", 1)[1] for name in write_tables(tmp_path)} == {"posereg"}
    assert "left out: vgail-a-0.json had 9 of 100" in capsys.readouterr().err
    (tmp_path / "table1_estimation" / "raw" / "vgail-a-0.json").write_text('{"overrides": []}')
    with pytest.raises(InputError, match="damaged"):
        write_tables(tmp_path)
