"""Acclaim, DeepMimic, AMASS and the project's own clips, against what others make of them and against known truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io import read_motion, write_motion
from egopose.motion.io.frames import UP_AXES, continuous_euler, euler_angles, frame_rate, from_euler, up_rotation
from egopose.motion.motion import Motion
from egopose.motion.skeleton import Joint, Skeleton, hinges

AMC = ["01_01", "05_06", "05_07", "05_13", "11_01", "88_01", "90_02", "90_05", "90_08", "90_11"]


def read_amc(shared: Path, name: str) -> Motion:
    folder = shared / "data" / "cmu_amc"
    own = folder / f"{name[:2]}.asf"
    return read_motion(folder / f"{name}.amc", **({} if own.exists() else {"asf": folder / "08.asf"}))


@pytest.mark.parametrize("name", AMC)
def test_amc_equals_dm_control(shared: Path, name: str) -> None:
    """Root pose and the turn of every bone in the world, against dm_control's parser on its own CMU humanoid."""
    import mujoco
    from dm_control import mujoco as dm_mujoco
    from dm_control.suite import humanoid_CMU
    from dm_control.suite.utils import parse_amc

    physics = dm_mujoco.Physics.from_xml_string(*humanoid_CMU.get_model_and_assets())
    motion = read_amc(shared, name)
    theirs = parse_amc.convert(str(shared / "data" / "cmu_amc" / f"{name}.amc"), physics, 1 / 120).qpos.T
    assert len(theirs) == len(motion)
    # Their unit is 0.056444 m rounded.
    np.testing.assert_allclose(motion.qpos[:, :3], theirs[:, :3], atol=1e-4)

    model, data = physics.model.ptr, physics.data.ptr
    frames = np.arange(0, len(motion), 60)
    _, quats = motion.forward_kinematics()
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    rest = data.xquat.copy()
    # Their thumbs have axes of their own; their other axes are rounded to about a hundredth of a radian.
    bones = [i for i, n in enumerate(motion.skeleton.names) if "thumb" not in n]
    bodies = [model.body(motion.skeleton.names[i]).id for i in bones]
    for t in frames:
        data.qpos[:] = theirs[t]
        mujoco.mj_kinematics(model, data)
        turned = rot.multiply(data.xquat[bodies], rot.conjugate(rest[bodies]))
        apart = np.linalg.norm(rot.to_rotvec(rot.multiply(rot.conjugate(turned), quats[t, bones])), axis=-1)
        assert apart.max() < 0.02, motion.skeleton.names[bones[int(apart.argmax())]]


def test_amc_units_and_radians(shared: Path, tmp_path: Path) -> None:
    folder = shared / "data" / "cmu_amc"
    motion = read_amc(shared, "90_11")
    lines = (folder / "90_11.amc").read_text().splitlines()
    scaled = []
    for line in lines:
        word, *values = line.split()
        if word.startswith(":DEGREES"):
            line = ":RADIANS"
        elif values and not word.startswith((":", "#")):
            degrees = [np.deg2rad(float(v)) for v in values]
            if word == "root":
                degrees[:3] = [float(v) for v in values[:3]]
            line = " ".join([word, *(f"{v:.9f}" for v in degrees)])
        scaled.append(line)
    path = tmp_path / "90_11.amc"
    path.write_text("\n".join(scaled))
    radians = read_motion(path, asf=folder / "08.asf")
    np.testing.assert_allclose(radians.qpos, motion.qpos, atol=1e-6)
    with pytest.raises(InputError, match=r"no skeleton 90\.asf"):
        read_motion(folder / "90_11.amc")


def test_deepmimic_stands_walks_forward_and_keeps_its_right(shared: Path) -> None:
    motion = read_motion(shared / "data" / "deepmimic" / "humanoid3d_walk.txt")
    positions, quats = motion.forward_kinematics()
    skeleton = motion.skeleton
    assert motion.fps == 30
    travelled = positions[-1, 0] - positions[0, 0]
    assert travelled[0] > 1.0
    assert abs(travelled[1]) < 0.1
    assert 1.2 < np.median(positions[:, skeleton.index("neck"), 2]) < 1.5
    assert (positions[:, skeleton.index("right_hip"), 1] < positions[:, skeleton.index("left_hip"), 1]).all()
    soles = np.minimum(*(positions[:, skeleton.index(f"{s}_ankle"), 2] for s in ("left", "right"))) - 0.05
    assert np.abs(np.percentile(soles, 10)) < 0.03
    # Knees bend backwards: the ankle stays behind the thigh's line.
    assert (motion.qpos[:, 7 + skeleton.dof_slices[skeleton.index("right_knee")].start] < 0.05).all()
    raw = np.array(json.loads((shared / "data" / "deepmimic" / "humanoid3d_walk.txt").read_text())["Frames"])
    chest = rot.multiply(rot.conjugate(quats[:, 0]), quats[:, skeleton.index("chest")])
    apart = rot.to_rotvec(rot.multiply(rot.conjugate(rot.normalize(raw[:, 8:12])), chest))
    assert np.abs(apart).max() < 1e-6


