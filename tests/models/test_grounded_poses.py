"""Forecasts made to stand: against MuJoCo's centre of mass, and soles followed in the world."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid

from egopose.humanoid.foot_geometry import sole_edges
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.grounded_poses import grounded
from egopose.models.pose_regression import integrated_path, state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.rotations import Array

FRAMES, FPS, AHEAD = 40, 30.0, 0.05


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return default_humanoid()


def layout_of(humanoid: HumanoidModel) -> StateLayout:
    return StateLayout(humanoid.mj_model.nu)


def swaying(humanoid: HumanoidModel, lean: float, height: float, swing: float) -> Array:
    """``[1, T, P]`` a standing body that swings its hips and knees, with a root that knows nothing of it."""
    layout = layout_of(humanoid)
    poses = np.zeros((1, FRAMES, layout.pose_size))
    poses[..., 0] = height
    poses[..., layout.root_rotation] = rot.from_rotvec(np.array([0.5 * lean, lean, 0.0]))
    names = [joint.name for joint in humanoid.skeleton.joints[1:] for _ in joint.dofs]
    phase = 2 * np.pi * np.arange(FRAMES) / FRAMES
    for joint in ("RightUpLeg", "LeftUpLeg", "RightLeg"):
        poses[..., layout.joint_angles.start + names.index(joint)] = swing * (1.0 - np.cos(phase))
    poses[..., layout.root_linear_velocity] = 0.7, -0.3, 0.2
    poses[..., layout.root_angular_velocity] = 0.4, 0.5, -0.6
    return poses


def in_the_world(poses: Array, humanoid: HumanoidModel) -> Array:
    """``[T, nq]`` along the path of the poses' own velocities."""
    states = np.concatenate([poses[0], np.zeros((FRAMES, layout_of(humanoid).dofs))], axis=-1)
    path = integrated_path(states, FPS)
    heading = rot.from_rotvec(np.column_stack([np.zeros((FRAMES, 2)), path[:, 2]]))
    return state_to_qpos(states, path[:, :2], heading)[0]


def mass_ahead(qpos: Array, humanoid: HumanoidModel) -> Array:
    """``[2]`` m, ahead and to the left: MuJoCo's centre of mass from the middle of both soles."""
    data = mujoco.MjData(humanoid.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(humanoid.mj_model, data)
    mujoco.mj_comPos(humanoid.mj_model, data)
    soles = sole_edges(humanoid, Motion(humanoid.skeleton, qpos[None], FPS))[0]
    away: Array = data.subtree_com[humanoid.body_ids[0]][:2] - soles[:, :2].mean(axis=0)
    return away


@pytest.mark.parametrize("lean", [-0.12, 0.0, 0.12])
def test_a_leaning_body_that_stands_in_the_floor_stands_on_it_upright(humanoid: HumanoidModel, lean: float) -> None:
    poses, layout = swaying(humanoid, lean, 0.6, 0.0), layout_of(humanoid)
    out = grounded(poses, humanoid, AHEAD)
    qpos = in_the_world(out, humanoid)
    before, after = (mass_ahead(in_the_world(p, humanoid)[0], humanoid) for p in (poses, out))
    target = np.array([AHEAD, 0.0])
    # A sole turns with the body, so the middle of both moves a little.
    assert np.abs(after - target).max() < max(0.5 * np.abs(before - target).max(), 0.015)
    soles = sole_edges(humanoid, Motion(humanoid.skeleton, qpos, FPS))
    np.testing.assert_allclose(soles[..., 2].min(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(out[..., layout.root_linear_velocity], 0.0, atol=1e-9)
    np.testing.assert_allclose(out[..., layout.root_angular_velocity], 0.0, atol=1e-9)
    np.testing.assert_array_equal(out[..., layout.joint_angles], poses[..., layout.joint_angles])


def test_a_body_in_the_air_stays_there(humanoid: HumanoidModel) -> None:
    out = grounded(swaying(humanoid, 0.0, 1.5, 0.1), humanoid, AHEAD)
    np.testing.assert_allclose(out[..., 0], 1.5)


def test_soles_that_carry_stay_where_they_are(humanoid: HumanoidModel) -> None:
    """Both legs swing, one bends: the root goes where the sole on the floor lets it, though that tips."""
    poses = swaying(humanoid, 0.05, 0.9, 0.25)
    soles = [
        sole_edges(humanoid, Motion(humanoid.skeleton, in_the_world(p, humanoid), FPS))
        for p in (poses, grounded(poses, humanoid, AHEAD))
    ]
    low = soles[1][..., 2] < 0.01
    moved = [np.linalg.norm(np.diff(s[..., :2], axis=0), axis=-1)[low[1:] & low[:-1]].mean() * FPS for s in soles]
    assert low.any(axis=1).all()
    assert moved[1] < 0.15 * moved[0]


def test_velocities_are_those_of_the_motion_itself(humanoid: HumanoidModel) -> None:
    """As of motion capture, whose velocities are differences: the bodies that a tracker has learned from."""
    layout = layout_of(humanoid)
    out = grounded(swaying(humanoid, 0.05, 0.9, 0.25), humanoid, AHEAD)
    qpos = in_the_world(out, humanoid)
    found = finite_difference(qpos, FPS)
    np.testing.assert_allclose(out[0, 1:-1, layout.root_angular_velocity], found[1:-1, 3:6], atol=0.02)
    np.testing.assert_allclose(out[0, 1:-1, layout.root_linear_velocity.stop - 1], found[1:-1, 2], atol=0.05)
    np.testing.assert_allclose(out[..., layout.root_rotation.stop - 1], 0.0, atol=1e-12)
