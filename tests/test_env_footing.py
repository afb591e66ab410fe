"""What is told of the feet, against MuJoCo's own kinematics and velocities."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from egopose import pipeline
from egopose.envs.footing import Footing, LegChain
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return pipeline.motion_material(pipeline.compose_config("train", [])).humanoid


def test_points_and_velocities_are_mujocos(humanoid: HumanoidModel) -> None:
    model, rng = humanoid.mj_model, np.random.default_rng(0)
    data = mujoco.MjData(model)
    transform = Footing(LegChain.of(humanoid))
    for _ in range(10):
        data.qpos[:] = np.concatenate([[0.3, -0.2, 0.9], rng.normal(size=4), 0.4 * rng.normal(size=model.nu)])
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qvel[:] = 0.5 * rng.normal(size=model.nv)
        mujoco.mj_forward(model, data)
        z = humanoid_state({"qpos": torch.tensor(data.qpos[None]), "qvel": torch.tensor(data.qvel[None])}).float()
        seen = transform._apply_transform(z)[0].numpy()
        turn = rotations.to_matrix(rotations.heading(data.qpos[3:7]))  # heading frame -> world
        positions, velocities, heights = [], [], []
        for foot, points in zip(humanoid.feet, humanoid.sole_points, strict=True):
            body = int(humanoid.body_ids[foot])
            for point in points:
                world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
                jacobian = np.zeros((3, model.nv))
                mujoco.mj_jac(model, data, jacobian, None, world, body)
                positions.append((world - data.qpos[:3]) @ turn / 0.3)
                velocities.append(jacobian @ data.qvel @ turn / 2.0)
                heights.append(world[2] / 0.1)
        expected = np.clip(np.concatenate([np.ravel(positions), np.ravel(velocities), heights]), -5, 5)
        np.testing.assert_allclose(seen[:12], expected[:12], atol=1e-5)
        np.testing.assert_allclose(seen[12:24], expected[12:24], atol=0.02)  # of a hundredth second's difference
        np.testing.assert_allclose(seen[24:], expected[24:], atol=1e-4)


def test_an_environment_with_footing_trains_on_it(humanoid: HumanoidModel) -> None:
    overrides = ["model.inputs=[footing]", "model.feedback=null", "task=estimation", "collector.worlds=4"]
    config = pipeline.compose_config("train", overrides)
    material = pipeline.motion_material(config)
    env = pipeline.build_env(config, material, worlds=4, threads=1)
    actor, critic = pipeline.build_networks(config, material, env)
    seen = env.reset()
    assert seen["footing"].shape == (4, 28)
    assert seen["footing"].abs().max() <= 5
    rollout = env.rollout(5, actor, break_when_any_done=False)
    assert torch.isfinite(critic(rollout)["state_value"]).all()
