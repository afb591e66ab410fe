"""E_key: the side view's projection, OpenPose's files, and what does not count."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.evaluation.keypoints import KEYPOINTS, motion_keypoints, read_openpose, side_view, side_view_error
from egopose.evaluation.protocols import ContactSettings, score_take
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion


def test_the_camera_stands_on_the_right_whatever_the_heading() -> None:
    ahead, left, up = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]
    still = np.array([[1.0, 0.0, 0.0, 0.0]])
    points = np.array([[ahead, left, up]])
    assert side_view(points, still, 4.0)[0] == pytest.approx(np.array([[0.25, 0.0], [0.0, 0.0], [0.0, -0.5]]))
    turned = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array([0.7]))
    moved = rot.rotate(np.broadcast_to(turned[:, None], (1, 3, 4)), points)
    assert side_view(moved, turned, 4.0) == pytest.approx(side_view(points, still, 4.0))
    with pytest.raises(ValueError, match="behind"):
        side_view(np.array([[[0.0, -5.0, 0.0]]]), still, 4.0)


def test_e_key_of_a_motion_forgets_the_root_and_sees_the_limbs() -> None:
    humanoid = humanoid_of(compose_config("train"))
    qpos = np.tile(humanoid.mj_model.qpos0, (6, 1))
    qpos[:, 2], qpos[:, 7:] = 1.0, humanoid.rest_action
    other = qpos.copy()
    other[:, 0] += 3.0
    other[:, 3:7] = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(1.0))
    contact = ContactSettings(0.03, 0.5)
    assert score_take("a", other, qpos, humanoid, contact).figure("E_key") == pytest.approx(0.0, abs=1e-9)
    column = 7 + [f"{j.name}_{k}" for j in humanoid.skeleton.joints for k in range(len(j.dofs))].index("RightLeg_0")
    other[:, column] += 0.5
    assert score_take("a", other, qpos, humanoid, contact).figure("E_key") > 0.005
    # Lying down: no scale, no figure.
    lying = qpos.copy()
    lying[:, 3:7] = rot.from_axis_angle(np.array([0.0, 1.0, 0.0]), np.array(np.pi / 2))
    positions = Motion(humanoid.skeleton, lying, 30.0).forward_kinematics()[0]
    points = motion_keypoints(humanoid.skeleton, positions, lying)
    assert side_view_error(points, points) == (pytest.approx(float("nan"), nan_ok=True), 0)


def write(folder: Path, frame: int, *people: list[float]) -> None:
    card = {"version": 1.3, "people": [{"pose_keypoints_2d": row} for row in people]}
    (folder / f"walk_{frame:012d}_keypoints.json").write_text(json.dumps(card))


def person(size: int, confidence: float, shift: float = 0.0) -> list[float]:
    return [v for k in range(size) for v in (k + shift, 10.0 * k, confidence)]


def test_openpose_files_of_both_models_are_read_in_order(tmp_path: Path) -> None:
    write(tmp_path, 2, person(18, 0.9))
    write(tmp_path, 0, person(25, 0.5, 100.0), person(25, 0.9))
    write(tmp_path, 1)
    found = read_openpose(tmp_path, 0.3)
    assert found.shape == (3, len(KEYPOINTS), 2)
    assert found[0, :, 0].tolist() == [2, 3, 4, 9, 10, 11, 5, 6, 7, 12, 13, 14]
    assert np.isnan(found[1]).all()
    assert found[2, :, 0].tolist() == [2, 3, 4, 8, 9, 10, 5, 6, 7, 11, 12, 13]
    assert np.isnan(read_openpose(tmp_path, 0.95)).all()


@pytest.mark.parametrize(
    ("text", "field"),
    [("{}", "people"), ('{"people": [{}]}', "pose_keypoints_2d"), ('{"people": [{"pose_keypoints_2d": [1]}]}', "pose")],
)
def test_other_files_are_refused_by_name(text: str, field: str, tmp_path: Path) -> None:
    (tmp_path / "a_keypoints.json").write_text(text)
    with pytest.raises(InputError, match=field):
        read_openpose(tmp_path, 0.3)
    with pytest.raises(InputError, match="keypoints"):
        read_openpose(tmp_path / "empty", 0.3)
