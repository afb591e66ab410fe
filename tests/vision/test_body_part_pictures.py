"""Drawn pictures of bodies: masks and postures against geometry done otherwise, rooms, what is kept, bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import egopose
from egopose.checkpoint.checkpoint import RunCheckpoint, read_json
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.kinematics import forward_kinematics
from egopose.pipeline.body_parts import base_clips, motion_files
from egopose.training.body_parts import Pictures, held_out_figures, mirrored, posture_mirror
from egopose.vision.body_part_pictures import (
    ARRAYS,
    BODIES,
    LIMB_BODIES,
    PictureSettings,
    Scenes,
    draw_pair,
    draw_part,
    draw_pictures,
    part_path,
    posture_in,
    posture_names,
    read_pictures,
)
from egopose.vision.body_parts import FLOW, LIMBS, BodyPartEstimator
from egopose.vision.flow import FlowConfig
from egopose.vision.rendering import WEARER_CAMERA, camera_orientations
from egopose.vision.rooms import room_seed
from egopose.vision.takes import RenderConfig

PACKAGE = Path(egopose.__file__).parent
WALK = PACKAGE / "assets" / "clips" / "deepmimic_walk.motion.npz"
SHIPPED = PACKAGE / "weights" / "body_parts"


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    return compose_config("body_parts", ["motions=[x]", "out=x"])


@pytest.fixture(scope="module")
def humanoid(config: dict[str, Any]) -> HumanoidModel:
    return humanoid_of(config)


@pytest.fixture(scope="module")
def scenes(config: dict[str, Any], humanoid: HumanoidModel) -> Scenes:
    clips = base_clips([WALK], humanoid, config["data"]["preparation"], 2)
    few = replace(PictureSettings.from_config(config["pictures"]), samples=60, rooms_a_part=2, wearings=3, pairs=8)
    render = RenderConfig.from_mapping(config["vision"])  # plain walls: textures take longer than all else
    return Scenes(
        humanoid.xml,
        humanoid.skeleton,
        humanoid.joint_range,
        tuple(clips.values()),
        replace(render, room=replace(render.room, texture_size=64)),
        FlowConfig(**config["vision"]["flow"]),
        few,
    )


@pytest.fixture(scope="module")
def drawn(scenes: Scenes) -> dict[str, np.ndarray]:
    return draw_part(scenes, seed=3, part=0)


def as_pictures(arrays: dict[str, np.ndarray]) -> Pictures:
    return Pictures(*(torch.from_numpy(arrays[name]) for name in ("pictures", "flow", "masks", "posture")))


def posed(humanoid: HumanoidModel, qpos: np.ndarray, camera: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The humanoid without a room, its camera as it is worn."""
    model = mujoco.MjModel.from_xml_string(humanoid.xml)
    model.cam_quat[model.camera(WEARER_CAMERA).id] = camera[:4]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return model, data


def test_postures_are_what_kinematics_without_mujoco_give(
    drawn: dict[str, np.ndarray], humanoid: HumanoidModel
) -> None:
    skeleton, qpos = humanoid.skeleton, drawn["qpos"].astype(float)
    places, turns = forward_kinematics(skeleton, qpos)
    head = skeleton.index("Head")
    mount = humanoid.mj_model.cam_pos[humanoid.mj_model.camera(WEARER_CAMERA).id]
    origin = places[:, head] + rot.rotate(turns[:, head], np.broadcast_to(mount, (len(qpos), 3)))
    back = rot.conjugate(rot.multiply(turns[:, head], drawn["camera"][:, :4].astype(float)))
    for at, body in enumerate(BODIES):
        seen = rot.rotate(back, places[:, skeleton.index(body)] - origin)
        np.testing.assert_allclose(drawn["posture"][:, 3 * at : 3 * at + 3], seen, atol=1e-4)
    up = rot.rotate(back, np.tile([0.0, 0.0, 1.0], (len(qpos), 1)))
    np.testing.assert_allclose(drawn["posture"][:, 33:36], up, atol=1e-4)
    np.testing.assert_allclose(drawn["posture"][:, 36], origin[:, 2], atol=1e-4)
    np.testing.assert_array_equal(drawn["posture"][:, 37:], drawn["qpos"][:, 7:])
    assert len(posture_names(skeleton)) == drawn["posture"].shape[1] == 89


