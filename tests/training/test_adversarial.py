"""VGAIL: torques reach the joints, the discriminator rewards what looks like the reference."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from egopose.core.config import compose_config
from egopose.data.preparation import humanoid_of
from egopose.envs.imitation import ActionSettings
from egopose.humanoid.torques import torque_driven
from egopose.training.adversarial import AdversarialPPO, Discriminator, DiscriminatorSettings


def test_a_motors_torque_reaches_its_joint_and_no_further_than_its_limit() -> None:
    humanoid = humanoid_of(compose_config("train"))
    driven = torque_driven(humanoid, 0.0)
    model, data = driven.mj_model, mujoco.MjData(driven.mj_model)
    torques = np.random.default_rng(0).uniform(-2.0, 2.0, model.nu) * humanoid.torque_limit
    data.qvel[6:] = 1.0
    data.ctrl[:] = torques
    mujoco.mj_forward(model, data)
    limit = humanoid.torque_limit
    assert data.qfrc_actuator[6:] == pytest.approx(np.clip(torques, -limit, limit))
    assert not data.qfrc_actuator[:6].any()
    assert model.dof_armature[6:] == pytest.approx(np.full(model.nu, model.dof_armature[6]))
    assert humanoid.mj_model.actuator_biasprm.any(), "the humanoid it is made from was changed"
    damped = torque_driven(humanoid, 0.5).mj_model
    assert damped.dof_damping[6:] == pytest.approx(0.5 * humanoid.kd)
    with pytest.raises(ValueError, match=r"action\.kind"):
        ActionSettings(kind="muscles")


def test_the_discriminators_gradient_penalty_is_in_its_own_units_and_its_reward_is_bounded() -> None:
    torch.manual_seed(0)
    settings = DiscriminatorSettings((16,), 1e-2, 0.0, 64, 150, 0.1, 2.0)
    work = object.__new__(AdversarialPPO)  # the discriminator's half alone
    work.discriminator_settings = settings
    work.states = torch.randn(200, 3) * torch.tensor([1.0, 10.0, 0.1]) + 5.0
    work.contexts = torch.randn(200, 2)
    mean, std = work.states.mean(0), work.states.std(0)
    work.discriminator = Discriminator(mean, std, 2, (16,))
    work.discriminator_optimizer = torch.optim.AdamW(work.discriminator.parameters(), lr=1e-2)
    others = mean + std * (torch.randn(200, 3) + torch.tensor([3.0, 0.0, 0.0]))
    for _ in range(settings.steps):
        work._discriminator_step(others, work.contexts)
    like, unlike = work.rewards(work.states, work.contexts), work.rewards(others, work.contexts)
    assert like.mean() > 4 * unlike.mean()
    assert like.max() <= 2.0
    assert unlike.min() >= 0.0
