"""Exported files against other people's readers, forces against statics, free fall and MuJoCo's own contacts."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import ezc3d
import mujoco
import numpy as np
import pytest
from helpers.any_motion import motions
from helpers.env_stand_in import group
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from egopose.benchmarks.export import as_markdown, round_trips
from egopose.benchmarks.read_back import read_glb
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.export import main
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.foot_geometry import sole_positions
from egopose.humanoid.inverse_dynamics import ForceSettings, with_forces
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.inference.export import run_export
from egopose.motion import rotations as rot
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.io import WRITERS, read_motion, write_motion
from egopose.motion.io.amass import read_amass
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Joint, Skeleton, hinges

FORCES = ForceSettings(cutoff_hz=6.0, touch=0.02, lever=0.3, evenness=1e-3)
FPS = 30.0


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return build_humanoid(HumanoidConfig.from_mapping(group("humanoid", "default")), SimConfig())


def standing(humanoid: HumanoidModel, frames: int) -> Motion:
    """Arms held out, straight, soles on the floor, turned about."""
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (frames, 1))
    qpos[:, 3:7] = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(0.7))
    motion = Motion(humanoid.skeleton, qpos, FPS, "stand")
    qpos[:, 2] -= sole_positions(humanoid, motion)[..., 2].min()
    return replace(motion, qpos=qpos)


@pytest.fixture(scope="module")
def moving(humanoid: HumanoidModel) -> Motion:
    """All joints at once, with forces and contacts."""
    motion = standing(humanoid, 40)
    qpos, t = motion.qpos.copy(), np.arange(40)[:, None] / FPS
    low, high = humanoid.joint_range.T
    phase = np.arange(len(low))
    qpos[:, 7:] = (low + high) / 2 + 0.45 * (high - low) * np.sin(2.0 * t + phase)
    qpos[:, :2] = np.concatenate([0.8 * t, 0.2 * t], axis=1)
    turn = np.concatenate([0.4 * np.sin(t), 0.3 * np.sin(2 * t), 2.0 * t], axis=1)
    qpos[:, 3:7] = rot.from_rotvec(turn)
    lowest = sole_positions(humanoid, replace(motion, qpos=qpos))[..., 2].min(axis=1)
    qpos[:, 2] -= lowest
    return with_forces(humanoid, replace(motion, qpos=qpos, name="all joints"), FORCES)


def test_every_format_by_independent_readers(humanoid: HumanoidModel, moving: Motion, tmp_path: Path) -> None:
    found = round_trips(humanoid, moving, tmp_path)
    assert set(found) == set(WRITERS) - {".npz"}
    limits = {"position_mm": 0.01, "rotation_deg": 1e-3, "force_n": 0.01, "point_mm": 0.01, "torque_nm": 1e-3}
    for ending, errors in found.items():
        assert errors["fps"] < 1e-4, ending
        assert not errors["contacts"], ending
        for name, limit in limits.items():
            assert errors[name] is None or errors[name] < limit, (ending, name)
    everything = ("position_mm", "force_n", "point_mm", "torque_nm", "contacts")
    assert all(found[e][name] is not None for e in (".glb", ".c3d", ".csv") for name in everything)
    assert as_markdown(found).count("\n") == len(found) + 1


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(motion=motions())
def test_glb_of_any_skeleton(motion: Motion, tmp_path: Path) -> None:
    write_motion(motion, tmp_path / "m.glb")
    if len(motion.skeleton) == 1 and not motion.skeleton.joints[0].tips:
        return
    back = read_glb(tmp_path / "m.glb") if len(motion) > 1 else None
    positions, quats = motion.forward_kinematics()
    for k, name in enumerate(motion.skeleton.names if back else ()):
        np.testing.assert_allclose(back.positions[name], positions[:, k], atol=1e-4)
        np.testing.assert_allclose(back.rotations[name], rot.to_matrix(quats)[:, k], atol=1e-5)


def test_glb_container_is_sound(moving: Motion, tmp_path: Path) -> None:
    """The binary container's rules, glTF 2.0 section 4.4, and that skinning at rest leaves the figure as it is."""
    write_motion(moving, tmp_path / "m.glb")
    raw = (tmp_path / "m.glb").read_bytes()
    magic, version, length = struct.unpack_from("<4sII", raw)
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    size, kind = struct.unpack_from("<II", raw, 12)
    assert (size % 4, kind) == (0, 0x4E4F534A)
    tree = json.loads(raw[20 : 20 + size])
    assert tree["buffers"][0]["byteLength"] == struct.unpack_from("<I", raw, 20 + size)[0]
    assert "uri" not in tree["buffers"][0]
    for view in tree["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= tree["buffers"][0]["byteLength"]
    bind = tree["accessors"][tree["skins"][0]["inverseBindMatrices"]]
    start = 28 + size + tree["bufferViews"][bind["bufferView"]]["byteOffset"]
    matrices = np.frombuffer(raw, "<f4", 16 * bind["count"], start).reshape(-1, 4, 4).swapaxes(1, 2)
    world: dict[int, np.ndarray] = {}
    for k in range(bind["count"]):
        node, local = tree["nodes"][k], np.eye(4)
        local[:3, 3] = node["translation"]
        x, y, z, w = node.get("rotation", [0, 0, 0, 1])
        local[:3, :3] = rot.to_matrix(np.array([w, x, y, z]))
        parent = moving.skeleton.parents[k]
        world[k] = world[parent] @ local if parent >= 0 else local
        np.testing.assert_allclose(world[k] @ matrices[k], np.eye(4), atol=1e-6)


def test_weight_stands_on_both_feet(humanoid: HumanoidModel) -> None:
    still = with_forces(humanoid, standing(humanoid, 12), FORCES)
    weight = 9.81 * humanoid.mj_model.body_mass.sum()
    ground = still.ground_reaction
    assert ground is not None
    assert ground.bodies == ("RightFoot", "LeftFoot")
    np.testing.assert_allclose(ground.force[..., 2], weight / 2, rtol=1e-3)
    np.testing.assert_allclose(ground.force[..., :2], 0, atol=0.01)
    # The centre of pressure of the whole lies under the centre of mass.
    data = mujoco.MjData(humanoid.mj_model)
    data.qpos[:] = still.qpos[5]
    mujoco.mj_kinematics(humanoid.mj_model, data)
    mujoco.mj_comPos(humanoid.mj_model, data)
    centre = (ground.force[5, :, 2:] * ground.point[5]).sum(axis=0) / weight
    np.testing.assert_allclose(centre[:2], data.subtree_com[1][:2], atol=1e-3)
    # An arm held out: the shoulder carries the moment of what hangs beyond it.
    shoulder = humanoid.skeleton.index("RightArm")
    beyond = [b for b in range(21) if b == shoulder or _hangs_on(humanoid.skeleton, b, shoulder)]
    ids = humanoid.body_ids[beyond]
    moment = (np.cross(data.xipos[ids] - data.xpos[ids[0]], [0, 0, 9.81]) * humanoid.mj_model.body_mass[ids, None]).sum(
        0
    )
    columns = humanoid.skeleton.dof_slices[shoulder]
    assert still.torques is not None
    assert np.linalg.norm(still.torques[5, columns]) == pytest.approx(np.linalg.norm(moment), rel=1e-3)
    assert still.meta["forces"]["residual"] < 1e-3


def _hangs_on(skeleton: Skeleton, joint: int, root: int) -> bool:
    while joint > 0:
        joint = int(skeleton.parents[joint])
        if joint == root:
            return True
    return False


def test_free_fall_needs_nothing(humanoid: HumanoidModel) -> None:
    motion = standing(humanoid, 15)
    t = np.arange(15) / FPS
    qpos = motion.qpos.copy()
    qpos[:, 2] += 1.0 + 3.0 * t - 0.5 * 9.81 * t**2
    fall = with_forces(humanoid, replace(motion, qpos=qpos), replace(FORCES, cutoff_hz=None))
    assert fall.ground_reaction is not None
    assert not fall.ground_reaction.force.any()
    assert not fall.contacts.any()
    np.testing.assert_allclose(fall.torques, 0, atol=1e-6)
    assert fall.meta["forces"]["residual"] < 1e-9


def test_against_mujocos_own_contacts(humanoid: HumanoidModel) -> None:
    """A squat on PD control: the contact solver's forces, averaged over each control step, are the truth."""
    model, data = humanoid.mj_model, mujoco.MjData(humanoid.mj_model)
    data.qpos[:] = standing(humanoid, 1).qpos[0]
    names = [f"{j.name}_{k}" for j in humanoid.skeleton.joints for k in range(len(j.dofs))]
    rows, truth = [], []
    steps = round(1 / FPS / model.opt.timestep)
    wrench = np.zeros(6)
    for t in range(30):
        rows.append(data.qpos.copy())
        bend = 0.15 * (1 - np.cos(6.0 * t / FPS))
        for side in ("Right", "Left"):
            data.ctrl[names.index(f"{side}UpLeg_0")] = -bend
            data.ctrl[names.index(f"{side}Leg_0")] = 2 * bend
            data.ctrl[names.index(f"{side}Foot_0")] = -bend
        up = 0.0
        for _ in range(steps):
            mujoco.mj_step(model, data)
            for c in range(data.ncon):
                mujoco.mj_contactForce(model, data, c, wrench)
                up += abs(wrench[0]) / steps
        truth.append(up)
    found = with_forces(humanoid, Motion(humanoid.skeleton, np.stack(rows), FPS), replace(FORCES, cutoff_hz=None))
    assert found.ground_reaction is not None
    # Frame t lies between the control steps before and after it.
    expected = 0.5 * (np.array(truth[:-1]) + np.array(truth[1:]))[4:-2]
    error = np.abs(found.ground_reaction.force[5:-2, :, 2].sum(axis=1) - expected)
    weight = 9.81 * model.body_mass.sum()
    assert np.ptp(expected) > 0.05 * weight
    assert error.mean() < 0.03 * weight, error


def test_amass_holds_rotations_exactly(humanoid: HumanoidModel, moving: Motion, tmp_path: Path) -> None:
    write_motion(standing(humanoid, 2), tmp_path / "t.amass.npz")
    poses = np.load(tmp_path / "t.amass.npz")["poses"]
    np.testing.assert_allclose(poses[:, 3:], 0, atol=1e-12)  # SMPL's T-pose is the humanoid's zero
    write_motion(moving, tmp_path / "m.amass.npz")
    smpl = read_amass(tmp_path / "m.amass.npz")
    assert smpl.fps == FPS
    np.testing.assert_allclose(smpl.qpos[:, :3], moving.qpos[:, :3], atol=1e-12)
    # On SMPL's own skeleton it is the same motion again, whatever the body it is written for.
    joints = np.random.default_rng(0).normal(size=(22, 3))
    write_motion(smpl, tmp_path / "s.amass.npz", joints=joints)
    again = read_amass(tmp_path / "s.amass.npz", joints=joints)
    np.testing.assert_allclose(again.qpos[:, :3], smpl.qpos[:, :3], atol=1e-12)
    np.testing.assert_allclose(
        rot.to_matrix(again.forward_kinematics()[1]), rot.to_matrix(smpl.forward_kinematics()[1]), atol=1e-9
    )
    # Knees bend in both by the same angle.
    knee = moving.qpos[:, 7 + humanoid.skeleton.dof_slices[humanoid.skeleton.index("LeftLeg")].start]
    turn = np.load(tmp_path / "m.amass.npz")["poses"][:, 12:15]
    np.testing.assert_allclose(np.linalg.norm(turn, axis=1), np.abs(knee), atol=1e-9)
    with pytest.raises(ValueError, match="humanoid"):
        write_motion(Motion(Skeleton((Joint("a", -1, (0, 0, 0)),)), np.eye(7)[3:4], FPS), tmp_path / "x.amass.npz")


def test_opensim_reads_its_files(moving: Motion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # it writes its log where it stands
    opensim = pytest.importorskip("opensim", reason="OpenSim (280 MB) is not installed; `pip install opensim`")
    for ending in (".mot", ".forces.mot", ".torques.sto"):
        write_motion(moving, tmp_path / f"m{ending}")
        assert opensim.TimeSeriesTable(str(tmp_path / f"m{ending}")).getNumRows() == len(moving)
    assert opensim.Storage(str(tmp_path / "m.mot")).isInDegrees()
    write_motion(moving, tmp_path / "m.trc")
    table = opensim.TimeSeriesTableVec3(str(tmp_path / "m.trc"))
    row = table.getRowAtIndex(7)
    x, y, z = (row.getElt(0, 0)[k] for k in range(3))
    np.testing.assert_allclose([x, -z, y], 1e3 * moving.qpos[7, :3], atol=1e-3)


def test_c3d_with_more_names_than_a_byte_counts(tmp_path: Path) -> None:
    joints = [Joint("j0", -1, (0, 0, 0))] + [Joint(f"j{k}", k - 1, (0, 0, 0.01), hinges("x")) for k in range(1, 300)]
    skeleton = Skeleton(tuple(joints))
    motion = Motion(skeleton, np.tile(skeleton.rest_qpos(), (3, 1)), 120.0)
    write_motion(motion, tmp_path / "m.c3d", up="y")
    file = ezc3d.c3d(str(tmp_path / "m.c3d"))
    assert file["data"]["points"].shape == (4, 300, 3)
    assert file["parameters"]["POINT"]["LABELS2"]["value"][-1] == "j299"
    assert file["parameters"]["POINT"]["Y_SCREEN"]["value"] == ["+Y"]
    np.testing.assert_allclose(file["data"]["points"][:3, 299, 0], [0, 2990, 0], atol=1e-3)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(frames=st.integers(2, 6), seed=st.integers(0, 99))
def test_the_own_clip_keeps_forces(frames: int, seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    ground = GroundReaction(("a", "b"), *rng.normal(size=(3, frames, 2, 3)))
    skeleton = Skeleton((Joint("a", -1, (0, 0, 0)), Joint("b", 0, (0, 0, 1), hinges("x"))))
    motion = Motion(skeleton, np.tile(skeleton.rest_qpos(), (frames, 1)), FPS, ground_reaction=ground)
    write_motion(motion, tmp_path / "m.npz")
    back = read_motion(tmp_path / "m.npz").ground_reaction
    assert back is not None
    assert back.bodies == ground.bodies
    for label in ("force", "point", "moment"):
        np.testing.assert_array_equal(getattr(back, label), getattr(ground, label))
    assert len(motion.slice(1, frames).ground_reaction) == frames - 1
    np.testing.assert_array_equal(motion.resample(2 * FPS).ground_reaction.force[::2], ground.force)
    with pytest.raises(ValueError, match="frames"):
        replace(motion, ground_reaction=ground.at(slice(1)))
    # Moving the reference point changes no wrench.
    np.testing.assert_allclose(ground.about(ground.point), ground.moment)


def test_a_clip_with_half_its_forces_is_refused(moving: Motion, tmp_path: Path) -> None:
    write_motion(moving, tmp_path / "m.npz")
    arrays = dict(np.load(tmp_path / "m.npz"))
    del arrays["ground_point"]
    np.savez(tmp_path / "half.npz", **arrays)
    with pytest.raises(InputError, match="only ground_force, ground_moment"):
        read_motion(tmp_path / "half.npz")


def test_the_command(moving: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = replace(moving, torques=None, ground_reaction=None, contacts=None, contact_names=())
    for take in ("walk_0-40", "bow_0-40"):
        (tmp_path / "out/takes" / take).mkdir(parents=True)
        write_motion(plain, tmp_path / "out/takes" / take / "estimate.npz")
    config = compose_config("export")
    wanted = [str(tmp_path / "made/{take}.glb"), str(tmp_path / "made/{take}.forces.mot")]
    written = run_export(tmp_path / "out", wanted, config)
    assert {p.name for p in written} == {f"{t}{e}" for t in ("walk_0-40", "bow_0-40") for e in (".glb", ".forces.mot")}
    assert read_glb(tmp_path / "made/bow_0-40.glb").forces
    # Without forces the format stays, what it cannot hold is absent.
    quiet = {**config, "forces": {**config["forces"], "enabled": False}, "take": "bow_0-40"}
    run_export(tmp_path / "out", [str(tmp_path / "b.glb")], quiet)
    assert not read_glb(tmp_path / "b.glb").forces
    with pytest.raises(InputError, match="no ground reaction"):
        run_export(tmp_path / "out", [str(tmp_path / "b.forces.mot")], quiet)
    with pytest.raises(InputError, match=r"\{take\}"):
        run_export(tmp_path / "out", [str(tmp_path / "b.glb")], config)
    with pytest.raises(InputError, match=r"options\.upp"):
        run_export(tmp_path / "out", wanted, {**config, "options": {"upp": "y"}})
    with pytest.raises(InputError, match="no take 'run'"):
        run_export(tmp_path / "out", wanted, {**config, "take": "run"})
    with pytest.raises(InputError, match=r"takes/NAME/reference\.npz"):
        run_export(tmp_path / "out", wanted, {**config, "part": "reference"})
    with pytest.raises(InputError, match="no writer"):
        run_export(tmp_path / "out", ["{take}.fbx"], config)
    with pytest.raises(InputError, match="'q' is no unit or axis"):
        run_export(tmp_path / "out", [str(tmp_path / "{take}.trc")], {**config, "options": {"up": "q"}})


def test_the_command_line(
    moving: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_motion(moving, tmp_path / "m.npz")
    words = ["egopose export", str(tmp_path / "m.npz"), f"to={tmp_path / 'a.trc'}", f"to={tmp_path / 'a.bvh'}"]
    monkeypatch.setattr("sys.argv", [*words, "options.unit=m"])
    main()
    assert capsys.readouterr().out.split() == [str(tmp_path / "a.trc"), str(tmp_path / "a.bvh")]
    assert "\tm\t" in (tmp_path / "a.trc").read_text().splitlines()[2]
    monkeypatch.setattr("sys.argv", words[:2])
    with pytest.raises(SystemExit):
        main()
    assert "says no file" in capsys.readouterr().err
    whole = (tmp_path / "a.bvh").read_bytes()
    with pytest.raises(InputError, match="the motion itself"):
        run_export(tmp_path / "a.bvh", [str(tmp_path / "../" / tmp_path.name / "a.bvh")], compose_config("export"))
    assert (tmp_path / "a.bvh").read_bytes() == whole


def test_a_body_of_unknown_masses_gets_no_forces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    skeleton = Skeleton((Joint("a", -1, (0, 0, 0)), Joint("b", 0, (0, 0, 1), hinges("x"))))
    write_motion(Motion(skeleton, np.tile(skeleton.rest_qpos(), (5, 1)), FPS), tmp_path / "m.npz")
    run_export(tmp_path / "m.npz", [str(tmp_path / "m.glb")], compose_config("export"))
    assert "no torques and ground reaction" in capsys.readouterr().err
    with pytest.raises(InputError, match="skeleton"):
        run_export(tmp_path / "m.npz", [str(tmp_path / "m.torques.sto")], compose_config("export"))