def test_masks_are_where_rays_through_the_picture_meet_limbs(
    drawn: dict[str, np.ndarray], humanoid: HumanoidModel
) -> None:
    """Rays know nothing of rendering; they only miss furniture, which stands away from the way."""
    met, right, hands = np.zeros(len(LIMBS)), np.zeros(len(LIMBS)), 0
    for k in range(0, 48, 3):
        model, data = posed(humanoid, drawn["qpos"][k], drawn["camera"][k])
        camera = model.camera(WEARER_CAMERA).id
        limb_of = {model.body(name).id: limb for limb, names in enumerate(LIMB_BODIES) for name in names}
        half = np.tan(np.deg2rad(drawn["camera"][k, 4]) / 2)

        def limb_at(across: float, down: float) -> int | None:
            """What stands at a place of the picture (-1..1), behind the near plane at 3 cm."""
            ray = data.cam_xmat[camera].reshape(3, 3) @ np.array([half * across, -half * down, -1.0])  # noqa: B023
            geom = np.full(1, -1, np.int32)
            begin = data.cam_xpos[camera] + 0.03 * ray  # noqa: B023
            mujoco.mj_ray(model, data, begin, ray, None, 1, model.body("Head").id, geom)  # noqa: B023
            return limb_of.get(int(model.geom_bodyid[geom[0]])) if geom[0] >= 0 else None  # noqa: B023

        for row in range(FLOW):
            for column in range(FLOW):
                limb = limb_at((2 * column + 1) / FLOW - 1, (2 * row + 1) / FLOW - 1)
                shares = drawn["masks"][k, :, row, column]
                if limb is None:
                    assert shares.max() < 255
                else:
                    met[limb], right[limb] = met[limb] + 1, right[limb] + (shares[limb] > 0)
        for side, hand in enumerate(drawn["posture"][k, :6].reshape(2, 3).astype(float)):
            place = np.array([hand[0], -hand[1]]) / (-hand[2] * half)
            if hand[2] < -0.03 and np.abs(place).max() < 1 and limb_at(*place) == side:
                column, row = ((place + 1) / 2 * FLOW).astype(int)
                hands += 1
                assert drawn["masks"][k, side, max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].max() > 0
    assert met.min() > 5
    assert hands > 2
    assert (right / met).min() > 0.98


def test_a_mirrored_sample_is_what_the_mirrored_scene_looks_like(
    drawn: dict[str, np.ndarray], humanoid: HumanoidModel
) -> None:
    mirror, sample = posture_mirror(humanoid.skeleton), as_pictures(drawn)
    image = mirrored(sample, mirror)
    twice = mirrored(image, mirror)
    for name in ("pictures", "flow", "masks", "posture"):
        torch.testing.assert_close(getattr(twice, name), getattr(sample, name), rtol=0, atol=0)
    for k in range(6):
        qpos, camera = drawn["qpos"][k].astype(float), drawn["camera"][k].astype(float)
        qpos[1], qpos[[4, 6]] = -qpos[1], -qpos[[4, 6]]  # over the world's x-z plane
        qpos[7:] = image.posture[k, 37:]
        straight = camera_orientations(humanoid.mj_model, np.zeros((1, 3)))[0]
        turned = rot.multiply(rot.conjugate(straight), camera[:4]) * np.array([1.0, 1.0, -1.0, -1.0])  # x is across
        model, data = posed(humanoid, qpos, np.array([*rot.multiply(straight, turned), camera[4]]))
        np.testing.assert_allclose(posture_in(model, data), image.posture[k], atol=2e-4)
    torch.testing.assert_close(image.masks[:, 0], sample.masks[:, 1].flip(-1))


