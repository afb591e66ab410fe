"""Numbers of simulated bodies: a jump on a box, and a body that stands."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers.jump import UPRIGHT, bare, jumping, scene_at, standing, thrown

from egopose.humanoid.replayed_forces import replay_forces
from egopose.scene.clip import humanoid_in
from egopose.scene.movement_numbers import MovementNumbers, movement_numbers, standing_height, write_numbers_csv
from egopose.scene.scene_file import read_scene
from egopose.scene.simulated import SimulatedMotion, load_simulated


def numbers_of(motion: SimulatedMotion, height: float = 0.3) -> MovementNumbers:
    humanoid = humanoid_in(scene_at(height), bare())
    forces = replay_forces(humanoid, motion.qpos, motion.qvel, motion.ctrl, motion.box_tops, motion.box_headings)
    return movement_numbers(humanoid, forces, motion.box_tops)


@pytest.fixture(scope="module")
def jump() -> MovementNumbers:
    return numbers_of(jumping())


def test_the_jump_is_a_flight_over_the_box(jump: MovementNumbers) -> None:
    (flight,) = jump.flights
    root = jumping().qpos[:, 2]
    assert 31 * jump.substeps <= flight.begin <= 34 * jump.substeps
    assert flight.take_off_speed**2 / (2 * 9.81) == pytest.approx(flight.rise, rel=0.1)
    assert flight.rise_by_time == pytest.approx(flight.rise, abs=0.25 * flight.rise + 0.02)
    # The root rises over its place when standing about as much as the centre of mass does.
    assert flight.rise_standing == pytest.approx(root.max() - 0.3 - UPRIGHT, abs=0.08)
    assert flight.distance < 0.3
    assert jump.off_feet == (True,)
    (landing,) = jump.landings
    assert landing.begin == flight.end
    assert landing.peak > 1.5
    assert landing.load_rate > landing.peak
    assert jump.hardest >= jump.vertical.max()


def test_contacts_and_joints_of_the_jump(jump: MovementNumbers) -> None:
    sides = {side: [c for c in jump.contacts if c.side == side] for side in ("right", "left")}
    for contacts in sides.values():
        assert len(contacts) >= 2
        assert not contacts[0].whole
        assert contacts[0].end == pytest.approx(jump.flights[0].begin, abs=3)
    assert jump.steps == ()
    assert np.isnan(jump.cadence)
    joints = {(one.joint, one.side): one for one in jump.joints}
    for side in ("right", "left"):
        knee, hip, ankle = (joints[name, side] for name in ("knee", "hip", "ankle"))
        assert 50 < knee.most < 90  # the target was 2 x 0.6 rad
        assert 20 < hip.most < 60
        assert ankle.most > 15
        assert 100 < knee.torque < 1000
        assert knee.power > 100
    said = {row.what: row.value for row in jump.rows()}
    assert abs(said["knee peak torque: asymmetry"]) < 40
    assert said["body mass"] == pytest.approx(bare().mj_model.body_mass.sum())


def test_a_standing_body_weighs_its_weight_and_does_not_fly() -> None:
    numbers = numbers_of(standing())
    assert numbers.flights == ()
    assert numbers.vertical[20:].mean() == pytest.approx(1.0, rel=0.01)
    assert {contact.side for contact in numbers.contacts} == {"right", "left"}
    assert all(contact.peak == pytest.approx(0.5, abs=0.4) for contact in numbers.contacts)
    frames = [frame for row in numbers.rows() for frame in row.frames]
    assert max(frames) == len(standing()) - 1


def test_the_standing_height_is_a_persons() -> None:
    """The centre of mass lies at 55 to 60 percent of the height, which here is 1.75 m (Winter 2009)."""
    assert 0.53 < standing_height(bare()) / 1.80 < 0.63


def test_the_table_is_read_back(jump: MovementNumbers, tmp_path: Path) -> None:
    rows = jump.rows()
    write_numbers_csv(rows, tmp_path / "numbers.csv")
    with (tmp_path / "numbers.csv").open(newline="", encoding="utf-8") as stream:
        read = list(csv.DictReader(stream))
    assert [row["what"] for row in read] == [row.what for row in rows]
    assert [float(row["value"]) for row in read if row["value"]] == pytest.approx(
        [row.value for row in rows if np.isfinite(row.value)], rel=1e-6
    )
    assert {row["unit"] for row in read} >= {"kg", "BW", "m", "s", "deg", "N m", "%"}


def test_a_flight_off_the_back_is_no_jump() -> None:
    lying = humanoid_in(scene_at(0.3), bare()).mj_model.qpos0.copy()
    lying[:7] = [-3.0, 0.0, 0.1, np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]
    numbers = numbers_of(thrown(scene_at(0.3), lying, 2.0, 30))
    assert numbers.off_feet == (False,)
    assert numbers.flights[0].time == pytest.approx(2 * 2.0 / 9.81, rel=0.15)
    assert any(row.what == "flight 1, not off the feet: time" for row in numbers.rows())


def test_a_walk_of_motion_capture_has_a_persons_steps() -> None:
    """CMU's walk: adults take 100 to 120 steps a minute of 0.6 to 0.8 m (Winter 2009)."""
    folder = Path(__file__).resolve().parents[2] / "experiments" / "scene_bench" / "clips" / "walk_turn"
    motion, humanoid = load_simulated(folder / "truth.npz"), humanoid_in(read_scene(folder / "scene.yaml"), bare())
    forces = replay_forces(humanoid, motion.qpos, motion.qvel, motion.ctrl, motion.box_tops, motion.box_headings)
    numbers = movement_numbers(humanoid, forces, motion.box_tops)
    assert numbers.flights == ()
    assert 85 < numbers.cadence < 125
    assert len(numbers.steps) >= 5
    assert all(0.55 < step.length < 0.85 for step in numbers.steps)
    assert [step.side for step in numbers.steps[:4]] in (["left", "right"] * 2, ["right", "left"] * 2)
