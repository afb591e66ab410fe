"""What no person does is refused, what people seldom do is said, and a plain motion passes without a word."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.mocap import RIGS, default_humanoid, rig_motion
from helpers.rigs import PLAIN, STANDING, Rig, write_rig

from egopose.core.errors import InputError
from egopose.data.prepare_motion import reference_motion
from egopose.data.report import store_report
from egopose.data.store import TakeInfo
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.motion.plausibility import (
    Finding,
    floor_findings,
    refuse,
    retarget_findings,
    source_findings,
    tell,
)

HUMANOID = default_humanoid()


def person(rig: Rig, folder: Path, unit: str | float = "cm", up: str = "y") -> Motion:
    return read_motion(write_rig(rig, folder / "person.bvh"), unit=unit, up=up)


@pytest.mark.parametrize("rig", RIGS)
def test_nothing_is_said_of_real_files(rig: str, shared: Path, tmp_path: Path) -> None:
    assert source_findings(rig_motion(rig, shared, tmp_path)) == []


@pytest.mark.parametrize(("unit", "severity"), [(0.01, None), (0.0042, "warning"), (0.015, "warning"), (0.1, "error")])
def test_a_wrong_unit(unit: float, severity: str | None, tmp_path: Path) -> None:
    found = source_findings(person(STANDING, tmp_path, unit))
    assert [f.severity for f in found] == ([] if severity is None else [severity])
    if severity == "error":
        with pytest.raises(InputError, match=r"person\.bvh: motion: the person is 17 m tall; .*reader\.unit"):
            reference_motion(person(STANDING, tmp_path, unit), HUMANOID)


def test_a_wrong_up_axis_is_said_and_not_refused(tmp_path: Path) -> None:
    """It looks like a handstand, or like somebody lying, and both are real."""
    _, report = reference_motion(person(STANDING, tmp_path, up="-y"), HUMANOID)
    assert any("head is below the hips in frames 0 to 119" in line and "reader.up" in line for line in report.warnings)
    _, report = reference_motion(person(STANDING, tmp_path, up="z"), HUMANOID)
    assert any("lies or bends down in 100%" in line and "reader.up" in line for line in report.warnings)


def test_a_short_turn_upside_down_is_no_matter(tmp_path: Path) -> None:
    motion = person(STANDING, tmp_path)
    qpos = motion.qpos.copy()
    over = person(STANDING, tmp_path, up="-y").qpos
    qpos[50:70, 3:7] = over[50:70, 3:7]
    assert not [f for f in source_findings(replace(motion, qpos=qpos)) if "head" in f.what]
    qpos[20:100, 3:7] = over[20:100, 3:7]
    (found,) = [f for f in source_findings(replace(motion, qpos=qpos)) if "head" in f.what]
    assert (found.severity, found.frame) == ("warning", 20)


def test_jumps_are_said_and_a_wrong_rate_is_refused(tmp_path: Path) -> None:
    motion = person(STANDING, tmp_path)
    qpos = motion.qpos.copy()
    qpos[60:, 0] += 2.0
    (found,) = source_findings(replace(motion, qpos=qpos))
    assert (found.severity, found.joint, found.frame in (59, 60)) == ("warning", "hips", True)
    assert found.value == pytest.approx(30.0, rel=0.05)
    qpos[:, 0] += 1.0 * np.arange(120)
    assert [f.severity for f in source_findings(replace(motion, qpos=qpos))] == ["error"]


def test_a_joint_that_plays_the_wrong_part_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="mapping"):
        reference_motion(
            person(PLAIN, tmp_path), HUMANOID, overrides={"left_shin": "LeftFoot", "left_foot": "LeftToeBase"}
        )


def test_errors_of_retargeting() -> None:
    parts = {"left_hand": (80.0, 200.0), "head": (1.0, 60.0)}
    (found,) = retarget_findings(parts, {"left_hand": 7, "head": 3}, 1.0)
    assert (found.severity, found.joint, found.frame, found.value) == ("error", "left_hand", 7, 80.0)
    (found,) = retarget_findings({"head": (1.0, 60.0)}, {"head": 3}, 1.0)
    assert (found.severity, found.joint, found.frame, found.value) == ("warning", "head", 3, 60.0)
    assert retarget_findings({"head": (1.0, 49.0)}, {"head": 3}, 1.0) == []
    assert [f.severity for f in retarget_findings({}, {}, 3.5)] == ["error"]
    assert [f.severity for f in retarget_findings({}, {}, 0.2)] == ["error"]


def test_feet_that_are_not_on_the_floor() -> None:
    soles, up = np.zeros((50, 2, 2, 3)), np.array([0.0, 0.0, 0.2])
    soles[:, :, 1, 0] = 0.2
    touching, high = np.ones((50, 2, 2), dtype=bool), np.full(50, 0.3)
    assert floor_findings(soles, touching, high) == []
    (found,) = floor_findings(soles + up, ~touching, high)
    assert "nothing touches the floor in 100%" in found.what
    assert floor_findings(soles + up, ~touching, np.zeros(50)) == []  # it lies
    (found,) = floor_findings(soles - up / 2, touching, high)
    assert "10 cm under the floor" in found.what
    soles[:, 0, 0, 2] = 0.1
    (found,) = floor_findings(soles, touching, high)
    assert (found.joint, found.value) == ("right_foot", pytest.approx(27.0, abs=1.0))


def test_findings_become_one_error_or_lines() -> None:
    mild = Finding("warning", "odd", "hips", 4, 1.0, "set this")
    grave = replace(mild, severity="error")
    assert refuse([mild], "a.bvh") == ["odd (hips, frame 4); set this"]
    with pytest.raises(InputError, match=r"a\.bvh: hips: odd \(hips, frame 4\); set this"):
        refuse([mild, grave], "a.bvh")
    lines: list[str] = []
    tell([grave, mild], "a", lines.append)
    assert lines == ["warning: a: odd (hips, frame 4); set this"] * 2


def test_the_report_of_a_store_says_the_warnings() -> None:
    take = TakeInfo("a", "1", 0, 9, 1.4, "a.bvh", "v.mp4", 0.0, True, ((0, 9),), 1.0, warnings=("odd; set this",))

    class Store:
        takes, fps, frames_total, root, left_out = (take,), 30.0, 9, "store", ()

    assert "warning: a: odd; set this" in store_report(Store())  # type: ignore[arg-type]
