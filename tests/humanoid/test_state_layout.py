"""The named slices of the humanoid state against what the state holds, and a search for slices without a name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import egopose
from egopose.envs.mdp.observations import humanoid_state, humanoid_state_rows
from egopose.humanoid.state_layout import StateLayout

PARTS = (
    "root_height",
    "root_rotation",
    "joint_angles",
    "root_linear_velocity",
    "root_angular_velocity",
    "joint_velocities",
)


def scipy_rotation(quat: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quat, -1, axis=-1))


@given(st.integers(0, 60), st.integers(0, 2**32 - 1))
def test_each_slice_holds_what_it_says(dofs: int, seed: int) -> None:
    """scipy's rotations; MuJoCo's convention of qpos and qvel."""
    draw = np.random.default_rng(seed)
    qpos, qvel = draw.normal(size=(4, 7 + dofs)), draw.normal(size=(4, 6 + dofs))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    whole = humanoid_state({"qpos": torch.from_numpy(qpos), "qvel": torch.from_numpy(qvel)}).numpy()
    layout = StateLayout(dofs)
    assert whole.shape == (4, layout.size)
    heading = qpos[:, 3:7] * [1.0, 0.0, 0.0, 1.0]
    root, heading = scipy_rotation(qpos[:, 3:7]), scipy_rotation(heading)
    for z in (whole, humanoid_state_rows(qpos, qvel)):
        np.testing.assert_array_equal(z[:, layout.root_height], qpos[:, 2:3])
        np.testing.assert_array_equal(z[:, layout.joint_angles], qpos[:, 7:])
        np.testing.assert_array_equal(z[:, layout.root_angular_velocity], qvel[:, 3:6])
        np.testing.assert_array_equal(z[:, layout.joint_velocities], qvel[:, 6:])
        np.testing.assert_allclose(z[:, layout.root_linear_velocity], heading.inv().apply(qvel[:, :3]), atol=1e-9)
        turned = heading * scipy_rotation(z[:, layout.root_rotation])
        assert (turned.inv() * root).magnitude() == pytest.approx(0.0, abs=1e-7)
        assert (z[:, layout.root_rotation][:, 0] >= 0).all()


@given(st.integers(0, 200))
def test_the_parts_make_up_the_whole_in_order(dofs: int) -> None:
    layout = StateLayout(dofs)
    column = np.arange(layout.size)
    parts = [column[getattr(layout, name)] for name in PARTS]
    np.testing.assert_array_equal(np.concatenate(parts), column)
    assert [len(part) for part in parts] == [1, 4, dofs, 3, 3, dofs]
    for name, members in (
        ("root_pose", PARTS[:2]),
        ("root_velocity", PARTS[3:5]),
        ("velocities", PARTS[3:]),
        ("pose", PARTS[:5]),
        ("rotation_and_angles", PARTS[1:3]),
    ):
        together = np.concatenate([column[getattr(layout, member)] for member in members])
        np.testing.assert_array_equal(column[getattr(layout, name)], together, err_msg=name)
    assert layout.pose_size == layout.pose.stop
    # A pose's own columns are the state's first: the same names serve for both.
    assert all(getattr(layout, name).stop <= layout.pose_size for name in PARTS[:5])
    assert StateLayout.of_size(layout.size) == StateLayout.of_pose_size(layout.pose_size) == layout


def test_the_default_humanoids() -> None:
    """52 joints: 115 numbers, 63 of them a pose."""
    layout = StateLayout(52)
    assert (layout.size, layout.pose_size) == (115, 63)
    assert layout.joint_angles == slice(5, 57)
    assert layout.joint_velocities == slice(63, 115)


@pytest.mark.parametrize("size", [0, 10, 12, 114])
def test_a_size_that_no_state_has_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match="a state has 11"):
        StateLayout.of_size(size)


def test_a_size_that_no_pose_has_is_refused() -> None:
    with pytest.raises(ValueError, match="a pose has 11"):
        StateLayout.of_pose_size(10)
    with pytest.raises(ValueError, match="-1 degrees"):
        StateLayout(-1)


#: Slices and offsets of a state by bare numbers: its root takes 5 before the angles, 11 with its velocities.
BARE = re.compile(
    r"""\[[^\]\n]*\b(?:1\s*:\s*5|5\s*:|:\s*5\s*\+|5\s*\+\s*\w)[^\]\n]*\](?<!\+\ 5\])  # [5:], [:, 5 : 5 + n], [5 + hand]
    | \b11\s*\+ | (?<![\d.])\b5\s*\+\s*(?:torch|np|len|dofs|joints|members|size|qpos|\()  # 11 + dofs, 5 + members
    | \+\s*11\b | -\s*11\b  # (size - 11) // 2
    """,
    re.VERBOSE,
)


def code_lines(path: Path) -> list[tuple[int, str]]:
    """Lines without comments and docstrings."""
    text = re.sub(
        r'""".*?"""', lambda m: "\n" * m.group().count("\n"), path.read_text(encoding="utf8"), flags=re.DOTALL
    )
    return [(number, line.partition("#")[0]) for number, line in enumerate(text.splitlines(), 1)]


@pytest.mark.parametrize(
    "line",
    [
        "return states[:, 1 : 5 + (states.shape[1] - 11) // 2]",
        "out[:, 5 : nq - 2] = qpos[:, 7:]",
        "judged[5 + hand] = 0.0",
        "size = 11 + dofs",
        "angles = 5 + torch.tensor(members)",
        "judged[1:5] = 0",
        "dofs = (size - 11) // 2",
    ],
)
def test_the_search_finds_bare_slices(line: str) -> None:
    assert BARE.search(line)


def test_no_source_slices_a_state_by_bare_numbers() -> None:
    """Models, what makes and reads states, and the experiments."""
    package = Path(egopose.__file__).parent
    rooms = ("humanoid", "data", "models", "envs", "collection", "training", "pipeline", "inference")
    files = [path for room in rooms for path in sorted((package / room).rglob("*.py"))]
    files += sorted((package.parents[1] / "experiments").rglob("*.py"))
    allowed = {package / "humanoid" / "state_layout.py"}
    found = [
        f"{path.name}:{number}: {line.strip()}"
        for path in files
        if path not in allowed
        for number, line in code_lines(path)
        if BARE.search(line)
    ]
    assert not found, "\n".join(found)
