"""Scores of takes, comparisons over takes and runs, and the tables made of them."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from egopose.core.config_files import config_dir
from egopose.core.result_files import write_columns_csv, write_json
from egopose.evaluation import tables
from egopose.evaluation.protocols import METRICS, ContactSettings, TakeScores, compare, score_take
from egopose.humanoid.config import HumanoidConfig
from egopose.humanoid.model import HumanoidModel, build_humanoid

CONTACT = ContactSettings(height=0.05, speed=0.5)


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        group = OmegaConf.to_container(compose("humanoid/default")["humanoid"], resolve=True)
    return build_humanoid(HumanoidConfig.from_mapping(group))


def standing(humanoid: HumanoidModel, frames: int = 30) -> np.ndarray:
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (frames, 1))
    qpos[:, 0] = np.linspace(0, 1, frames)
    qpos[:, 2] = 0.9
    qpos[:, 7:] = 0.1 * np.sin(np.linspace(0, 6, frames))[:, None]
    return qpos


def made_up(offset: float, seed: int, takes: int = 5) -> list[TakeScores]:
    generator = np.random.default_rng(seed)
    hard = np.linspace(1, 2, takes)
    return [
        TakeScores(f"take{k}", {"E_pose": hard[k] * offset + generator.normal(0, 0.01, 20)}, {}, resets=k)
        for k in range(takes)
    ]


def test_a_perfect_estimate_scores_nothing(humanoid: HumanoidModel) -> None:
    reference = standing(humanoid)
    scores = score_take("walk", reference, reference, humanoid, CONTACT)
    for key in ("E_pose", "E_vel", "mpjpe", "w_mpjpe", "root_translation_error"):
        assert scores.figure(key) == pytest.approx(0, abs=1e-9)
    assert scores.figure("contact_accuracy") == 1
    assert scores.figure("A_accl") > 0
    assert {len(scores.frames[k]) for k in ("E_pose", "E_vel", "A_accl", "jitter")} == {30, 29, 28, 27}


def test_known_faults_show_in_their_metric(humanoid: HumanoidModel) -> None:
    reference = standing(humanoid)
    shifted, sunk = reference.copy(), reference.copy()
    shifted[:, 1] += 0.2
    sunk[:, 2] -= 0.5
    assert score_take("a", shifted, reference, humanoid, CONTACT).figure("mpjpe") == pytest.approx(0.2)
    assert score_take("a", shifted, reference, humanoid, CONTACT).figure("E_pose") == pytest.approx(0, abs=1e-12)
    assert score_take("a", sunk, reference, humanoid, CONTACT).figure("ground_penetration") > 0.3
    one_hand = reference.copy()
    one_hand[:, 7 + humanoid.hand_dofs] += 1.0
    assert score_take("a", one_hand, reference, humanoid, CONTACT).figure("E_pose") == pytest.approx(0, abs=1e-12)


def test_comparison_means_over_takes_then_runs() -> None:
    runs = [made_up(0.8, 1), made_up(0.9, 2)]
    table = compare({"ours": runs, "PoseReg": [made_up(1.0, 3)]}, "PoseReg")
    expected = np.mean([[t.figure("E_pose") for t in run] for run in runs])
    assert table.figures["ours"]["E_pose"].value == pytest.approx(expected)
    assert (table.figures["ours"]["E_pose"].runs, table.figures["PoseReg"]["E_pose"].runs) == (2, 1)
    ratio = table.ratios["ours"]["E_pose"]
    assert ratio.value == pytest.approx(0.85, abs=0.01)
    assert 0.78 < ratio.low < ratio.value < ratio.high < 0.92
    assert table.resets["ours"] == 0 + 1 + 2 + 3 + 4
    assert "E_vel" not in table.figures["ours"]


def test_methods_must_share_takes_and_have_the_baseline() -> None:
    with pytest.raises(ValueError, match="not scored"):
        compare({"ours": [made_up(1, 0, takes=4)], "PoseReg": [made_up(1, 0)]}, "PoseReg")
    with pytest.raises(ValueError, match="no method"):
        compare({"ours": [made_up(1, 0)]}, "PoseReg")


def test_tables_say_the_same_in_every_form(tmp_path) -> None:
    table = compare({"ours": [made_up(0.8, 1)], "PoseReg": [made_up(1.0, 3)]}, "PoseReg")
    value = f"{table.figures['ours']['E_pose'].value:.3f}"
    assert value in tables.as_text(table)
    assert value in tables.as_markdown(table, ["E_pose"])
    assert len(tables.as_markdown(table, ["E_pose"]).splitlines()) == 4
    write_json(tmp_path / "results.json", tables.as_dict(table))
    saved = json.loads((tmp_path / "results.json").read_text())
    assert saved["figures"]["ours"]["E_pose"]["value"] == table.figures["ours"]["E_pose"].value
    assert saved["per_take"]["ours"]["E_vel"][0][0] is None
    tables.write_csv(tmp_path / "takes.csv", table)
    with (tmp_path / "takes.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 10
    assert float(lines[0]["E_pose"]) == pytest.approx(table.per_take["ours"]["E_pose"][0][0], rel=1e-6)
    assert set(lines[0]) == {"method", "run", "take", *(m.key for m in METRICS)}


def test_frames_csv_ends_with_the_take(tmp_path, humanoid: HumanoidModel) -> None:
    scores = score_take("walk", standing(humanoid), standing(humanoid), humanoid, CONTACT)
    write_columns_csv(tmp_path / "walk.csv", {**scores.frames, "confidence": np.ones(30)})
    with (tmp_path / "walk.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 30
    assert (lines[0]["A_accl"], lines[1]["A_accl"]) == ("", "")
    assert float(lines[2]["A_accl"]) == pytest.approx(scores.frames["A_accl"][0], rel=1e-6)
    assert lines[29]["confidence"] == "1"