def test_angles_stay_in_their_range_and_limbs_leave_the_clip(scenes: Scenes) -> None:
    rng = np.random.default_rng(0)
    pairs = np.stack([draw_pair(rng, scenes, np.zeros(2)) for _ in range(200)])
    low, high = scenes.joint_range.T
    assert (pairs[:, :, 7:] >= low - 1e-6).all()
    assert (pairs[:, :, 7:] <= high + 1e-6).all()
    assert pairs[:, 1, 7:].std(0).mean() > 1.5 * scenes.clips[0][:, 7:].std(0).mean()
    np.testing.assert_allclose(np.linalg.norm(pairs[..., 3:7], axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(pairs[:, 1, :2], 0.0, atol=1e-9)


def test_cameras_are_worn_as_takes_wear_them(drawn: dict[str, np.ndarray], scenes: Scenes) -> None:
    """However often a room's camera was turned before."""
    straight = camera_orientations(mujoco.MjModel.from_xml_string(scenes.model_xml), np.zeros((1, 3)))
    turned = rot.multiply(rot.conjugate(straight), drawn["camera"][:, :4].astype(float))
    ahead = rot.rotate(turned, np.tile([0.0, 0.0, -1.0], (len(turned), 1)))
    yaw, down = np.degrees(np.arctan2(-ahead[:, 0], -ahead[:, 2])), -np.degrees(np.arcsin(ahead[:, 1]))
    worn = scenes.render.camera
    play = 4 * worn.shake[1]
    assert worn.yaw[0] - play < yaw.min() <= yaw.max() < worn.yaw[1] + play
    assert worn.pitch_down[0] - play < down.min() <= down.max() < worn.pitch_down[1] + play


def test_no_room_is_one_that_a_take_may_have(drawn: dict[str, np.ndarray], scenes: Scenes) -> None:
    room = scenes.render.room
    of_takes = {room_seed(f"take{k}", split, room) for k in range(300) for split in ("train", "test")}
    assert max(of_takes) < scenes.settings.first_room <= drawn["room"].min()
    with pytest.raises(InputError, match=r"first_room.*takes are seen in"):
        replace(scenes, settings=replace(scenes.settings, first_room=room.train_rooms))


def test_a_seed_draws_the_same_again_and_others_draw_others(scenes: Scenes) -> None:
    few = replace(scenes, settings=replace(scenes.settings, rooms_a_part=1, wearings=1, pairs=3))
    first, again = draw_part(few, 3, 1), draw_part(few, 3, 1)
    for name, (kind, _) in ARRAYS.items():
        np.testing.assert_array_equal(first[name], again[name])
        assert first[name].dtype == kind
    assert len(first["room"]) == 3
    for other in (draw_part(few, 4, 1), draw_part(few, 3, 2)):
        assert other["room"][0] != first["room"][0]
        assert not np.array_equal(other["posture"], first["posture"])


def test_parts_are_drawn_once_and_whole(scenes: Scenes, tmp_path: Path) -> None:
    few = replace(scenes, settings=replace(scenes.settings, samples=5, rooms_a_part=1, wearings=1, pairs=2))
    made_from = {"motions": {"walk": "1"}}
    assert draw_pictures(few, 1, tmp_path, made_from, workers=1, progress=False) == 3
    whole = read_pictures(tmp_path, few.settings, tuple(ARRAYS))
    assert {name: len(array) for name, array in whole.items()} == dict.fromkeys(ARRAYS, 5)
    assert draw_pictures(few, 1, tmp_path, made_from, workers=1, progress=False) == 0
    part_path(tmp_path, 1).unlink()
    with pytest.raises(InputError, match=r"part-00001\.npz.*drawn again"):
        read_pictures(tmp_path, few.settings, tuple(ARRAYS))
    assert draw_pictures(few, 1, tmp_path, made_from, workers=1, progress=False) == 1
    for name, array in read_pictures(tmp_path, few.settings, tuple(ARRAYS)).items():
        np.testing.assert_array_equal(array, whole[name])
    part_path(tmp_path, 2).write_bytes(part_path(tmp_path, 2).read_bytes()[:2000])
    with pytest.raises(InputError, match=r"part-00002\.npz"):
        read_pictures(tmp_path, few.settings, tuple(ARRAYS))
    for seed, motions in ((2, made_from), (1, {"motions": {"walk": "2"}})):
        with pytest.raises(InputError, match="other motions or settings"):
            draw_pictures(few, seed, tmp_path, motions, workers=1, progress=False)


def test_the_shipped_finder_finds_limbs_in_pictures_drawn_now(
    drawn: dict[str, np.ndarray], humanoid: HumanoidModel
) -> None:
    source_config = read_json(SHIPPED, "config")
    assert source_config["names"] == posture_names(humanoid.skeleton)
    model = BodyPartEstimator(source_config["numbers"], source_config["channels"])
    RunCheckpoint({"finder": model}).restore(SHIPPED)
    figures = held_out_figures(model, as_pictures(drawn), humanoid.skeleton, 16)
    assert np.mean(list(figures["masks"].values())) > 0.5
    assert figures["posture"]["up"] > 0.5


@pytest.mark.parametrize(
    ("content", "field"), [("{", "line|JSON|Frames|text"), ('{"Loop": "wrap", "Frames": [[1, 2]]}', "Frames|columns")]
)
def test_a_bad_motion_is_named(
    content: str, field: str, tmp_path: Path, humanoid: HumanoidModel, config: dict[str, Any]
) -> None:
    bad = tmp_path / "bad.txt"
    bad.write_text(content)
    files = motion_files([str(tmp_path / "*.txt")], [])
    with pytest.raises(InputError, match=field) as caught:
        base_clips(files, humanoid, config["data"]["preparation"], 2)
    assert caught.value.source == str(bad)


def test_motions_that_are_not_there_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\*\.txt: motions: there is no such file"):
        motion_files([str(tmp_path / "nothing*.txt")], [])
    (tmp_path / "a_roll.txt").touch()
    with pytest.raises(InputError, match="exclude leaves none"):
        motion_files([str(tmp_path / "*.txt")], ["*roll*"])


def test_settings_that_cannot_be_are_told(config: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="pairs: must be at least 1"):
        PictureSettings.from_config({**config["pictures"], "pairs": 0})
    with pytest.raises(InputError, match="brightness"):
        PictureSettings.from_config({**config["pictures"], "brightness": 1})
