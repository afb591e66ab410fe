"""Places: the horizon where geometry has it, ways left free, surfaces with detail, people who walk, lenses."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from helpers.mocap import default_humanoid
from helpers.walking import walking
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision.mounts import camera_poses, mount_of
from egopose.vision.places.people import draw_passers
from egopose.vision.places.pictures import GROUNDS, ground_picture
from egopose.vision.places.place import Builder, Way, wrap
from egopose.vision.places.scenery import FILM_CAMERA, PLACES, Scenery, draw_scenery, scenery_model
from egopose.vision.rendering import SceneRenderer
from egopose.vision.shooting import Moment, Optics, Shooter
from egopose.vision.surfaces import add_lights

STILL = np.zeros(3)
# Columns right, down and ahead of a level camera that looks along x.
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def way() -> Way:
    return Way.of(walking().qpos)


def shown(scenery: Scenery, time: float = 0.0, width: int = 64) -> np.ndarray:
    """What a level camera sees from a corner of the way, without a wearer."""
    position = np.array([*scenery_start(), 1.5])
    with Shooter(scenery_model(scenery), Optics(width, width, 90.0), scenery.place.far, scenery.move) as shooter:
        return shooter.shoot([Moment(time, np.zeros(0), position, LEVEL, STILL)])


def scenery_start() -> np.ndarray:
    return walking().qpos[0, :2]


@pytest.mark.parametrize("kind", ["open_ground", "street"])
def test_the_horizon_is_level_and_the_sky_above_it(kind: str) -> None:
    """A level camera's middle row is at its own height: no ground above it, no sky below."""
    scenery = draw_scenery(kind, 1, way())
    model = scenery_model(scenery)
    camera = model.camera(FILM_CAMERA).id
    model.cam_pos[camera] = [*scenery_start(), 1.5]
    mujoco.mju_mat2Quat(model.cam_quat[camera], (LEVEL * [1.0, -1.0, -1.0]).ravel())
    model.cam_fovy[camera] = 90.0
    with SceneRenderer(model, 96, 96, far=scenery.place.far) as renderer:
        seen = renderer.segment(np.zeros(0), FILM_CAMERA)
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    level = np.flatnonzero(planes & (np.abs(model.geom_quat[:, 1:3]).max(1) < 1e-9))
    assert not np.isin(seen[:46], level[model.geom_pos[level, 2] < 1.0]).any()
    assert (seen[52:] >= 0).all()
    assert (seen[:46] == -1).mean() > 0.1
    assert np.isin(seen[60:], level).mean() > 0.5


@pytest.mark.parametrize("kind", PLACES)
@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_stands_in_the_wearers_way(kind: str, seed: int) -> None:
    scenery = draw_scenery(kind, seed, way(), table=True)
    model = scenery_model(scenery)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    for point in way().path[::10]:
        for height in (0.3, 0.9, 1.5):
            local = np.einsum("nji,nj->ni", data.geom_xmat.reshape(-1, 3, 3), [*point, height] - data.geom_xpos)
            box = model.geom_aabb[solid]
            outside = np.abs(local[solid] - box[:, :3]) - box[:, 3:]
            assert np.linalg.norm(np.maximum(outside, 0.0), axis=1).min() > 0.15
    low, high = np.array(scenery.place.low), np.array(scenery.place.high)
    assert (way().path >= low).all()
    assert (way().path <= high).all()


