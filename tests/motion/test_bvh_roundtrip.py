"""BVH written and read again: any skeleton, any hinge axes, slides, units and up axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.any_motion import motions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.motion import rotations as rot
from egopose.motion.io import read_motion, write_motion
from egopose.motion.io.frames import UNITS, UP_AXES
from egopose.motion.kinematics import tip_positions
from egopose.motion.motion import Motion


def distances(a: Motion, b: Motion) -> tuple[float, float]:
    """Largest distance of joints and tips (m) and angle between joints (rad) of two motions, joints by name."""
    order = [b.skeleton.index(n) for n in a.skeleton.names]
    (pa, qa), (pb, qb) = a.forward_kinematics(), b.forward_kinematics()
    metres = np.linalg.norm(pa - pb[:, order], axis=-1).max()
    angle = np.linalg.norm(rot.to_rotvec(rot.multiply(rot.conjugate(qa), qb[:, order])), axis=-1).max()
    tips_a, tips_b = (dict(zip(*_tips(m), strict=True)) for m in (a, b))
    assert set(tips_a) == set(tips_b)
    for name in tips_a:
        metres = max(metres, np.linalg.norm(tips_a[name] - tips_b[name], axis=-1).max())
    return float(metres), float(angle)


def _tips(motion: Motion) -> tuple[list[tuple[str, int]], np.ndarray]:
    names, points = tip_positions(motion.skeleton, *motion.forward_kinematics())
    numbered = [(n, names[:k].count(n)) for k, n in enumerate(names)]
    return numbered, np.moveaxis(points, -2, 0)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(motion=motions(), unit=st.sampled_from(sorted(UNITS)), up=st.sampled_from(UP_AXES))
def test_any_motion_survives(motion: Motion, unit: str, up: str, tmp_path: Path) -> None:
    path = tmp_path / "m.bvh"
    write_motion(motion, path, unit=unit, up=up)
    back = read_motion(path, unit=unit, up=up)
    assert back.fps == pytest.approx(motion.fps, rel=1e-6)
    metres, angle = distances(motion, back)
    assert metres < 1e-4
    assert angle < 1e-4


@pytest.mark.parametrize("unit", sorted(UNITS))
@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_unit_and_up_axis_are_found_again(shared: Path, tmp_path: Path, unit: str, up: str) -> None:
    data = shared / "data"
    for source in (data / "cmu_bvh60/subjects/002/002_01.bvh", data / "cmu_bvh120/01_01.bvh"):
        motion = read_motion(source).slice(1, 120)
        write_motion(motion, tmp_path / "m.bvh", unit=unit, up=up)
        back = read_motion(tmp_path / "m.bvh")
        assert (back.meta["unit"], back.meta["up"]) == (unit, up)
        metres, angle = distances(motion, back)
        assert metres < 1e-4
        assert angle < 1e-4


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_channel_orders_and_partial_channels(tmp_path: Path, order: str) -> None:
    angles = dict(zip("XYZ", (30.0, -40.0, 70.0), strict=True))
    path = tmp_path / "m.bvh"
    path.write_text(
        "HIERARCHY\nROOT Hips\n{\nOFFSET 1 2 3\nCHANNELS 4 Yposition "
        + " ".join(f"{a}rotation" for a in order)
        + "\nJOINT Left Foot {\nOFFSET 0 100 0\nCHANNELS 1 Xrotation\nEnd Site\n{\nOFFSET 0 10 0\n}\n}\n}\n"
        + "MOTION\nFrames: 1\nFrame Time: 0.04\n"
        + " ".join(["90", *(str(angles[a]) for a in order), "15"])
        + "\n"
    )
    motion = read_motion(path, unit="cm", up="z")
    matrix = np.eye(3)
    for a in order:
        c, s, k = np.cos(np.deg2rad(angles[a])), np.sin(np.deg2rad(angles[a])), "XYZ".index(a)
        turn = np.eye(3)
        i, j = (k + 1) % 3, (k + 2) % 3
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        matrix = matrix @ turn
    positions, quats = motion.forward_kinematics()
    np.testing.assert_allclose(rot.to_matrix(quats)[0, 0], matrix, atol=1e-9)
    np.testing.assert_allclose(positions[0, 0], [0.01, 0.90, 0.03], atol=1e-12)
    np.testing.assert_allclose(positions[0, 1], positions[0, 0] + matrix @ [0, 1, 0], atol=1e-9)
    assert motion.skeleton.names == ("Hips", "Left Foot")


def test_six_channels_fold_or_slide(tmp_path: Path) -> None:
    def text(second: float) -> str:
        channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
        row = "0 0 0 0 0 0  0 90 0 0 0 0  0 {} 0 10 20 30\n"
        return (
            f"HIERARCHY\nROOT Static\n{{\nOFFSET 0 0 0\n{channels}\nJOINT Hips\n{{\nOFFSET 0 90 0\n{channels}\n"
            f"End Site\n{{\nOFFSET 0 0 10\n}}\n"
            f"JOINT Head\n{{\nOFFSET 0 50 0\n{channels}\nEnd Site\n{{\nOFFSET 0 0 0\n}}\n}}\n}}\n}}\n"
            f"MOTION\nFrames: 2\nFrame Time: 0.04\n{row.format(60)}{row.format(second)}"
        )

    path = tmp_path / "m.bvh"
    path.write_text(text(60.0001))
    motion = read_motion(path, unit="cm", up="y")
    assert motion.meta["folded_roots"] == ["Static"]
    assert motion.skeleton.names == ("Hips", "Head")
    assert motion.skeleton.n_dofs == 3
    np.testing.assert_allclose(motion.skeleton.joints[1].offset, [0, 0.6, 0], atol=1e-5)
    assert motion.skeleton.joints[1].tips == ()
    path.write_text(text(65.0))
    motion = read_motion(path, unit="cm", up="y")
    assert [d.kind for d in motion.skeleton.joints[1].dofs] == ["slide"] * 3 + ["hinge"] * 3
    np.testing.assert_allclose(motion.qpos[:, 8], [0.10, 0.15], atol=1e-9)
    positions, _ = motion.forward_kinematics()
    np.testing.assert_allclose(positions[:, 1, 2], [1.5, 1.55], atol=1e-9)


def test_a_root_the_body_moves_against_is_folded(tmp_path: Path) -> None:
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    path = tmp_path / "m.bvh"
    path.write_text(
        f"HIERARCHY\nROOT World\n{{\nOFFSET 0 0 0\n{channels}\nJOINT Hips\n{{\nOFFSET 0 90 0\n{channels}\n"
        "JOINT Head\n{\nOFFSET 0 60 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n}\n}\n}\n"
        "MOTION\nFrames: 2\nFrame Time: 0.04\n"
        "100 0 0 90 0 0  0 90 0 0 0 0  0 0 0\n200 0 0 90 0 0  0 95 0 -90 0 0  0 0 0\n"
    )
    motion = read_motion(path, unit="cm", up="z")
    assert motion.skeleton.names == ("Hips", "Head")
    assert motion.skeleton.n_dofs == 3
    positions, _ = motion.forward_kinematics()
    # The root is turned a quarter about z: its y is the world's -x.
    np.testing.assert_allclose(positions[:, 0], [[0.1, 0, 0], [1.05, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(positions[:, 1], [[-0.5, 0, 0], [1.05, 0.6, 0]], atol=1e-12)
