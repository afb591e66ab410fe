"""Velocities of links against MuJoCo's own and against differences of places."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking

from egopose.humanoid.boxes import with_boxes
from egopose.humanoid.derivatives import moved
from egopose.humanoid.link_rates import LinkRates
from egopose.humanoid.physics_worker import Placer


@pytest.mark.parametrize("boxes", [[], [(0.4, 0.5)]])
def test_rates_are_those_of_a_small_step_along_the_velocity(boxes: list[tuple[float, float]]) -> None:
    humanoid = with_boxes(default_humanoid(), boxes)
    rng = np.random.default_rng(0)
    qpos = walking().qpos[[3, 12]].copy()
    qvel = rng.normal(size=(2, humanoid.mj_model.nv))
    rates = LinkRates(humanoid.mj_model, humanoid.body_ids)(qpos, qvel)
    placer, small = Placer(humanoid.mj_model, humanoid.body_ids), 1e-6
    before, after = placer(qpos), placer(moved(qpos, small * (qvel)))
    np.testing.assert_allclose(rates.linear, (after[0] - before[0]) / small, atol=1e-4)
    mass = humanoid.mj_model.body_mass[humanoid.body_ids]
    com = [np.einsum("b,nbi->ni", mass / mass.sum(), part[2]) for part in (before, after)]
    np.testing.assert_allclose(rates.centre_of_mass, (com[1] - com[0]) / small, atol=1e-4)


def test_angular_rates_are_mujocos() -> None:
    humanoid = default_humanoid()
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    rng = np.random.default_rng(1)
    data.qpos[:], data.qvel[:] = walking().qpos[5], rng.normal(size=model.nv)
    rates = LinkRates(model, humanoid.body_ids)(data.qpos[None].copy(), data.qvel[None].copy())
    mujoco.mj_forward(model, data)
    for number, body in enumerate(humanoid.body_ids):
        out = np.empty(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, int(body), out, 0)
        np.testing.assert_allclose(rates.angular[0, number], out[:3], atol=1e-10)
        np.testing.assert_allclose(rates.linear[0, number], out[3:], atol=1e-10)
