"""Mounts of cameras on the body: against MuJoCo's own camera, and against what is measured on a standing person."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking
from scipy.spatial.transform import Rotation

from egopose.core.errors import InputError
from egopose.vision.mounts import (
    MOUNTS,
    Mount,
    camera_orientations,
    camera_places,
    camera_poses,
    held_sway,
    mount_body,
    mount_of,
)


def standing() -> np.ndarray:
    return default_humanoid().mj_model.qpos0[None].copy()


@pytest.mark.parametrize("kind", MOUNTS)
def test_poses_are_those_of_mujocos_camera_on_the_same_body(kind: str) -> None:
    """A camera of the model, put where the mount says, is moved by MuJoCo."""
    spec = mujoco.MjSpec.from_string(default_humanoid().xml)
    mount = mount_of(kind, yaw=0.1, pitch_down=0.5, roll=-0.2)
    bearer = default_humanoid().mj_model.body(mount_body(default_humanoid().mj_model, kind)).name
    spec.body(bearer).add_camera(name="worn")
    model = spec.compile()
    camera = model.camera("worn").id
    model.cam_pos[camera] = camera_places(model, mount, np.zeros((1, 3)))[0]
    model.cam_quat[camera] = camera_orientations(model, np.array([[0.1, 0.5, -0.2]]), kind)[0]
    qpos = walking().qpos[:20]
    position, rotation = camera_poses(model, qpos, mount)
    data = mujoco.MjData(model)
    for t, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(position[t], data.cam_xpos[camera], atol=1e-9)
        own = data.cam_xmat[camera].reshape(3, 3) * [1, -1, -1]
        np.testing.assert_allclose(rotation[t], own, atol=1e-9)


@pytest.mark.parametrize("kind", MOUNTS)
def test_a_standing_wearers_camera_looks_as_it_is_measured(kind: str) -> None:
    """Columns are right, down and ahead; the default humanoid looks along x."""
    model, down = default_humanoid().mj_model, np.deg2rad(30.0)
    _, level = camera_poses(model, standing(), mount_of(kind))
    np.testing.assert_allclose(level[0].T, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-9)
    _, pitched = camera_poses(model, standing(), mount_of(kind, pitch_down=down))
    np.testing.assert_allclose(pitched[0][:, 2], [np.cos(down), 0, -np.sin(down)], atol=1e-9)
    _, turned = camera_poses(model, standing(), mount_of(kind, yaw=0.3))
    np.testing.assert_allclose(turned[0][:, 2], [np.cos(0.3), np.sin(0.3), 0], atol=1e-9)
    _, played = camera_poses(model, standing(), mount_of(kind, yaw=0.1), np.array([[0.2, 0.0, 0.0]]))
    np.testing.assert_allclose(played, turned, atol=1e-9)


def test_places_on_a_standing_wearer() -> None:
    model = default_humanoid().mj_model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    at = {kind: camera_poses(model, standing(), mount_of(kind))[0][0] for kind in MOUNTS}
    np.testing.assert_allclose(at["head"], data.cam_xpos[model.camera("head").id], atol=1e-9)
    below = at["chest"] - data.body("Head").xpos
    assert -0.3 <= below[2] <= -0.2
    assert below[0] > 0.1
    assert at["held"][0] > at["chest"][0] + 0.1
    moved = camera_poses(model, standing(), Mount("chest", offset=(0.2, 0.1, -0.3)))[0][0]
    np.testing.assert_allclose(moved - data.body("Head").xpos, [0.2, 0.1, -0.3], atol=1e-9)
    swayed = camera_poses(model, standing(), mount_of("held"), shifts=np.array([[0.01, 0.02, 0.03]]))[0][0]
    np.testing.assert_allclose(swayed - at["held"], [0.01, 0.02, 0.03], atol=1e-9)


def test_a_turn_of_the_root_turns_the_camera_by_as_much() -> None:
    qpos = np.repeat(standing(), 2, axis=0)
    qpos[1, 3:7] = [np.cos(0.1), 0, 0, np.sin(0.1)]
    for kind in MOUNTS:
        _, rotation = camera_poses(default_humanoid().mj_model, qpos, mount_of(kind, pitch_down=0.4))
        turn = Rotation.from_matrix(rotation[1] @ rotation[0].T).as_rotvec()
        np.testing.assert_allclose(turn, [0, 0, 0.2], atol=1e-9)


def test_sway_has_its_size_and_is_slow() -> None:
    angles, shifts = held_sway(np.random.default_rng(0), 30000, 30.0)
    np.testing.assert_allclose(np.rad2deg(angles).std(0), 3.0, rtol=0.1)
    np.testing.assert_allclose(shifts.std(0), 0.02, rtol=0.1)
    assert np.abs(np.diff(shifts, axis=0)).max() < 0.02


def test_what_is_no_mount_is_refused() -> None:
    model = default_humanoid().mj_model
    with pytest.raises(InputError, match="mount: 'knee'"):
        mount_of("knee")
    with pytest.raises(InputError, match="angles"):
        camera_poses(model, standing(), mount_of("head"), np.zeros((2, 3)))
    with pytest.raises(InputError, match="qpos"):
        camera_poses(model, standing()[:, 1:], mount_of("head"))
    without = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(InputError, match="no camera 'head'"):
        camera_poses(without, np.zeros((1, 0)), mount_of("head"))
    alone = "<mujoco><worldbody><body><geom size='.1'/><camera name='head'/></body></worldbody></mujoco>"
    with pytest.raises(InputError, match="none bears the head"):
        camera_poses(mujoco.MjModel.from_xml_string(alone), np.zeros((1, 0)), mount_of("chest"))
    with pytest.raises(InputError, match="mount"):
        replace(mount_of("head"), kind="hat")
