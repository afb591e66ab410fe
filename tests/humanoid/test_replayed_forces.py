"""Forces of a replay against statics, Newton, inverse dynamics, and the batched physics' own contacts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.jump import bare, jumping, scene_at, standing
from hypothesis import given
from hypothesis import strategies as st

from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.humanoid.replayed_forces import ReplayedForces, replay_forces, window, with_replayed_forces
from egopose.motion.motion import Motion
from egopose.scene.clip import humanoid_in
from egopose.scene.scene_file import read_scene
from egopose.scene.simulated import SimulatedMotion, load_simulated

#: Simulated motion capture among boxes, which ships with the project.
CLIPS = Path(__file__).resolve().parents[2] / "experiments" / "scene_bench" / "clips"


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_in(scene_at(0.3), bare())


def replayed(humanoid: HumanoidModel, motion: SimulatedMotion) -> ReplayedForces:
    return replay_forces(humanoid, motion.qpos, motion.qvel, motion.ctrl, motion.box_tops, motion.box_headings)


@pytest.fixture(scope="module")
def jump(humanoid: HumanoidModel) -> ReplayedForces:
    return replayed(humanoid, jumping())


def feet_of(humanoid: HumanoidModel) -> list[int]:
    return [humanoid.skeleton.index(f"{side}Foot") for side in ("Right", "Left")]


@pytest.mark.parametrize(("height", "surface"), [(0.0, 0), (0.7, 1)])
def test_a_standing_body_is_carried_by_what_it_stands_on(humanoid: HumanoidModel, height: float, surface: int) -> None:
    forces = replayed(humanoid, standing(45, height))
    late = slice(-40, None)
    up = forces.force[late].sum(axis=1)[..., 2].mean(axis=0)
    assert up[surface] == pytest.approx(forces.weight, rel=0.01)
    assert np.delete(up, surface) == pytest.approx(0.0)
    feet = feet_of(humanoid)
    assert (np.delete(forces.force[late], feet, axis=1) == 0).all()
    assert forces.force[late][:, feet, surface, 2].mean(axis=0) == pytest.approx(forces.weight / 2, rel=0.02)
    centre = forces.centre_of_pressure[late][:, feet, surface]
    middle = 0.5 * centre.mean(axis=(0, 1)) + 0.5 * centre[:, ::-1].mean(axis=(0, 1))
    assert middle[:2] == pytest.approx(forces.com[late, :2].mean(axis=0), abs=0.01)
    assert middle[2] == pytest.approx(height, abs=0.01)
    assert np.nanmax(forces.depth[late]) < 0.01
    assert np.abs(forces.power[late]).max() < 5.0


def test_the_centre_of_mass_moves_as_the_forces_say(jump: ReplayedForces) -> None:
    """Newton: the change of momentum over the whole jump is the impulse; nothing acts in flight but weight."""
    impulse = (jump.force.sum(axis=(1, 2))[:-1] - [0, 0, jump.weight]).sum(axis=0) / jump.rate
    change = jump.mass * (jump.com_velocity[-1] - jump.com_velocity[0])
    np.testing.assert_allclose(impulse, change, atol=0.02 * jump.weight)
    air = ~jump.touching.any(axis=(1, 2))
    assert air.sum() > 10
    assert (jump.force[air] == 0).all()
    within = air[1:] & air[:-1]
    falls = np.diff(jump.com_velocity[:, 2])[within] * jump.rate
    # Steps of 1/120 s: Euler's rule gives a body that moves its limbs fast up to a sixth more or less in one step.
    assert np.mean(falls) == pytest.approx(-jump.gravity, rel=0.02)
    assert np.median(falls) == pytest.approx(-jump.gravity, rel=0.02)


def test_torques_and_forces_are_those_of_inverse_dynamics(humanoid: HumanoidModel, jump: ReplayedForces) -> None:
    """Outside truth: Newton and Euler on the body without the controller's share of the armature."""
    model = humanoid.mj_model
    plain = mujoco.MjModel.from_xml_string(humanoid.xml)
    for flag in ("CONTACT", "LIMIT", "ACTUATION"):
        plain.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    plain.dof_armature[6:] -= humanoid.kd * model.opt.timestep
    data, motion = mujoco.MjData(plain), jumping()
    twin = mujoco.MjData(model)
    twin.mocap_pos[:] = [[0, 0, 0.3 - 1.5], [3.0, 1.0, 0.5 - 1.5]]
    twin.mocap_quat[0] = [np.cos(0.1), 0, 0, np.sin(0.1)]
    checked = 0
    for t in (5, 15, 29, 31, 36, 44, 55):
        twin.qpos[:], twin.qvel[:], twin.ctrl[:] = motion.qpos[t], motion.qvel[t], motion.ctrl[t]
        twin.qacc_warmstart[:] = 0
        mujoco.mj_forward(model, twin)
        n = t * humanoid.substeps
        low, high = humanoid.joint_range.T
        if not ((twin.qpos[7:] > low) & (twin.qpos[7:] < high)).all():
            continue
        data.qpos[:], data.qvel[:], data.qacc[:] = twin.qpos, twin.qvel, twin.qacc
        mujoco.mj_inverse(plain, data)
        needed = data.qfrc_inverse.copy()
        # All forces on a body as one wrench at the world's origin.
        jacobian, turning = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        for body, name in enumerate(humanoid.body_ids):
            force, moment = jump.force[n, body].sum(axis=0), jump.moment[n, body].sum(axis=0)
            if force.any():
                mujoco.mj_jac(plain, data, jacobian, turning, np.zeros(3), int(name))
                needed -= jacobian.T @ force + turning.T @ moment
        np.testing.assert_allclose(jump.torques[n], needed[6:], atol=0.5)
        np.testing.assert_allclose(needed[:6], 0, atol=0.5)
        checked += 1
    assert checked >= 5


