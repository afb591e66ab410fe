"""The regressor's shapes and units; PoseReg's integration and the mirror against the skeleton's own kinematics."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from egopose.core.errors import InputError
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.state_layout import StateLayout
from egopose.models.mirror import joint_mirror, state_mirror
from egopose.models.pose_regression import pose_regression, split_state, state_to_qpos
from egopose.models.regressor import StateRegressor, state_statistics
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion, finite_difference
from egopose.motion.skeleton import Joint, Skeleton, hinges

BODY = Skeleton(
    (
        Joint("Hips", -1, (0.0, 0.0, 0.0)),
        Joint("Spine", 0, (0.0, 0.0, 0.2), hinges("yxz")),
        Joint("RightArm", 1, (0.0, -0.2, 0.3), hinges("xzy")),
        Joint("RightForeArm", 2, (0.0, -0.3, 0.0), hinges("z")),
        Joint("LeftArm", 1, (0.0, 0.2, 0.3), hinges("xzy")),
        Joint("LeftForeArm", 4, (0.0, 0.3, 0.0), tuple(type(d)("hinge", (0.0, 0.0, -1.0)) for d in hinges("z"))),
        Joint("RightUpLeg", 0, (0.0, -0.1, -0.1), hinges("yxz")),
        Joint("LeftUpLeg", 0, (0.0, 0.1, -0.1), hinges("yxz")),
    )
)


def wild_motion(seed: int, frames: int = 90) -> Motion:
    """A smooth, fast motion with turns beyond a full circle."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / 30.0

    def waves(width: int, size: float) -> np.ndarray:
        return size * np.sin(t * rng.uniform(1, 5, width) + rng.uniform(0, 6, width))

    turn = rng.uniform(-4, 4) * t[:, 0] + rng.uniform(-3, 3)
    yaw = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), turn)
    quat = rot.multiply(yaw, rot.from_rotvec(waves(3, 0.4)))
    qpos = np.concatenate([waves(2, 2.0), 0.9 + waves(1, 0.1), quat, waves(BODY.n_dofs, 0.8)], axis=1)
    return Motion(BODY, qpos, 30.0)


