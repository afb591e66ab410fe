"""A reconstruction's folder: read, refused where it does not fit, exported with the simulation's own forces."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.jump import STEP, bare, jumping, scene_at, write_folder

from egopose.benchmarks.read_back import read_glb
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.inference.export import run_export
from egopose.inference.reconstruction import Reconstruction, read_reconstruction, reconstruction_folder
from egopose.motion.io import read_motion
from egopose.scene.scene_file import write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("made") / "leap", jumping(), scene_at(0.3))


@pytest.fixture(scope="module")
def found(folder: Path) -> Reconstruction:
    return read_reconstruction(folder, bare())


def test_the_motion_is_the_simulated_one_with_its_forces(found: Reconstruction) -> None:
    np.testing.assert_array_equal(found.motion.qpos, jumping().qpos)
    assert found.motion.fps == pytest.approx(30.0)
    assert found.motion.torques is not None
    assert found.motion.ground_reaction is not None
    assert found.forces.drift == 0.0
    assert len(found.numbers.flights) == 1


def test_boxes_are_where_the_simulation_had_them(tmp_path: Path) -> None:
    """Fitting moves boxes: the plan's places count, the scene file's first guess stays beside them."""
    write_folder(tmp_path, jumping(), scene_at(0.45))
    found = read_reconstruction(tmp_path, bare())
    assert found.scene.box("step").height == pytest.approx(0.3)
    assert found.clip.scene.box("step").height == pytest.approx(0.45)
    np.testing.assert_allclose(found.box_tops, jumping().box_tops)


def test_a_folder_or_its_plan_is_known(folder: Path, tmp_path: Path) -> None:
    assert reconstruction_folder(folder) == folder
    assert reconstruction_folder(folder / "plan.npz") == folder
    assert reconstruction_folder(folder / "body.npz") is None
    assert reconstruction_folder(tmp_path) is None


def test_what_does_not_fit_is_told(tmp_path: Path) -> None:
    write_folder(tmp_path, jumping(), scene_at(0.3))
    write_scene(replace(scene_at(0.3), boxes=(STEP,)), tmp_path / "scene.yaml")
    with pytest.raises(InputError, match=r"scene\.yaml has 1") as caught:
        read_reconstruction(tmp_path, bare())
    assert caught.value.field == "box_tops"
    motion = jumping()
    other = replace(motion, ctrl=motion.ctrl + 0.01)
    write_folder(tmp_path, other, scene_at(0.3))
    with pytest.raises(InputError, match="do not lead") as caught:
        read_reconstruction(tmp_path, bare())
    assert caught.value.field == "ctrl"


def test_a_plan_of_another_clip_is_told(tmp_path: Path) -> None:
    write_folder(tmp_path, jumping(), scene_at(0.3))
    motion = jumping()
    shorter = replace(motion, qpos=motion.qpos[:-1], qvel=motion.qvel[:-1], ctrl=motion.ctrl[:-1])
    shorter.save(tmp_path / "plan.npz")
    with pytest.raises(InputError, match="60 frames; the clip has 61"):
        read_reconstruction(tmp_path, bare())
    (tmp_path / "plan.npz").write_bytes(b"PK no archive")
    with pytest.raises(InputError):
        read_reconstruction(tmp_path, bare())


def test_all_formats_hold_the_simulations_forces(folder: Path, found: Reconstruction, tmp_path: Path) -> None:
    endings = (".bvh", ".npz", ".mot", ".forces.mot", ".torques.sto", ".glb", ".csv", ".c3d", ".numbers.csv")
    files = [str(tmp_path / "{take}") + ending for ending in endings]
    written = run_export(folder, files, compose_config("export"))
    assert [path.name for path in written] == [f"leap{ending}" for ending in endings]
    native = read_motion(tmp_path / "leap.npz")
    np.testing.assert_array_equal(native.qpos, jumping().qpos)
    assert native.torques == pytest.approx(found.motion.torques)
    ground = native.ground_reaction
    assert ground is not None
    assert found.motion.ground_reaction is not None
    np.testing.assert_array_equal(ground.force, found.motion.ground_reaction.force)
    assert read_glb(tmp_path / "leap.glb").forces
    rows = [line.split() for line in (tmp_path / "leap.forces.mot").read_text().splitlines()]
    names = rows[6]
    upward = [names.index(f"{body}_ground_force_vy") for body in ground.bodies]
    table = np.array(rows[7:], dtype=np.float64)
    np.testing.assert_allclose(table[:, upward], ground.force[..., 2], rtol=1e-6, atol=1e-6)
    with (tmp_path / "leap.numbers.csv").open(newline="") as stream:
        said = {row["what"]: row["value"] for row in csv.DictReader(stream)}
    assert float(said["flight 1: time"]) == pytest.approx(found.numbers.flights[0].time)


def test_the_plan_itself_and_the_kinematic_part(folder: Path, tmp_path: Path) -> None:
    config = compose_config("export")
    run_export(folder / "plan.npz", [str(tmp_path / "simulated.npz")], config)
    np.testing.assert_array_equal(read_motion(tmp_path / "simulated.npz").qpos, jumping().qpos)
    quiet = {**config, "forces": {**config["forces"], "enabled": False}}
    run_export(folder, [str(tmp_path / "kinematic.npz")], {**quiet, "part": "reference"})
    kinematic = read_motion(tmp_path / "kinematic.npz")
    np.testing.assert_array_equal(kinematic.qpos, read_motion(folder / "body.npz").qpos)
    before = (folder / "plan.npz").read_bytes()
    with pytest.raises(InputError, match="the motion itself"):
        run_export(folder, [str(folder / "plan.npz")], config)
    assert (folder / "plan.npz").read_bytes() == before


def test_every_step_of_physics_has_its_own_forces(folder: Path, found: Reconstruction, tmp_path: Path) -> None:
    config = compose_config("export")
    run_export(folder, [str(tmp_path / "fine.npz")], {**config, "rate": "physics"})
    fine = read_motion(tmp_path / "fine.npz")
    assert fine.fps == pytest.approx(120.0)
    assert len(fine) == 4 * (len(jumping()) - 1)
    np.testing.assert_array_equal(fine.qpos[::4], jumping().qpos[:-1])
    ground = fine.ground_reaction
    assert ground is not None
    total = ground.force.sum(axis=1)
    np.testing.assert_allclose(total, found.forces.force.sum(axis=(1, 2)))
    assert total[:, 2].max() / found.forces.weight == pytest.approx(found.numbers.hardest)
    assert fine.torques is not None
    np.testing.assert_array_equal(fine.torques, found.forces.torques)
    with pytest.raises(InputError, match="control or physics") as caught:
        run_export(folder, [str(tmp_path / "fine.npz")], {**config, "rate": "fast"})
    assert caught.value.field == "rate"


def test_a_simulated_motion_that_lies_elsewhere(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "leap", jumping(), scene_at(0.3))
    (folder / "plan.npz").rename(tmp_path / "simulated.npz")
    config = {**compose_config("export"), "simulated": str(tmp_path / "simulated.npz")}
    run_export(folder, [str(tmp_path / "out.npz")], config)
    np.testing.assert_array_equal(read_motion(tmp_path / "out.npz").qpos, jumping().qpos)
    with pytest.raises(InputError, match="folder of a prepared clip") as caught:
        run_export(folder / "body.npz", [str(tmp_path / "out.npz")], config)
    assert caught.value.field == "simulated"


def test_numbers_of_another_source_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs a reconstruction"):
        run_export(folder / "body.npz", [str(tmp_path / "x.numbers.csv")], compose_config("export"))
