"""The physics gate: every clip of the default set and of cmu6 can be followed before anything is learned.

Each clip is started on the reference at every third frame that a body on a bare floor could be in and that contact with
the floor can have made, and driven open-loop by PD at 450 Hz for three control steps. The target of a step is the
reference's joint angles at the frame to be reached plus 0.06 s of its joint velocities there (PD with kd = 0.1 kp lags
by 0.1 s of them). A clip passes when, on average over starts and steps, the root's height is within 1 cm of the
reference and r_p = exp(-300 dh^2 - 75 theta^2) above 0.85. `docs/physics-gate.md` has all figures, those over every
start too.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from helpers.mocap import default_humanoid

from egopose.core.config import compose_config
from egopose.data import gate
from egopose.data.feasibility import contact_residual
from egopose.data.gate import GateResult, gate_sources, open_loop_gate
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.data.take_sources import find_sources
from egopose.humanoid.foot_geometry import sole_positions
from egopose.motion.ground import raised
from egopose.motion.io import read_motion


def clips() -> list[tuple[str, Path]]:
    """Name and file of the default set's clips and, where it is there, of cmu6."""
    found = [(s.name, s.motion) for s in find_sources(compose_config("prepare")["data"])]
    return [*found, *((p.stem, p) for p in sorted((SHARED / "data/cmu_bvh60/subjects").glob("*/*.bvh")))]


@pytest.mark.parametrize(("name", "path"), [pytest.param(*c, id=c[0]) for c in clips()])
def test_gate(name: str, path: Path) -> None:
    humanoid = default_humanoid()
    clip, _ = reference_motion(read_motion(path), humanoid)
    result = open_loop_gate(humanoid, clip)
    assert result.passed, gate.row(name, result)


def test_all_of_cmu6_is_measured(shared: Path) -> None:
    """In CI the folder must be there, and no clip of it slips by."""
    assert sum(path.suffix == ".bvh" for _, path in clips()) == 54


def test_the_gates_settings_are_the_shipped_ones() -> None:
    """The tests above prepare with the defaults in code: the configured ones are the same."""
    for group in ("default", "cmu6"):
        values = compose_config("prepare", [f"data={group}"])["data"]["preparation"]
        assert PreparationSettings.from_mapping(values) == PreparationSettings()


@pytest.fixture(scope="module")
def walk():
    return reference_motion(read_motion(dict(clips())["cmu07_03"]), default_humanoid())[0]


def test_soles_off_the_floor_fail(walk) -> None:
    """Faults on purpose: the gate sees a clip that floats 4 cm, and one that sinks 4 cm."""
    assert open_loop_gate(default_humanoid(), walk).passed
    for shift in (0.04, -0.04):
        assert not open_loop_gate(default_humanoid(), raised(walk, shift)).passed


def test_contact_explains_standing_walking_and_falling_but_not_floating(walk) -> None:
    """Newton's own answers: a body at rest on its soles 0, in free fall 0, at rest in the air its whole weight."""
    humanoid = default_humanoid()
    middle = walk.qpos[len(walk) // 2]
    still = replace(walk, qpos=np.tile(middle, (30, 1)), contacts=None)
    assert contact_residual(humanoid, raised(still, 1.0)) == pytest.approx(1.0, abs=0.05)
    falling = still.qpos.copy()
    falling[:, 2] += 3.0 - 0.5 * 9.81 * (np.arange(30) / walk.fps) ** 2
    assert contact_residual(humanoid, replace(still, qpos=falling)) == pytest.approx(0.0, abs=1e-6)
    assert np.median(contact_residual(humanoid, walk)) < 0.1
    upright = np.zeros((30, len(middle)))
    upright[:, 3] = 1.0

    standing = replace(still, qpos=upright)
    standing = raised(standing, -float(sole_positions(humanoid, standing)[..., 2].min()))
    assert contact_residual(humanoid, standing) == pytest.approx(0.0, abs=0.02)


def test_a_clip_without_a_start_fails(walk) -> None:
    result = open_loop_gate(default_humanoid(), walk.slice(0, 4))
    assert result.starts == 0
    assert not result.passed
    assert np.isnan(result.mean_height_error)
    assert "fails" in gate.row("short", result)


def test_the_number_of_threads_does_not_matter(walk) -> None:
    humanoid = default_humanoid()
    assert open_loop_gate(humanoid, walk, threads=1) == open_loop_gate(humanoid, walk, threads=2)


def test_quick_physics_follows_a_walk_nearly_as_well(walk) -> None:
    fine, coarse = open_loop_gate(default_humanoid(15), walk), open_loop_gate(default_humanoid(5), walk)
    assert coarse.passed
    assert coarse.mean_root_reward == pytest.approx(fine.mean_root_reward, abs=0.04)


def test_the_command_measures_a_configuration(capsys, monkeypatch) -> None:
    sources = find_sources(compose_config("prepare")["data"])
    monkeypatch.setattr(gate, "find_sources", lambda _: [s for s in sources if s.name == "deepmimic_walk"])
    ((name, result),) = gate_sources(compose_config("prepare", ["sim=fast"]))
    assert name == "deepmimic_walk"
    assert isinstance(result, GateResult)
    gate.main(["sim=fast"])
    printed = capsys.readouterr().out
    assert gate.row(name, result) in printed
    assert "1 of 1 clips pass" in printed


def test_the_command_names_what_is_missing(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        gate.main(["data=cmu6"])
    assert stop.value.code == 2
    assert "data.folder" in capsys.readouterr().err