def state_of(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    td = TensorDict({"qpos": torch.from_numpy(qpos), "qvel": torch.from_numpy(qvel)}, [len(qpos)])
    return humanoid_state(td).numpy()


def states(motion: Motion) -> np.ndarray:
    return state_of(motion.qpos, motion.qvel())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_states_integrate_back_to_the_trajectory(seed: int) -> None:
    motion = wild_motion(seed)
    start = motion.qpos[0]
    back = pose_regression(states(motion), BODY, start[:2], rot.heading(start[3:7]), 30.0)
    assert back.fps == 30.0
    np.testing.assert_allclose(back.qpos[:, :3], motion.qpos[:, :3], atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(back.qpos[:, 3:7] * motion.qpos[:, 3:7], -1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(back.qpos[:, 7:], motion.qpos[:, 7:], atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_placing_a_state_undoes_taking_it(seed: int) -> None:
    motion = wild_motion(seed, 20)
    qpos, qvel = state_to_qpos(states(motion), motion.qpos[:, :2], rot.heading(motion.qpos[:, 3:7]))
    np.testing.assert_allclose(qvel, motion.qvel(), atol=1e-9)
    np.testing.assert_allclose(state_of(qpos, qvel), states(motion), atol=1e-9)


def test_estimated_states_are_made_valid() -> None:
    z = np.random.default_rng(0).normal(size=(50, StateLayout(BODY.n_dofs).size))
    limits = np.tile([-0.5, 0.7], (BODY.n_dofs, 1))
    parts = split_state(z, limits)
    np.testing.assert_allclose(np.linalg.norm(parts.deheaded, axis=-1), 1.0)
    np.testing.assert_allclose(rot.heading(parts.deheaded), np.tile([1.0, 0, 0, 0], (50, 1)), atol=1e-12)
    assert parts.joint_angles.min() >= -0.5
    assert parts.joint_angles.max() <= 0.7
    qpos, _ = state_to_qpos(z, np.zeros(2), np.array([1.0, 0, 0, 0]), limits)
    assert np.isfinite(qpos).all()
    with pytest.raises(ValueError, match="degrees of freedom"):
        split_state(z[:, :-1])


def test_constant_velocity_error_drifts_as_it_must() -> None:
    motion = wild_motion(3)
    z = states(motion)
    z[:, StateLayout(BODY.n_dofs).root_linear_velocity] += [0.3, 0.0, 0.0]
    start = motion.qpos[0]
    back = pose_regression(z, BODY, start[:2], rot.heading(start[3:7]), 30.0)
    steps = np.linalg.norm(np.diff(back.qpos[:, :2] - motion.qpos[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.01, atol=1e-9)


def mirror_world(points: np.ndarray) -> np.ndarray:
    return points * np.array([1.0, -1.0, 1.0])


def test_mirrored_state_is_the_mirrored_body() -> None:
    motion = wild_motion(5)
    index, sign = joint_mirror(BODY)
    qpos = motion.qpos.copy()
    qpos[:, :3] = mirror_world(qpos[:, :3])
    qpos[:, 3:7] *= [1.0, -1.0, 1.0, -1.0]
    qpos[:, 7:] = motion.qpos[:, 7:][:, index] * sign
    opposite = [0, 1, 4, 5, 2, 3, 7, 6]
    image = Motion(BODY, qpos, 30.0).forward_kinematics()[0]
    np.testing.assert_allclose(image, mirror_world(motion.forward_kinematics()[0])[:, opposite], atol=1e-12)
    mirrored = state_mirror(BODY).state(torch.from_numpy(states(motion)))
    np.testing.assert_allclose(mirrored, state_of(qpos, finite_difference(qpos, 30.0)), atol=1e-9)
    np.testing.assert_allclose(state_mirror(BODY).state(mirrored), states(motion), atol=1e-12)


def test_mirrored_flow_turns_right_into_left() -> None:
    flow = torch.zeros(2, 2, 4, 4)
    flow[0, 0, 1, 0], flow[0, 1, 1, 0] = 3.0, 5.0
    image = state_mirror(BODY).flow(flow)
    assert image[0, 0, 1, 3] == -3.0
    assert image[0, 1, 1, 3] == 5.0


def test_a_skeleton_without_its_opposite_is_refused() -> None:
    one_armed = Skeleton((Joint("Hips", -1, (0, 0, 0)), Joint("LeftArm", 0, (0, 0.2, 0), hinges("x"))))
    with pytest.raises(InputError, match="RightArm"):
        joint_mirror(one_armed)


def test_regressor_shapes_and_units() -> None:
    torch.manual_seed(0)
    mean, std = torch.randn(115), torch.rand(115) + 0.1
    encoder = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(2 * 8 * 8, 128))
    model = StateRegressor(encoder, mean, std).eval()
    out = model(torch.randn(3, 25, 2, 8, 8).half())
    assert {k: tuple(v.shape) for k, v in out.items()} == {
        "visual_features": (3, 25, 128),
        "visual_context": (3, 25, 128),
        "normalised_state": (3, 25, 115),
        "humanoid_state": (3, 25, 115),
    }
    torch.testing.assert_close(model.normalise(out["humanoid_state"]), out["normalised_state"], atol=1e-5, rtol=1e-4)
    from_features = StateRegressor(None, mean, std).eval()(torch.randn(2, 7, 128), lookahead=3)
    assert from_features["humanoid_state"].shape == (2, 7, 115)


def test_statistics_are_floored() -> None:
    z = torch.stack([torch.zeros(100), torch.linspace(-1, 1, 100)], 1)
    mean, std = state_statistics(z, 0.05)
    assert std[0] == pytest.approx(0.05)
    assert std[1] == pytest.approx(z[:, 1].std(correction=0).item())
    torch.testing.assert_close(mean, z.mean(0), atol=1e-6, rtol=0)