def test_every_deepmimic_clip_reads(shared: Path) -> None:
    paths = sorted((shared / "data" / "deepmimic").rglob("*.txt"))
    assert len(paths) >= 20
    for path in paths:
        motion = read_motion(path)
        # No hinge leaps half a turn between frames: triples were chosen to be continuous.
        assert np.abs(np.diff(motion.qpos[:, 7:], axis=0)).max() < 2.5, path.name


def test_uneven_durations_are_resampled(tmp_path: Path) -> None:
    frame = [0.05, 0.0, 0.9, 0.0, 1.0, 0, 0, 0] + [1.0, 0, 0, 0] * 2
    frame += [1.0, 0, 0, 0, 0.0, 1.0, 0, 0, 0, 1.0, 0, 0, 0, 0.0] * 2
    assert len(frame) == 44
    durations, x = [0.05, 0.1, 0.05, 0.05, 0.0], [0.0, 0.05, 0.15, 0.2, 0.25]
    frames = [[d, p, *frame[2:]] for d, p in zip(durations, x, strict=True)]
    path = tmp_path / "clip.txt"
    path.write_text(json.dumps({"Loop": "none", "Frames": frames}))
    motion = read_motion(path)
    assert motion.fps == 20
    np.testing.assert_allclose(motion.qpos[:, 0], np.arange(6) * 0.05, atol=1e-9)


def write_amass(path: Path, columns: int = 156, **replace: object) -> None:
    poses = np.zeros((4, columns))
    poses[:, 0] = np.pi / 2  # y up in the body, z up in the world
    poses[:, 3 * 4] = 0.5  # left knee
    arrays = {"poses": poses, "trans": np.full((4, 3), 1.0), "mocap_framerate": np.array(120.0), **replace}
    np.savez(path, **arrays)


def test_amass_places_the_body(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_amass(path)
    motion = read_motion(path)
    assert (motion.fps, motion.meta["body_model"], motion.meta["dropped_columns"]) == (120, "SMPL-H", 90)
    positions, _ = motion.forward_kinematics()
    skeleton = motion.skeleton
    np.testing.assert_allclose(positions[0, 0], [1.0, 0.78, 1.03])
    assert positions[0, skeleton.index("head"), 2] - positions[0, skeleton.index("right_ankle"), 2] > 1.2
    assert positions[0, skeleton.index("left_wrist"), 0] > positions[0, skeleton.index("right_wrist"), 0]
    # The left knee turned by +0.5 about x: the lower leg goes back (SMPL faces z, which is -y here).
    shin = positions[0, skeleton.index("left_ankle")] - positions[0, skeleton.index("left_knee")]
    other = positions[0, skeleton.index("right_ankle")] - positions[0, skeleton.index("right_knee")]
    assert shin[1] - other[1] == pytest.approx(0.4 * np.sin(0.5), abs=0.03)


def test_native_round_trip_is_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    skeleton = Skeleton(
        (
            Joint("root", -1, (0, 0, 0)),
            Joint("knee é", 0, (0.1, 1 / 3, 0.0), hinges("zyx"), ((0.0, 0.1, 0.0),)),
        ),
        name="s",
    )
    qpos = rng.normal(size=(7, 10))
    motion = Motion(
        skeleton,
        qpos,
        29.97,
        name="n",
        contacts=rng.random((7, 2)) > 0.5,
        contact_names=("a", "b"),
        torques=rng.normal(size=(7, 3)),
        meta={"unit": "cm", "list": [1, 2.5]},
    )
    path = tmp_path / "clip.motion.npz"
    write_motion(motion, path)
    back = read_motion(path)
    assert back.skeleton == skeleton
    assert back.skeleton.name == "s"
    assert (back.fps, back.name, back.contact_names, back.meta) == (29.97, "n", ("a", "b"), motion.meta)
    for field in ("qpos", "contacts", "torques"):
        np.testing.assert_array_equal(getattr(back, field), getattr(motion, field))
    write_motion(motion, path, dtype="float32")
    np.testing.assert_array_equal(read_motion(path).qpos, qpos.astype(np.float32))


@pytest.mark.parametrize("up", UP_AXES)
def test_up_axes_become_z(up: str) -> None:
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    np.testing.assert_allclose(rot.rotate(up_rotation(up), axis), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("sequence", ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"])
def test_euler_angles_are_continuous_and_exact(sequence: str) -> None:
    t = np.linspace(0, 6 * np.pi, 400)
    truth = np.stack([t, 1.2 * np.sin(t) + 0.9, -2 * t], axis=-1)  # the middle angle passes a quarter turn
    quats = from_euler(truth, sequence)
    angles = euler_angles(quats, sequence)
    apart = rot.to_rotvec(rot.multiply(rot.conjugate(from_euler(angles, sequence)), quats))
    assert np.abs(apart).max() < 1e-7
    assert np.abs(np.diff(angles, axis=0)).max() < 0.2
    flipped = truth.copy()
    flipped[100:200] = np.stack([truth[:, 0] + np.pi, np.pi - truth[:, 1], truth[:, 2] - np.pi], axis=-1)[100:200]
    np.testing.assert_allclose(continuous_euler(flipped), truth, atol=1e-9)


def test_frame_rates_written_short_are_whole() -> None:
    assert [frame_rate(s) for s in (0.0083333, 0.016667, 0.0333333, 0.04)] == [120, 60, 30, 25]
    assert frame_rate(0.0333667) == pytest.approx(29.97, abs=1e-3)
