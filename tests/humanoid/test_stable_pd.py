"""The model's own actuators against stable PD as it was published.

The reference (Tan, Liu and Turk 2011, "Stable Proportional-Derivative Controllers", eqs. 9-11) solves in Python, at
every substep of 450 Hz, ``(M + h kd) qacc = -C - kp (q + h qvel - target) - kd qvel + external`` and applies
``-kp (q + h qvel - target) - kd (qvel + h qacc)``, the external forces being the contacts of the substep before. Both
bodies start on a frame of a real walk and track it for half a second with the same targets.

Measured, over all 52 joints and 15 control steps from three starts: **nothing (below 1e-9 rad) apart in the air** (the
walk lifted off the floor) and up to 0.0044 rad while a torque limit holds there: the model clips the explicit torque,
the reference the sum; **on the floor 0.0012 rad on average at most, 0.034 rad at most**, at an ankle: the reference
knows the contact forces of the substep before, MuJoCo those of this one. (Before retargeting put this walk's feet a
millimetre higher the largest was 0.022 rad.)
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid

from egopose.data.prepare_motion import reference_motion
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion, finite_difference


@pytest.fixture(scope="module")
def walk() -> Motion:
    clip = Path(str(files("egopose") / "assets" / "clips" / "cmu07_02.motion.npz"))
    return reference_motion(read_motion(clip), default_humanoid())[0]


def stable_pd(humanoid: HumanoidModel, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Joint angles ``[steps, 52]`` after each control step under reference stable PD on the same body."""
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    model.jnt_actfrclimited[:] = 0  # the limit is applied to the applied force below
    model.dof_armature[6:] -= model.opt.timestep * humanoid.kd  # the model's share of the damping: added below
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    h, n = model.opt.timestep, model.nv
    kp, kd = (np.concatenate([np.zeros(6), gain]) for gain in (humanoid.kp, humanoid.kd))
    mass = np.zeros((n, n))
    out = []
    for target in targets:
        for _ in range(humanoid.substeps):
            mujoco.mj_step1(model, data)
            mujoco.mj_fullM(model, data, mass)
            error = np.concatenate([np.zeros(6), data.qpos[7:] + h * data.qvel[6:] - target])
            force = -data.qfrc_bias - kp * error - kd * data.qvel + data.qfrc_constraint
            qacc = np.linalg.solve(mass + np.diag(h * kd), force)
            torque = -kp * error - kd * (data.qvel + h * qacc)
            data.qfrc_applied[6:] = np.clip(torque[6:], -humanoid.torque_limit, humanoid.torque_limit)
            mujoco.mj_step2(model, data)
        out.append(data.qpos[7:].copy())
    return np.array(out)


def own_pd(humanoid: HumanoidModel, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The same by the model's own actuators."""
    model = humanoid.mj_model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    out = []
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(model, data, humanoid.substeps)
        out.append(data.qpos[7:].copy())
    return np.array(out)


def unlimited(humanoid: HumanoidModel) -> HumanoidModel:
    """The same body without torque limits."""
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    model.jnt_actfrclimited[:] = 0
    return replace(humanoid, mj_model=model, torque_limit=np.full_like(humanoid.torque_limit, np.inf))


@pytest.mark.parametrize("start", [0, 20, 40])
def test_stays_near_where_a_torque_limit_holds(walk: Motion, start: int) -> None:
    """At start 0 a knee saturates: the model clips the explicit torque, stable PD as published the sum."""
    humanoid = default_humanoid()
    qvel = finite_difference(walk.qpos, walk.fps)
    frames = np.arange(start + 1, start + 16)
    targets = walk.qpos[frames, 7:] + 0.06 * qvel[frames, 6:]
    qpos = walk.qpos[start].copy()
    qpos[2] += 5.0
    native, reference = (track(humanoid, qpos, qvel[start], targets) for track in (own_pd, stable_pd))
    assert np.abs(native - reference).max() < 0.006


@pytest.mark.parametrize("start", [0, 20, 40])
@pytest.mark.parametrize(("lift", "largest", "mean"), [(5.0, 1e-9, 1e-9), (0.0, 0.045, 0.0012)], ids=["air", "floor"])
def test_tracks_a_walk_as_reference_stable_pd_does(
    walk: Motion, start: int, lift: float, largest: float, mean: float
) -> None:
    humanoid = unlimited(default_humanoid())
    qvel = finite_difference(walk.qpos, walk.fps)
    frames = np.arange(start + 1, start + 16)
    targets = walk.qpos[frames, 7:] + 0.06 * qvel[frames, 6:]
    qpos = walk.qpos[start].copy()
    qpos[2] += lift
    native, reference = (track(humanoid, qpos, qvel[start], targets) for track in (own_pd, stable_pd))
    distance = np.abs(native - reference)
    assert distance.max() < largest
    assert distance.mean() < mean
    # And it is tracking: without a controller the joints would be off by a radian by then.
    assert np.abs(reference - walk.qpos[frames, 7:]).mean() < 0.1
    assert np.abs(native - walk.qpos[frames, 7:]).mean() < 0.1


def test_the_extra_damping_is_the_prediction_term(walk: Motion) -> None:
    """Leaving ``kp h`` out of the damping is another controller: the difference is seen, so the test above can fail."""
    humanoid = default_humanoid()
    qvel = finite_difference(walk.qpos, walk.fps)
    qpos = walk.qpos[0].copy()
    qpos[2] += 5.0
    targets = walk.qpos[1:16, 7:]
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    model.actuator_biasprm[:, 2] = -humanoid.kd
    plain = replace(humanoid, mj_model=model)
    without, reference = own_pd(plain, qpos, qvel[0], targets), stable_pd(humanoid, qpos, qvel[0], targets)
    assert np.abs(without - reference).max() > 0.002