@pytest.mark.parametrize("kind", PLACES)
def test_a_seed_gives_one_place(kind: str) -> None:
    first, again, other = (shown(draw_scenery(kind, seed, way(), people=True)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


@pytest.mark.parametrize("ground", GROUNDS)
def test_ground_has_detail_from_centimetres_to_metres(ground: str) -> None:
    """The deviation, in grey levels, that is left in each band of sizes of a picture of 8 m with 1 cm a pixel."""
    grey = ground_picture(np.random.default_rng(0), ground, 800, 8.0).mean(axis=2)
    for step in (2, 8, 32, 100):
        cells = grey[: 800 // step * step, : 800 // step * step].reshape(800 // step, step, -1, step).mean(axis=(1, 3))
        between = np.abs(np.diff(cells, axis=0)).mean()
        assert between > 2.0, f"{ground} is flat between cells of {step} cm"


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 100.0))
def test_people_walk_steadily_within_the_place_and_past_the_wearer(seed: int, time: float) -> None:
    around = Way(np.array([[0.0, 0.0], [3.0, 1.0]]), np.zeros(2), 2.0)
    room = PLACES["furnished_room"](seed, around)
    for passer in draw_passers(np.random.default_rng(seed), around, room, 3):
        place, _, _ = passer.at(time)
        after, _, _ = passer.at(time + 0.1)
        assert 1.0 <= passer.speed <= 1.5
        assert np.linalg.norm(after - place) <= 0.1 * passer.speed + 1e-9
        assert around.distance(place) > 0.8
        assert (place > np.array(room.low)).all()
        assert (place < np.array(room.high)).all()


def test_only_the_people_move() -> None:
    scenery = draw_scenery("street", 7, way(), people=True)
    assert scenery.passers
    empty = draw_scenery("street", 7, way())
    # Seen from above, so that no one is hidden.
    high, down = np.array([*scenery_start(), 12.0]), np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    frames = []
    for each in (scenery, empty):
        with Shooter(scenery_model(each), Optics(160, 160, 100.0), 200.0, each.move) as shooter:
            frames += [shooter.shoot([Moment(t, np.zeros(0), high, down, STILL)]) for t in (0.0, 1.0)]
    moved = (frames[0] != frames[1]).any(axis=2)
    assert 0.0005 < moved.mean() < 0.2
    np.testing.assert_array_equal(frames[2], frames[3])


@pytest.mark.parametrize("mount", ["chest", "held", "head"])
def test_the_camera_is_outside_of_the_body(mount: str) -> None:
    """A wearer who stands straight and looks level sees ground, things and sky: his body is no more than an edge."""
    humanoid = default_humanoid()
    qpos = humanoid.mj_model.qpos0[None]
    scenery = draw_scenery("open_ground", 2, Way.of(qpos))
    model = scenery_model(scenery, humanoid.xml)
    position, rotation = camera_poses(humanoid.mj_model, qpos, mount_of(mount))
    camera = model.camera(FILM_CAMERA).id
    model.cam_pos[camera] = position[0]
    mujoco.mju_mat2Quat(model.cam_quat[camera], (rotation[0] * [1.0, -1.0, -1.0]).ravel())
    model.cam_fovy[camera] = 90.0
    with SceneRenderer(model, 64, 64, far=240.0) as renderer:
        seen = renderer.segment(qpos[0], FILM_CAMERA)
    own = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0))
    assert np.isin(seen, own).mean() < 0.05


@pytest.mark.parametrize(
    ("lens", "field_of_view", "size"),
    [("pinhole", 100.0, (160, 90)), ("fisheye", 110.0, (160, 90)), ("fisheye", 125.0, (96, 96))],
)
def test_a_ball_is_seen_where_the_lens_puts_it(lens: str, field_of_view: float, size: tuple[int, int]) -> None:
    """Radius f tan(a) of a pinhole, f a of an equidistant fisheye; also where two pinholes share the picture."""
    spec = mujoco.MjSpec()
    white = wrap(spec, "white", np.full((8, 8, 3), 255, np.uint8))
    bearings = np.array([[0.0, 0.0], [0.4, 0.2], [-0.7, 0.1], [0.05, -0.3], [0.8, 0.35]])
    for across, up in bearings:
        ahead = np.array([np.cos(up) * np.cos(across), -np.cos(up) * np.sin(across), np.sin(up)])
        x, y, z = 5.0 * ahead
        Builder(spec, "ball").blob(x, y, z, (0.12, 0.12, 0.12), white)
    add_lights(spec, np.random.default_rng(0))
    spec.worldbody.add_camera(name=FILM_CAMERA)
    optics = Optics(*size, field_of_view, lens)
    with Shooter(spec.compile(), optics, 60.0, lambda model, data, time: None) as shooter:
        one = Moment(0.0, np.zeros(0), np.zeros(3), LEVEL, STILL)
        pictures = [shooter.shoot([one]), shooter.shoot([one, one], 0.0)]
    half = np.deg2rad(0.5 * field_of_view)
    focal = 0.5 * size[0] / (half if lens == "fisheye" else np.tan(half))
    for across, up in bearings:
        ray = np.array([np.cos(up) * np.sin(across), -np.sin(up), np.cos(up) * np.cos(across)])
        angle = np.arccos(ray[2])
        radius = focal * (angle if lens == "fisheye" else np.tan(angle))
        side = ray[:2] / max(np.linalg.norm(ray[:2]), 1e-9)
        expected = 0.5 * np.array(size) - 0.5 + radius * side
        if (np.abs(expected - 0.5 * np.array(size)) > 0.5 * np.array(size) - 4).any():
            continue
        for picture in pictures:
            v, u = np.mgrid[0 : size[1], 0 : size[0]]
            near = np.hypot(u - expected[0], v - expected[1]) < 6
            light = picture.mean(axis=2) * near
            found = np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
            np.testing.assert_allclose(found, expected, atol=0.6)


def test_what_is_no_place_or_lens_is_refused() -> None:
    with pytest.raises(InputError, match="place: 'moon'"):
        draw_scenery("moon", 0, way())
    with pytest.raises(InputError, match="field_of_view"):
        Optics(64, 64, 179.0)
    with pytest.raises(InputError, match="lens"):
        Optics(64, 64, 90.0, "plenoptic")
    with pytest.raises(InputError, match="size"):
        Optics(64, 4, 90.0)
    with pytest.raises(InputError, match="corners"):
        Optics(64, 64, 139.0, "fisheye", 0.1)