def test_contacts_are_those_of_the_batched_physics(humanoid: HumanoidModel, jump: ReplayedForces) -> None:
    motion = jumping()
    physics = BatchedPhysics(humanoid.mj_model, 1, humanoid.substeps, body_ids=humanoid.body_ids, contacts=True)
    physics.place_boxes(slice(None), motion.box_tops[None], motion.box_headings[None])
    physics.set_state(slice(None), motion.qpos[:1], motion.qvel[:1])
    last = jump.touching[humanoid.substeps - 1 :: humanoid.substeps]
    for t, ctrl in enumerate(motion.ctrl):
        physics.step(ctrl[None])
        np.testing.assert_array_equal(physics.floor_contacts[0], last[t, :, 0])
        np.testing.assert_array_equal(physics.box_contacts[0], last[t, :, 1:])
    assert jump.drift == 0.0
    np.testing.assert_array_equal(physics.qpos[0], motion.qpos[-1])


def test_the_motion_carries_the_impulse_and_the_free_moment(humanoid: HumanoidModel, jump: ReplayedForces) -> None:
    still = Motion(humanoid.skeleton, jumping().qpos, 30.0)
    motion = with_replayed_forces(still, humanoid, jump)
    ground = motion.ground_reaction
    assert ground is not None
    assert set(ground.bodies) >= {"RightFoot", "LeftFoot"}
    assert motion.contact_names == ground.bodies
    total = ground.force.sum(axis=1)
    inner = total[1:-1].sum(axis=0) / 30 + 0.5 * (total[0] + total[-1]) / 30
    np.testing.assert_allclose(inner, jump.force.sum(axis=(0, 1, 2)) / jump.rate, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        ground.about(np.zeros(3)).sum(axis=1), jump.per_frame(jump.moment.sum(axis=(1, 2))), atol=1e-6
    )
    pushed = ground.force[..., 2] > 50
    assert (ground.point[pushed][:, 2] > 0.28).all()
    # On a flat face the free moment is about its normal.
    assert np.abs(ground.moment[pushed][:, :2]).max() < 0.02 * np.abs(ground.about(np.zeros(3))[pushed][:, :2]).max()
    assert motion.meta["forces"]["method"] == "simulation"
    assert motion.contacts is not None
    assert not motion.contacts[35].any()


@pytest.mark.parametrize("where", ["state", "control", "box"])
def test_a_replay_that_ends_elsewhere_is_refused(humanoid: HumanoidModel, where: str) -> None:
    motion = jumping()
    qpos, ctrl, tops = motion.qpos.copy(), motion.ctrl.copy(), motion.box_tops.copy()
    if where == "state":
        qpos[20, 9] += 1e-3
    elif where == "control":
        ctrl[12, 3] += 0.01
    else:
        tops[0, 2] -= 0.01
    with pytest.raises(ValueError, match=r"do not lead to frame"):
        replay_forces(humanoid, qpos, motion.qvel, ctrl, tops, motion.box_headings)


def test_arrays_of_another_body_are_refused(humanoid: HumanoidModel) -> None:
    motion = standing()
    for bad in (replace(motion, ctrl=motion.ctrl[:, 1:]), replace(motion, qpos=motion.qpos[:, 1:])):
        with pytest.raises(ValueError, match="fits this body"):
            replayed(humanoid, bad)
    with pytest.raises(ValueError, match="boxes"):
        replay_forces(humanoid, motion.qpos, motion.qvel, motion.ctrl, motion.box_tops[:1], motion.box_headings[:1])


@pytest.mark.parametrize(("name", "value"), [("qvel", 1e9), ("qpos", np.nan), ("ctrl", -1e5)])
def test_absurd_values_are_refused_before_physics_sees_them(
    humanoid: HumanoidModel, name: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    motion = standing()
    arrays = {key: getattr(motion, key).copy() for key in ("qpos", "qvel", "ctrl")}
    arrays[name][0, 8] = value
    with pytest.raises(ValueError, match=f"{name} is not finite or absurdly large in frame 0"):
        replay_forces(humanoid, **arrays, box_tops=motion.box_tops, box_headings=motion.box_headings)
    assert not list(tmp_path.iterdir())


@given(substeps=st.integers(1, 15), frames=st.integers(2, 40))
def test_windows_cover_every_step_of_physics(substeps: int, frames: int) -> None:
    count = (frames - 1) * substeps
    parts = [window(t, substeps, count) for t in range(frames)]
    seen = np.zeros(count, int)
    for part in parts:
        assert 0 <= part.start < part.stop <= count
        seen[part] += 1
    assert (seen >= 1).all()
    assert (seen <= (2 if substeps == 1 else 1)).all()


@pytest.mark.parametrize("name", ["jump_down", "steps_up", "walk_turn"])
def test_mocap_among_boxes_comes_back_and_weighs_its_weight(name: str) -> None:
    """Clips made by another program's controls: every control step leads to the saved state."""
    motion, scene = load_simulated(CLIPS / name / "truth.npz"), read_scene(CLIPS / name / "scene.yaml")
    forces = replayed(humanoid_in(scene, bare()), motion)
    assert forces.drift < 1e-5
    # Between two moments of like upward speed the mean force is the weight.
    up = forces.force[..., 2].sum(axis=(1, 2)).mean()
    gained = forces.mass * (forces.com_velocity[-1, 2] - forces.com_velocity[0, 2]) / (len(forces) / forces.rate)
    assert up - gained == pytest.approx(forces.weight, rel=0.02)
